"""The thread that drains a board's port, so that nothing is lost while the program is busy."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from padforge.sense.rig.devices.protocols import RigFault

from padforge.sense.rig.boards.byte_stream import POLL_S

SETTLE_S = 0.5
"""Blocks gathered before the first reading is given, so that its time rests on more than one arrival."""
UNREAD_S = 60.0
"""So much is kept for a program that does not read."""

_START_S = 1.5
_STALL_S = 1.0


class Block(Protocol):
    """Samples that came together, (n, C) of them."""

    @property
    def counts(self) -> Any: ...


B = TypeVar("B", bound=Block)


class BlockReader(threading.Thread, Generic[B]):
    """Drains a port into a buffer, until stopped or something fails.

    Args:
        port: its name, for messages. receive: waits shortly for what comes next, and returns when that was and the
            blocks in it; may raise RigFault, which ends the reading. rate_hz: samples a second.
    """

    def __init__(self, port: str, receive: Callable[[], tuple[float, list[B]]], rate_hz: float) -> None:
        super().__init__(name=f"reader of {port}", daemon=True)
        self._port, self._receive = port, receive
        self._capacity = round(UNREAD_S * rate_hz)
        self._arrivals: deque[tuple[float, B]] = deque()
        self._waiting = 0
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._fault: RigFault | None = None

    def begin(self, nudge: Callable[[], object] = lambda: None) -> None:
        """Start, and return once `SETTLE_S` of blocks have come; until the first, `nudge` asks the board for them.

        Raises:
            RigFault: "stale" where none come, or as `receive`.
        """
        self.start()
        deadline = time.monotonic() + _START_S
        while self._span_s() < SETTLE_S:
            if self._span_s() == 0:
                nudge()
            self._check()
            if time.monotonic() > deadline:
                raise RigFault("stale", f"{self._port}: the board does not send", "reset it and connect again")
            time.sleep(POLL_S)

    def run(self) -> None:
        """The thread itself; see `begin`."""
        try:
            self._drain()
        except RigFault as fault:
            self._fault = fault
        except Exception as error:  # a reader that dies silently would look like a pad at rest
            self._fault = RigFault("lost", f"{self._port}: the reader has failed ({error!r})")

    def take(self) -> list[tuple[float, B]]:
        """All that waits, each with the time it came; raises the fault that ended the reading once nothing does."""
        with self._lock:
            arrivals = list(self._arrivals)
            self._arrivals.clear()
            self._waiting = 0
        if not arrivals:
            self._check()
        return arrivals

    def stop(self) -> None:
        """End the reading, within `POLL_S`."""
        self._stopped.set()
        if self.is_alive():
            self.join()

    def _check(self) -> None:
        if self._fault is not None:
            raise self._fault

    def _span_s(self) -> float:
        """Time between the first and the last arrival that wait."""
        with self._lock:
            return self._arrivals[-1][0] - self._arrivals[0][0] if self._arrivals else 0.0

    def _drain(self) -> None:
        silent_s, before_s = 0.0, time.monotonic()
        while not self._stopped.is_set():
            now_s, blocks = self._receive()
            silent_s += min(now_s - before_s, 2 * POLL_S)  # a host that slept has not waited in vain
            before_s = now_s
            for block in blocks:
                silent_s = 0.0
                self._put((now_s, block))
            if silent_s > _STALL_S:
                raise RigFault("stale", f"{self._port}: no sample for {silent_s:.1f} s", "reset the board")

    def _put(self, arrival: tuple[float, B]) -> None:
        with self._lock:
            self._arrivals.append(arrival)
            self._waiting += len(arrival[1].counts)
        if self._waiting > self._capacity:
            raise RigFault("data", f"{self._port}: nobody has read the samples for {UNREAD_S:g} s")
