"""The clock of a rig: drivers and the press loop take all their times from it.

It is the host's `time.monotonic`, s. Tests put one in its place that stands still while a thread gets no processor.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_sources: list[tuple[Callable[[], float], Callable[[float], None]]] = [(time.monotonic, time.sleep)]


def now() -> float:
    """Return the time, s."""
    return _sources[-1][0]()


def sleep(seconds: float) -> None:
    """Wait until so much time has passed."""
    _sources[-1][1](seconds)


@contextmanager
def replaced(read: Callable[[], float], wait: Callable[[float], None]) -> Iterator[None]:
    """Take times from another clock in the body, in all threads of this process."""
    _sources.append((read, wait))
    try:
        yield
    finally:
        _sources.pop()
