"""Compilation of kernels by Numba, their cache on disk, and a notice to users whose command compiles them."""

import atexit
import gc
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryFile, mkdtemp
from threading import Lock, Timer
from typing import Any, Protocol, TypeVar, overload

# Colouring the message of each rejected overload would take a thirtieth of the time.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

from numba import njit
from numba.core import config
from numba.core import event as events

import padforge

NOTICE_AFTER_S = 1.5  # time spent on compiling after which the user is notified
_STAGES = next(base for base in map(Path, padforge.__path__) if (base / "design").is_dir())  # folder of the stages
SOURCES = [_STAGES / stage for stage in ("design", "sense")]  # folders with kernels
MAX_CACHES = 4  # maximum number of caches in a folder, for the latest versions of the sources
_PREFIX = "padforge-kernels-"

_Function = TypeVar("_Function", bound=Callable[..., Any])
_log = logging.getLogger(__name__)
_decorating = Lock()
_numba: Any = config  # has attributes from the environment, unknown to type checkers


class _Decorator(Protocol):
    """`@kernel`, or with further options of `numba.njit`, `@kernel(inline="always")`."""

    @overload
    def __call__(self, function: _Function, /) -> _Function: ...
    @overload
    def __call__(self, **options: Any) -> Callable[[_Function], _Function]: ...


def cache_bases() -> Iterator[Path]:
    """Yield the possible folders of a cache of kernels, in order of preference."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(chosen)
    yield Path(__file__).parent / "__pycache__"
    if chosen := os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA"):
        yield Path(chosen)
    with suppress(RuntimeError):  # this user has no home
        yield Path.home() / ".cache"


@cache
def cache_folder() -> Path:
    """Return the folder of the compiled kernels of these sources; a temporary one if no folder can be written.

    Its name contains a digest of all sources, since Numba compares the source file of a kernel only, not those of the
    kernels and constants that it uses.
    """
    sources = sorted(path for folder in SOURCES for path in folder.rglob("*.py"))
    name = _PREFIX + sha256(b"\0".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    for base in cache_bases():
        folder = base / name
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=folder).close()
            os.utime(folder)
            _delete_older_caches(base)
            return folder
    folder = Path(mkdtemp(prefix="padforge-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _delete_older_caches(base: Path) -> None:
    with suppress(OSError):  # another process may delete them as well
        caches = sorted(base.glob(_PREFIX + "[0-9a-f]" * 16), key=lambda path: path.stat().st_mtime)
        for folder in caches[:-MAX_CACHES]:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _caching_in(folder: Path) -> Iterator[None]:
    """Return a context in which decorated functions are cached in a folder; those of other programs are not."""
    with _decorating:
        previous, _numba.CACHE_DIR = _numba.CACHE_DIR, str(folder)
        try:
            yield
        finally:
            _numba.CACHE_DIR = previous


def _cached_njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Decorate like `numba.njit`, with the cache in `cache_folder`."""
    if function is None:
        return partial(_cached_njit, **options)
    with _caching_in(cache_folder()):
        return njit(function, cache=True, **options)


kernel: _Decorator = partial(_cached_njit, error_model="numpy", nogil=True)
"""Compiles a function at its first call, without checks for division by zero; calls release the interpreter lock.

A function that only one kernel calls should be a `kernel(inline="always")`, which becomes a part of that kernel.
"""


class Compilations(events.Listener):
    """Logs one line when a process has compiled kernels for `NOTICE_AFTER_S`; none if it reads them from the cache.

    Numba runs one compilation at a time, with nested ones for the functions that are called.
    """

    def __init__(self) -> None:
        self._depth, self._spent_s, self._announced = 0, 0.0, False

    def on_start(self, event: Any) -> None:
        """Start the clock."""
        if self._depth == 0:
            self._started_s = time.monotonic()
            self._collects = gc.isenabled()
            gc.disable()  # collecting garbage would take a sixth of the time; the compiler's objects are all in use
            self._timer = Timer(max(NOTICE_AFTER_S - self._spent_s, 0), self._announce)
            self._timer.daemon = True  # must not delay the end of the program
            self._timer.start()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Stop the clock."""
        self._depth -= 1
        if self._depth == 0:
            self._timer.cancel()
            self._spent_s += time.monotonic() - self._started_s
            if self._collects:
                gc.enable()

    def _announce(self) -> None:
        if not self._announced:
            self._announced = True
            _log.info("compiling kernels, which takes up to a minute and is done once")


events.register("numba:compile", Compilations())
