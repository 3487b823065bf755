"""A clock that stands still while a thread which looks at it gets no processor: tests of rigs go by it.

On a busy machine a thread may wait for its turn longer than a driver waits for an answer. By this clock it does not:
time goes on with the slowest of the threads that look at it, for a driver and an emulated device alike.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from padforge.sense.rig import clock

STEP_S = 0.05  # by which a thread's time goes on at most from one look to the next
FORGOTTEN_S = 1.0  # after which a thread that looks no more holds up nobody
WAIT_S = 0.002


class SteadyClock:
    """Times from the host's on."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._now_s = time.monotonic()
        self._threads: dict[int, tuple[float, float]] = {}  # host time of the last look, and the thread's own time

    def now(self) -> float:
        """Return the time, s: that of the slowest thread."""
        host_s, thread = time.monotonic(), threading.get_ident()
        with self._lock:
            looked_s, own_s = self._threads.get(thread, (host_s, self._now_s))
            own_s = min(own_s + min(host_s - looked_s, STEP_S), self._now_s + STEP_S)
            self._threads[thread] = host_s, own_s
            slowest_s = min(own for looked, own in self._threads.values() if host_s - looked < FORGOTTEN_S)
            self._now_s = max(self._now_s, slowest_s)
            return self._now_s

    def sleep(self, seconds: float) -> None:
        end_s = self.now() + seconds
        while (remaining_s := end_s - self.now()) > 0:
            time.sleep(min(remaining_s, WAIT_S))


@contextmanager
def steady_clock() -> Iterator[SteadyClock]:
    """Have rigs, in all threads of this process, go by a steady clock."""
    steady = SteadyClock()
    with patch.multiple(clock, now=steady.now, sleep=steady.sleep):
        yield steady
