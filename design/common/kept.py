"""Arrays that take long to compute, kept on disk from one process to the next, where Numba keeps compiled kernels."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from hashlib import sha256
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.compilation import cache_folder
from padforge.design.common.files import atomic_file
from padforge.design.common.validation import InputError

Arrays = Mapping[str, NDArray[np.float64]]
_first: set[str] = set()  # what this process has computed first


def kept(key: bytes, compute: Callable[[], Arrays]) -> Arrays:
    """Return what `compute` returns, read from disk where an earlier process has kept it.

    A process keeps only what it computes first: what its command is about, and not the thousands of a fit. Where the
    folder cannot be written, nothing is kept. How BLAS rounds depends on its threads: what is read is what a process
    of as many would compute.

    Args:
        key: all that the arrays depend on, also the code.
        compute: called if nothing is kept by this key.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = [os.environ.get(f"{library}_NUM_THREADS") for library in ("OMP", "OPENBLAS", "MKL")]
    digest = sha256(key + repr((np.__version__, cores, threads)).encode()).hexdigest()
    path = cache_folder() / f"kept-{digest[:32]}.npz"
    with suppress(OSError, ValueError, EOFError, BadZipFile), path.open("rb") as file, np.load(file) as arrays:
        return dict(arrays)
    computed = compute()
    if _first <= {path.name}:
        _first.add(path.name)
        with suppress(OSError, InputError), atomic_file(path) as temporary:
            np.savez(temporary, **computed)
    return computed
