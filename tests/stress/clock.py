"""What stress tests share: a clock that ends what hangs, and how many cases are tried.

Everyday runs try few cases of each kind; `pytest tests/stress --hypothesis-profile=stress` tries a thousand.
"""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event

LIMIT_S = 10
"""Beyond this a call counts as hung."""


class Hung(BaseException):
    """Work did not end in time; no code under test catches this."""


class Compiling(event.Listener):
    """How long kernels have been compiled: where none are kept yet, that is no hang."""

    def __init__(self) -> None:
        self.begun: list[float] = []
        self.seconds = 0.0

    def on_start(self, event: event.Event) -> None:
        self.begun.append(time.monotonic())

    def on_end(self, event: event.Event) -> None:
        if self.begun:
            begin = self.begun.pop()
            self.seconds += 0 if self.begun else time.monotonic() - begin

    def so_far(self) -> float:
        return self.seconds + (time.monotonic() - self.begun[0] if self.begun else 0)


@contextmanager
def ends_in_time(limit_s: float = LIMIT_S) -> Iterator[None]:
    """Raise Hung in the main thread where the body takes longer than `limit_s`, compilation aside."""
    begin, compiling = time.monotonic(), Compiling()

    def ring(number: int, frame: object) -> None:
        left = limit_s - (time.monotonic() - begin - compiling.so_far())
        if left <= 0 and not compiling.begun:
            raise Hung(f"not done after {limit_s} s")
        signal.setitimer(signal.ITIMER_REAL, max(left, 0.1))

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        with event.install_listener("numba:compile", compiling):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
