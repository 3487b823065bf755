"""A board's serial port as bytes, both ways, with the time at which they came.

The thread that drains a board's port, so that nothing is lost while the program is busy.

Which inputs of a board are read, and whether it has them.

From the index of a sample, or the board's time of it, to the host's time, by when the blocks of samples arrived.
A block cannot arrive before its last sample was taken, and now and then one arrives with hardly any delay. The time of
a sample is therefore a straight line under all arrivals of the last minute, as high as it goes: late blocks do not
matter, and the slope is the board's clock against the host's. A delay that every block has in common cannot be seen
and stays in the times.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from padforge.sense.arrays import Array, Indices
from padforge.sense.rig.devices import RigFault, open_port

POLL_S = 0.1
"""The longest time `ByteStream.receive` waits."""


class ByteStream:
    """An open port. Any method but `close` raises RigFault("lost") once the board is gone."""

    def __init__(self, port: str, baud: int) -> None:
        """Open `port` for this process alone; raises RigFault("refused") where that cannot be."""
        self.port = port
        self._serial = open_port(port, baud, POLL_S)

    def receive(self) -> tuple[float, bytes]:
        """When bytes have come, after waiting for at most `POLL_S`, and all of them; none where nothing has."""
        try:
            data = self._serial.read(1)
            if data:
                data += self._serial.read(self._serial.in_waiting)
        except OSError as error:
            raise self._lost(error) from error
        return time.monotonic(), data

    def send(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self._serial.write(data)
        except OSError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Close the port; never raises."""
        with suppress(OSError):
            self._serial.close()

    def _lost(self, error: OSError) -> RigFault:
        return RigFault("lost", f"{self.port}: the board is gone ({error})", "check its cable and connect again")


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


def chosen_inputs(inputs: Sequence[int], there: int, board: str) -> tuple[int, ...]:
    """`inputs`, fibre by fibre, of a board that has 0 to `there` - 1; all of them where none is named.

    Raises:
        RigFault: "refused" for one that the board has not.
    """
    for fibre, number in enumerate(inputs, start=1):
        if not 0 <= number < there:
            message = f"[rig] channels: fibre {fibre} is on input {number}, {board} has 0 to {there - 1}"
            raise RigFault("refused", message, "it may take a board with more inputs")
    return tuple(inputs) or tuple(range(there))


Point = tuple[float, float]

_BUCKET_S = 1.0
"""Of the arrivals in so much time only the one with the least delay is kept."""
_BUCKETS = 60
QUARTZ_SKEW = 500e-6
"""Quartz against quartz; anything beyond is noise of the first seconds."""
_SLOWEST, _FASTEST = 0.5, 1.5
"""Limits of the step between two times given out, in periods, while a changed line is caught up with."""


class SampleClock:
    """Host times of what a board counts, learnt from arrivals.

    Args:
        period_s: of one count by the board's own clock: that of a sample, or 1e-6 where it counts microseconds.
        max_skew: share by which a count may really take longer or shorter.
    """

    def __init__(self, period_s: float, max_skew: float = QUARTZ_SKEW) -> None:
        self._period_s, self._max_skew = period_s, max_skew
        self._origin: tuple[int, float] | None = None
        self._lowest: Point | None = None
        self._buckets: deque[Point] = deque(maxlen=_BUCKETS)
        self._offset = 0.0
        self._slope = 0.0
        self._given: tuple[int, float] | None = None

    @property
    def skew_ppm(self) -> float:
        """How much longer than its nominal period a sample takes by the host's clock, in millionths."""
        return self._slope * 1e6

    def observe(self, index: int, arrival_s: float) -> None:
        """A block whose last sample is `index` (counted on without wrapping) arrived at `arrival_s`, host time."""
        if self._origin is None:
            self._origin = (index, arrival_s)
        start, start_s = self._origin
        nominal = (index - start) * self._period_s
        point = (nominal, arrival_s - start_s - nominal)
        if self._lowest is None or point[0] // _BUCKET_S > self._lowest[0] // _BUCKET_S:
            self._close_bucket(point)
        elif point[1] - self._slope * point[0] < self._lowest[1] - self._slope * self._lowest[0]:
            self._lowest = point
        self._offset = min(self._offset, point[1] - self._slope * point[0])

    def times(self, indices: Indices) -> Array:
        """(n,) host times in s of the samples of these indices; above all that were given before.

        Indices must ascend, also from call to call, and at least one block have been observed.
        """
        if self._origin is None:
            raise ValueError("no block has been observed")
        start, start_s = self._origin
        first, last = int(indices[0]), int(indices[-1])
        nominal = (last - start) * self._period_s
        end = start_s + nominal * (1 + self._slope) + self._offset
        before, before_s = self._given or (first - 1, end - (last - first + 1) * self._period_s)
        span = (last - before) * self._period_s
        end = min(max(end, before_s + _SLOWEST * span), before_s + _FASTEST * span)
        self._given = (last, end)
        steps = (indices - before).astype(np.float64)
        return before_s + steps * ((end - before_s) / (last - before))

    def _close_bucket(self, point: Point) -> None:
        if self._lowest is not None:
            self._buckets.append(self._lowest)
            self._offset, self._slope = _line_under(list(self._buckets), self._max_skew)
        self._lowest = point


def _line_under(points: list[Point], steepest: float) -> tuple[float, float]:
    """Offset and slope of the line under all `points`, by ascending x, that is highest at their mean x."""
    hull: list[Point] = []
    for point in points:
        while len(hull) > 1 and _slope(hull[-2], point) <= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(point)
    middle = sum(x for x, _ in points) / len(points)
    edge = next((i for i in range(1, len(hull)) if hull[i][0] >= middle), 0)
    slope = _slope(hull[edge - 1], hull[edge]) if edge else 0.0
    slope = min(max(slope, -steepest), steepest)
    return min(y - slope * x for x, y in points), slope


def _slope(left: Point, right: Point) -> float:
    return (right[1] - left[1]) / (right[0] - left[0])
