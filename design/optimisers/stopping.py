"""When a search ends before it is done: on Ctrl-C, or when its time is up."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

RESERVE = 0.15  # share of a time budget kept for repairing
MENDING_S = 3.0  # of repair after Ctrl-C
LATEST_S = 10.0  # after a deadline, for slices at work: one takes a second or so, but an executor may hang


class Stop:
    """Whether to go on: until Ctrl-C or a deadline of `time.perf_counter`."""

    def __init__(self, begin: float, time_budget: float | None) -> None:
        self.deadline = None if time_budget is None else begin + (1 - RESERVE) * time_budget
        self.end = None if time_budget is None else begin + time_budget
        self.reason = ""
        self._again = False

    def interrupt(self) -> None:
        self._again = self.reason == "interrupted"
        self.reason = "interrupted"

    def given_up(self, elsewhere: bool) -> bool:
        """Whether slices at work are not waited for any longer: after a second Ctrl-C, or long after the deadline.

        Args:
            elsewhere: whether they are on an executor, which may hang; here, they do end.
        """
        late = elsewhere and bool(self) and self.deadline is not None and time.perf_counter() > self.deadline + LATEST_S
        return self._again or late

    def mend_until(self) -> float:
        """When to end the repair of the best so far."""
        return self.end if self.reason == "out of time" and self.end else time.perf_counter() + MENDING_S

    def __bool__(self) -> bool:
        if not self.reason and self.deadline is not None and time.perf_counter() > self.deadline:
            self.reason = "out of time"
        return bool(self.reason)


@contextmanager
def stopped_by_interrupt(stop: Stop) -> Iterator[None]:
    """Let Ctrl-C set `stop` instead of tearing down threads; outside the main thread, where none arrives, nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.interrupt())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
