"""Spreading work over the cores of this machine or of a cluster, and keeping what is compiled.

Threads serve here, since torch and the kernels let go of the interpreter while they work: nothing is copied, and
compiled code is shared.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from hashlib import sha256
from itertools import islice, pairwise
from pathlib import Path
from threading import Lock, Thread
from typing import Any, ClassVar, TypeVar

import numpy as np

from padforge.design.common.validation import Fault, InputError

Key = TypeVar("Key")
Result = TypeVar("Result")

SCHEDULER_S = 10.0
"""How long a cluster's scheduler is waited for."""
LOOK_S = 0.1
"""Between two looks for Ctrl-C where the system does not wake a thread that waits."""


def run_tasks(
    tasks: Iterable[tuple[Key, Callable[[], Result]]],
    executor: Executor | None = None,
    *,
    at_once: int | None = None,
    then: Callable[[Key, Result], Callable[[], Result] | None] = lambda key, result: None,
    given_up: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[Key, Result]]:
    """Results of tasks as they come, in any order, each with its task's key.

    The one way in which searches, studies and trainings spread work: `for key, result in run_tasks(...)`, the caller
    keeping each result and telling of the progress. A task begins only while the caller listens: what an exception or
    Ctrl-C in the caller leaves is kept, no further task begins, and those at work are not waited for. An exception in
    a task comes out here, at once. Tasks may share torch under `one_torch_thread`.

    Args:
        tasks: what to call, by key, in the order they begin; drawn one by one as there is room. For other processes,
            such as those of a cluster, they must be picklable: `functools.partial` of a module's function.
        executor: of the `concurrent.futures` kind; daemon threads of this machine if None.
        at_once: tasks at most; as many as there are cores if there is no executor, else as the executor has it.
        then: the next task of the same key once a result has been listened to, None if there is none.
        given_up: whether to leave behind what is at work, as where an executor hangs.
    """
    pool = executor or DaemonThreads()
    most = at_once or (None if executor else os.cpu_count() or 1)
    waiting, running = iter(tasks), dict[Future[Result], Key]()
    try:
        while True:
            for key, work in islice(waiting, most and most - len(running)):
                running[pool.submit(work)] = key
            if not running or given_up():
                return
            for future in wait(running, LOOK_S, FIRST_COMPLETED).done:
                key, result = running.pop(future), future.result()
                yield key, result
                if next_one := then(key, result):
                    running[pool.submit(next_one)] = key
    finally:
        for future in running:
            future.cancel()


class DaemonThreads(Executor):
    """A thread for whatever is submitted, which does not hold up the end of the program.

    Attributes:
        at_work: the threads of all that have not come to their end.
    """

    at_work: ClassVar[set[Thread]] = set()

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Begin at once."""
        future: Future[Any] = Future()

        def run() -> None:
            try:
                result = work(*arguments, **named)
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)
            finally:
                self.at_work.discard(thread)

        future.set_running_or_notify_cancel()
        thread = Thread(target=run, daemon=True)
        self.at_work.add(thread)
        thread.start()
        return future


@contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """The Dask cluster at `address` as an executor, or None for this machine.

    Raises:
        InputError: Dask is not installed, or no scheduler answers there.
        Fault: in the body, once its scheduler is gone, or a task has ended one worker after another.
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
    with client, client.get_executor(pure=False, retries=10) as there:
        try:
            yield there
        except (CancelledError, KilledWorker) as error:
            what = "has lost its scheduler" if isinstance(error, CancelledError) else "loses every worker"
            advice = "what was finished is kept: see why, and go on with --resume"
            raise Fault(f"the cluster at {address} {what}; {advice}") from error


def map_chunks(work: Callable[[int, int], Result], count: int, grain: int) -> list[Result]:
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


class _OneThread:
    """Who is within `one_torch_thread`, and the number of threads before: torch has one of them for all."""

    lock, inside, before = Lock(), 0, 1


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread in the body, from any thread, several bodies beside each other or within.

    Small matrices gain little from more, where another program has a core threads that wait for each other take many
    times as long, and sums in another order would give another result. The last one to leave sets it back.
    """
    import torch

    with _OneThread.lock:
        if not _OneThread.inside:
            _OneThread.before = torch.get_num_threads()
        _OneThread.inside += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _OneThread.lock:
            _OneThread.inside -= 1
            if not _OneThread.inside:
                torch.set_num_threads(_OneThread.before)


def clear_stale_kernels(package: Path) -> None:
    """Delete the compiled kernels of a package, with the rooms in it, if its sources are not those of the last call.

    Does nothing where the folder cannot be written: what is compiled then is not kept in it either.
    """
    kept = package / "__pycache__"
    with suppress(OSError):
        kept.mkdir(exist_ok=True)
        now = sha256(b"\0".join(source.read_bytes() for source in sorted(package.rglob("*.py")))).digest()
        stamp = kept / "kernels.sha256"
        if stamp.exists() and stamp.read_bytes() == now:
            return
        for compiled in package.rglob("__pycache__/*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        stamp.write_bytes(now)
