"""Parallel tasks on the cores of this machine or on a cluster, and the cache of compiled kernels.

Threads serve on one machine, since torch and the kernels release the interpreter lock while they compute: nothing is
copied, and compiled code is shared.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from hashlib import sha256
from itertools import islice, pairwise
from pathlib import Path
from threading import Lock, Thread
from typing import Any, TypeVar

import numpy as np

from padforge.design.common.validation import Fault, InputError

Key = TypeVar("Key")
Result = TypeVar("Result")

SCHEDULER_S = 10.0
"""Time limit for a cluster's scheduler to answer."""
POLL_S = 0.1
"""Interval at which Ctrl-C is noticed on systems where it does not wake a waiting thread."""

active_threads: set[Thread] = set()
"""Those of `DaemonThreads` that have not ended."""


def run_tasks(
    tasks: Iterable[tuple[Key, Callable[[], Result]]],
    executor: Executor | None = None,
    *,
    max_parallel: int | None = None,
    follow_up: Callable[[Key, Result], Callable[[], Result] | None] = lambda key, result: None,
    is_abandoned: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[Key, Result]]:
    """Run tasks in parallel, and yield their results as they complete, each with the key of its task.

    Searches, studies and trainings share this loop: the caller keeps each result and reports the progress. Tasks start
    only while the caller iterates. An exception or Ctrl-C in the caller starts no further task, and running ones are
    not waited for; an exception in a task is raised here at once. Tasks may share torch under `one_torch_thread`.

    Args:
        tasks: functions by key, in the order in which they start; drawn one by one as there is room. For other
            processes, such as those of a cluster, they must be picklable: `functools.partial` of a module's function.
        executor: of the `concurrent.futures` kind; daemon threads of this machine if None.
        max_parallel: limit of running tasks; by default the number of cores, or none with an executor.
        follow_up: returns the next task of the same key, once the caller has used a result; None if there is none.
        is_abandoned: whether to leave running tasks behind, as where an executor hangs.

    Yields:
        Key and result.
    """
    pool = executor or DaemonThreads()
    limit = max_parallel or (None if executor else os.cpu_count() or 1)
    waiting, running = iter(tasks), dict[Future[Result], Key]()
    try:
        while True:
            for key, work in islice(waiting, limit and limit - len(running)):
                running[pool.submit(work)] = key
            if not running or is_abandoned():
                return
            for future in wait(running, POLL_S, FIRST_COMPLETED).done:
                key, result = running.pop(future), future.result()
                yield key, result
                if work := follow_up(key, result):
                    running[pool.submit(work)] = key
    finally:
        for future in running:
            future.cancel()


class DaemonThreads(Executor):
    """A thread for each task, which, unlike those of `ThreadPoolExecutor`, does not delay the end of the program."""

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **keywords: Any) -> Future[Any]:
        """Start a task at once."""
        future: Future[Any] = Future()

        def run() -> None:
            try:
                future.set_result(work(*arguments, **keywords))
            except BaseException as error:
                future.set_exception(error)
            finally:
                active_threads.discard(thread)

        future.set_running_or_notify_cancel()
        thread = Thread(target=run, daemon=True)
        active_threads.add(thread)
        thread.start()
        return future


@contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """Connect to the Dask cluster at `address` as an executor; None stands for this machine.

    Raises:
        InputError: Dask is not installed, or no scheduler answers there.
        Fault: in the body, when the scheduler is lost, or a task has ended one worker after another.
    """
    if address is None:
        yield None
        return
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'padforge[cluster]'") from error
    try:
        client = Client(address, timeout=SCHEDULER_S)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler is {address}: no Dask scheduler answers there ({error})") from error
    with client, client.get_executor(pure=False, retries=10) as executor:
        try:
            yield executor
        except (CancelledError, KilledWorker) as error:
            reason = "has lost its scheduler" if isinstance(error, CancelledError) else "loses every worker"
            advice = "what was finished is kept: see why, and go on with --resume"
            raise Fault(f"the cluster at {address} {reason}; {advice}") from error


def map_chunks(work: Callable[[int, int], Result], count: int, min_chunk: int) -> list[Result]:
    """Apply work(begin, end) to chunks that partition range(count), one thread a core.

    Args:
        work: function of the bounds of a chunk.
        count: number of items.
        min_chunk: items below which a chunk is not worth a thread.

    Returns:
        Results in the order of the chunks.
    """
    n_chunks = max(1, min(os.cpu_count() or 1, count // min_chunk))
    if n_chunks == 1:
        return [work(0, count)]
    edges = np.linspace(0, count, n_chunks + 1).astype(int).tolist()
    with ThreadPoolExecutor(n_chunks) as pool:
        return list(pool.map(lambda bounds: work(*bounds), pairwise(edges)))


class _TorchThreads:
    """Bodies of `one_torch_thread` that run, and the number of threads before the first: torch has one for all."""

    lock, n_bodies, n_before = Lock(), 0, 1


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch to one thread in the body; from any thread, in parallel or nested, until the last body ends.

    Small matrices gain little from more threads, these slow each other down where another program uses the cores, and
    sums in another order would give another result.
    """
    import torch

    with _TorchThreads.lock:
        if not _TorchThreads.n_bodies:
            _TorchThreads.n_before = torch.get_num_threads()
        _TorchThreads.n_bodies += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _TorchThreads.lock:
            _TorchThreads.n_bodies -= 1
            if not _TorchThreads.n_bodies:
                torch.set_num_threads(_TorchThreads.n_before)


def clear_stale_kernels(package: Path) -> None:
    """Delete the compiled kernels of a package if any of its sources has changed since the last call.

    Numba compares the source of a kernel alone, not of those that it inlines. A folder that cannot be written is left
    as it is: no kernels are cached there.
    """
    cache = package / "__pycache__"
    with suppress(OSError):
        cache.mkdir(exist_ok=True)
        digest = sha256(b"\0".join(source.read_bytes() for source in sorted(package.rglob("*.py")))).digest()
        stamp = cache / "kernels.sha256"
        if stamp.exists() and stamp.read_bytes() == digest:
            return
        for compiled in package.rglob("__pycache__/*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        stamp.write_bytes(digest)
