"""Parallel tasks on the cores of this machine or on a cluster, and the checkpoints from which they resume.

On one machine tasks run in threads, since torch and the kernels release the interpreter lock: no data are copied, and
compiled code is shared.
"""

import io
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice, pairwise
from pathlib import Path
from threading import Lock, Thread
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from padforge.common import files
from padforge.common.validation import Fault, InputError, short_repr

State = dict[str, NDArray[Any]]
Key = TypeVar("Key")
Item = TypeVar("Item")
Result = TypeVar("Result")

FORMAT = "padforge-search/1"
SCHEDULER_S = 10.0  # time limit for a cluster's scheduler to answer
POLL_S = 0.1  # interval of checks for Ctrl-C, which does not wake a waiting thread on every system

_STATE_FILE = re.compile(r"start_([0-9]{4,})\.npz")

active_threads = set[Thread]()  # threads of `_DaemonThreads` that have not ended


def run_tasks(
    tasks: Iterable[tuple[Key, Callable[[], Result]]],
    executor: Executor | None = None,
    *,
    max_parallel: int | None = None,
    follow_up: Callable[[Key, Result], Callable[[], Result] | None] = lambda key, result: None,
    is_abandoned: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[Key, Result]]:
    """Run tasks in parallel, and yield their results as they complete, each with the key of its task.

    Tasks start only while the caller iterates, and must be picklable for a cluster. After an exception or Ctrl-C in the
    caller no further task starts, and running ones are not waited for; an exception in a task is raised here at once.

    Args:
        tasks: functions by key, in the order in which they start.
        executor: executor of `concurrent.futures`; daemon threads of this machine if None.
        max_parallel: maximum number of running tasks; by default the number of cores, or no limit with an executor.
        follow_up: returns the next task of a key, or None; called after the caller has used a result.
        is_abandoned: returns whether to leave running tasks behind, for example because an executor hangs.
    """
    pool = executor or _DaemonThreads()
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


class _DaemonThreads(Executor):
    """A daemon thread for each task; unlike `ThreadPoolExecutor`, it does not delay the end of the program."""

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **keywords: Any) -> Future[Any]:
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


def makespan(parts: Sequence[float], workers: int) -> float:
    """Return the time in which workers finish tasks of these durations, by list scheduling."""
    ends = [0.0] * workers
    for duration in parts:
        ends[ends.index(min(ends))] += duration
    return max(ends)


@contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """Connect to the Dask cluster at `address` and yield its executor; None for this machine."""
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
            advice = "find the cause, and start again; a search goes on with --resume"
            raise Fault(f"the cluster at {address} {reason}; {advice}") from error


def map_threads(work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Yield work(item) for each of the items in their order, computed with one thread a core."""
    with ThreadPoolExecutor(max(1, min(os.cpu_count() or 1, len(items)))) as pool:
        yield from pool.map(work, items)


def map_chunks(work: Callable[[int, int], Result], count: int, min_chunk: int) -> list[Result]:
    """Return work(begin, end) for chunks, of at least `min_chunk`, of range(count), in one thread per core."""
    n_chunks = max(1, min(os.cpu_count() or 1, count // min_chunk))
    if n_chunks == 1:
        return [work(0, count)]
    edges = np.linspace(0, count, n_chunks + 1).astype(int).tolist()
    return list(map_threads(lambda bounds: work(*bounds), list(pairwise(edges))))


# The number of threads of torch and BLAS is global: the last body of `one_thread` to end restores it.
_n_bodies = 0
_limits = ExitStack()
_limits_lock = Lock()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and BLAS to one thread in the body, which may be nested or run in several threads.

    More threads gain little for small matrices, are slow beside other programs, and sum in another order. Threads of
    BLAS are busy while they wait: beside other programs, a calibration took six times the processor time.
    """
    global _n_bodies
    from threadpoolctl import threadpool_limits

    with _limits_lock:
        if not _n_bodies:
            if torch := sys.modules.get("torch"):  # which takes a second to import
                _limits.callback(torch.set_num_threads, torch.get_num_threads())
                torch.set_num_threads(1)
            _limits.enter_context(threadpool_limits(1, "blas"))
        _n_bodies += 1
    try:
        yield
    finally:
        with _limits_lock:
            _n_bodies -= 1
            if not _n_bodies:
                _limits.close()


class Checkpoints:
    """Checkpoints of the tasks of a search, each a small file of arrays, from which a killed search resumes.

    The folder is created with the first state. States of other `settings`, by section and key, are refused.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder, self.settings = folder, json.loads(json.dumps(settings))
        self._file = folder / "search.json"

    def begin(self, resume: bool) -> dict[int, State]:
        """Return the states of an earlier run by number if `resume`, otherwise remove them."""
        if not (resume and self._file.exists()):
            self.clear()
            return {}
        stored: Any = files.read_json(self._file, FORMAT).get("settings")
        with files.reraise_as_input_error(self._file):
            for section, values in self.settings.items():
                for key, value in values.items():
                    if (before := stored.get(section, {}).get(key)) != value:
                        change = f"begun with {section} {key} {short_repr(before)}, now {short_repr(value)}"
                        raise InputError(f"{self.folder}: {change}; a search resumes with the same settings only")
        paths = {int(name[1]): path for path in self.folder.iterdir() if (name := _STATE_FILE.fullmatch(path.name))}
        return {number: self._read(paths[number]) for number in sorted(paths)}

    def save(self, number: int, state: State) -> None:
        if not self._file.exists():
            files.write_json(self._file, {"format": FORMAT, "settings": self.settings})
        with files.atomic_file(self.folder / f"start_{number:04d}.npz") as temporary:
            np.savez(temporary, allow_pickle=False, **state)

    def clear(self) -> None:
        """Remove all states, and the folder if it is then empty."""
        if self._file.exists():
            try:
                files.read_json(self._file, FORMAT)
            except InputError as error:
                raise InputError(f"{error}; remove it, or choose another folder") from error
            for file in list(self.folder.iterdir()):
                if _STATE_FILE.fullmatch(file.name):
                    file.unlink()
            self._file.unlink()
        files.remove_leftovers(self.folder)
        with suppress(OSError):  # it does not exist, or is not empty
            self.folder.rmdir()

    def _read(self, path: Path) -> State:
        try:
            with np.load(io.BytesIO(files.read_bytes(path)), allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except InputError:
            raise
        except Exception as error:  # NumPy and zipfile raise many types for damaged files
            raise InputError(f"{path}: cannot be read ({error}); start again without --resume") from error
