"""The clock of a rig, from which drivers and the press loop take all their times: the host's `time.monotonic`, s.

Tests replace it by a clock that stands still while a thread gets no processor.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_sources: list[tuple[Callable[[], float], Callable[[float], None]]] = [(time.monotonic, time.sleep)]


def now() -> float:
    """Return the time, s."""
    return _sources[-1][0]()


def sleep(seconds: float) -> None:
    """Wait for a time."""
    _sources[-1][1](seconds)


@contextmanager
def replaced(read: Callable[[], float], wait: Callable[[float], None]) -> Iterator[None]:
    """Return a context in which all threads of this process take their times from another clock."""
    _sources.append((read, wait))
    try:
        yield
    finally:
        _sources.pop()
