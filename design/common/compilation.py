"""How kernels are compiled, and kept on disk by Numba; and a note to users whose first command compiles them."""

import gc
import logging
import os
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from threading import Timer
from typing import Any, Protocol, TypeVar, overload

# else each overload that is tried in vain has its message coloured, a thirtieth of the time
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

from numba import njit
from numba.core import event as events

PATIENCE_S = 1.5  # time spent on compiling, s, after which the user is told why nothing happens

_Function = TypeVar("_Function", bound=Callable[..., Any])
_log = logging.getLogger(__name__)


class _Decorator(Protocol):
    """`@kernel`, or with further options of `numba.njit`, `@kernel(inline="always")`."""

    @overload
    def __call__(self, function: _Function, /) -> _Function: ...
    @overload
    def __call__(self, **options: Any) -> Callable[[_Function], _Function]: ...


kernel: _Decorator = partial(njit, cache=True, error_model="numpy", nogil=True, no_cfunc_wrapper=True)
"""Compiles a function when it is first called, for Python alone, without its checks of divisions and its lock."""
inner_kernel: _Decorator = partial(kernel, no_cpython_wrapper=True)
"""Compiles a function that only kernels call, in less time: Python, if it called it, would crash."""
inline_kernel: _Decorator = partial(inner_kernel, inline="always")
"""Makes a function that one kernel calls a part of that kernel: it is not compiled by itself."""


def clear_stale_kernels(package: Path) -> None:
    """Delete the compiled kernels of a package if any of its sources has changed since the last call.

    Numba compares the source of a kernel alone, not of those that it inlines.
    """
    cached = package / "__pycache__"
    with suppress(OSError):  # a folder that cannot be written: no kernels are cached there
        cached.mkdir(exist_ok=True)
        digest = sha256(b"\0".join(source.read_bytes() for source in sorted(package.rglob("*.py")))).digest()
        stamp = cached / "kernels.sha256"
        if not stamp.exists() or stamp.read_bytes() != digest:
            for compiled in package.rglob("__pycache__/*.nb[ic]"):
                compiled.unlink(missing_ok=True)
            stamp.write_bytes(digest)


class Compilations(events.Listener):
    """Follows compilations, which Numba runs one at a time, each with those of what it calls.

    It logs one line when a process has compiled kernels for PATIENCE_S; none if it reads them from the cache.
    """

    def __init__(self) -> None:
        self._depth, self._spent_s, self._announced = 0, 0.0, False

    def on_start(self, event: Any) -> None:
        """Start the clock."""
        if self._depth == 0:
            self._started_s = time.monotonic()
            self._collects = gc.isenabled()
            gc.disable()  # a compiler's many objects are all in use: to look for others takes a sixth of the time
            self._timer = Timer(max(PATIENCE_S - self._spent_s, 0), self._announce)
            self._timer.daemon = True  # does not delay the end of the program
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
