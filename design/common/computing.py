"""Spreading compiled work over the cores: the kernels let go of the interpreter while they run."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

Result = TypeVar("Result")


def in_chunks(work: Callable[[int, int], Result], count: int, grain: int) -> list[Result]:
    """Results of work(begin, end) over chunks that make up 0..count, in order, one thread a core.

    Args:
        grain: items below which a chunk is not worth a thread; work that small runs where it is.
    """
    chunks = max(1, min(os.cpu_count() or 1, count // grain))
    if chunks == 1:
        return [work(0, count)]
    edges = np.linspace(0, count, chunks + 1).astype(int).tolist()
    with ThreadPoolExecutor(chunks) as pool:
        return list(pool.map(lambda ends: work(*ends), pairwise(edges)))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread: small matrices gain little from more, and where another program has a core, threads
    that wait for each other take many times as long."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def forget_outdated(package: Path) -> None:
    """Delete the compiled kernels of a package folder if its sources are not those of the last call.

    Does nothing where the folder cannot be written: what is compiled then is not kept in it either.
    """
    kept = package / "__pycache__"
    with suppress(OSError):
        kept.mkdir(exist_ok=True)
        now = sha256(b"\0".join(source.read_bytes() for source in sorted(package.glob("*.py")))).digest()
        stamp = kept / "kernels.sha256"
        if stamp.exists() and stamp.read_bytes() == now:
            return
        for compiled in kept.glob("*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        stamp.write_bytes(now)
