"""A note to users whose first command compiles kernels, since later ones read them from disk."""

import logging
import time
from functools import cache
from threading import Timer
from typing import Any

PATIENCE_S = 1.5  # time spent on compiling, s, after which the user is told why nothing happens

_log = logging.getLogger(__name__)


@cache  # registered once
def announce_compilation() -> None:
    """Log one line when this process has compiled kernels for PATIENCE_S; none if it reads them from the cache."""
    from numba.core import event as events

    class Announcer(events.Listener):
        """Adds up the time of compilations, which numba runs one at a time, each with those of what it calls."""

        def __init__(self) -> None:
            self._depth, self._spent_s = 0, 0.0

        def on_start(self, event: Any) -> None:
            """Start the clock."""
            if self._depth == 0:
                self._started_s = time.monotonic()
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

        def _announce(self) -> None:
            events.unregister("numba:compile", self)
            _log.info("compiling kernels, which takes up to a minute and is done once")

    events.register("numba:compile", Announcer())
