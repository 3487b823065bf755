"""Shared parts of the boards: the serial port, a thread that drains it, and the host times of samples."""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from padforge.sense.arrays import Array, Indices
from padforge.sense.rig import clock
from padforge.sense.rig.devices import BoardSamples, RigFault, SerialStream

POLL_S = 0.1  # longest wait for bytes
SETTLE_S = 0.5  # time of blocks before the first samples are returned, so that times depend on several arrivals
BUFFER_S = 60.0  # time of samples that are buffered for a program that does not read

_START_S = 1.5  # longest wait for settled times
_BUCKET_S = 1.0  # of the arrivals in a bucket only the one with the minimum delay counts
_MIN_STEP = 0.5  # between two returned times while the fitted line changes, in periods
_MAX_STEP = 1.5  # the same

Arrivals = list[tuple[float, Any]]
"""Blocks of samples with their host times; the length of a block is the number of its samples."""


class BlockReader(threading.Thread):
    """A thread that drains a port into a buffer, until it is stopped or something fails."""

    def __init__(self, port: str, receive: Callable[[], tuple[float, list[Any]]], rate_hz: float) -> None:
        """Prepare the thread; `receive` waits about `POLL_S` for blocks, and returns the host time and these."""
        super().__init__(name=f"reader of {port}", daemon=True)
        self._port, self._receive = port, receive
        self._capacity = round(BUFFER_S * rate_hz)
        self._arrivals: deque[tuple[float, Any]] = deque()
        self._n_buffered = 0
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._fault: RigFault | None = None

    def start_settled(self) -> None:
        """Start the thread, and return after `SETTLE_S` of blocks; RigFault("stale") if too few arrive."""
        self.start()
        deadline = clock.now() + _START_S
        while self._buffered_s() < SETTLE_S:
            self._raise_fault()
            if clock.now() > deadline:
                raise RigFault("stale", f"{self._port}: the board does not send", "reset it and connect again")
            clock.sleep(POLL_S)

    def run(self) -> None:
        """Fill the buffer until `stop` is called or a fault occurs."""
        try:
            self._fill()
        except RigFault as fault:
            self._fault = fault
        except Exception as error:  # a reader that dies silently would look like a pad at rest
            self._fault = RigFault("lost", f"{self._port}: the reader has failed ({error!r})")

    def drain(self) -> Arrivals:
        """Return the buffered blocks with their arrival times; if there are none, raise the thread's fault, if any."""
        with self._lock:
            arrivals = list(self._arrivals)
            self._arrivals.clear()
            self._n_buffered = 0
        if not arrivals:
            self._raise_fault()
        return arrivals

    def stop(self) -> None:
        """End the thread, within `POLL_S`."""
        self._stopped.set()
        if self.is_alive():
            self.join()

    def _raise_fault(self) -> None:
        if self._fault is not None:
            raise self._fault

    def _buffered_s(self) -> float:
        with self._lock:
            return self._arrivals[-1][0] - self._arrivals[0][0] if self._arrivals else 0.0

    def _fill(self) -> None:
        silent_s, last_s = 0.0, clock.now()
        while not self._stopped.is_set():
            now_s, blocks = self._receive()
            silent_s += min(now_s - last_s, 2 * POLL_S)  # the board is not blamed for time in which the host slept
            last_s = now_s
            for block in blocks:
                silent_s = 0.0
                with self._lock:
                    self._arrivals.append((now_s, block))
                    self._n_buffered += len(block)
                if self._n_buffered > self._capacity:
                    raise RigFault("data", f"{self._port}: nobody has read the samples for {BUFFER_S:g} s")
            if silent_s > 1.0:
                raise RigFault("stale", f"{self._port}: no sample for {silent_s:.1f} s", "reset the board")


class SerialBoard(ABC):
    """A board at a serial port; its subclasses implement the protocols.

    `rate_hz` is the number of samples a second, `inputs` the input of each fibre, from 0; () for all inputs in order.
    """

    _assembler: "SampleAssembler"

    def __init__(self, port: str, baud: int, rate_hz: float, inputs: Sequence[int] = ()) -> None:
        self._port, self._baud, self._rate_hz, self._inputs = port, baud, rate_hz, inputs
        self._stream: SerialStream | None = None
        self._reader: BlockReader | None = None

    def connect(self) -> dict[str, Any]:
        """Open the port, and return the board's identity once its times have settled; see `Board`."""
        self.close()
        self._stream = SerialStream(self._port, self._baud, POLL_S)
        try:
            return self._start(self._stream)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the port; never raises."""
        if self._reader is not None:
            self._reader.stop()
        if self._stream is not None:
            self._stream.close()
        self._stream = self._reader = None

    def read(self) -> BoardSamples:
        """Return all samples since the last call, volts; RigFault("refused") before `connect`. See `Board`."""
        if self._reader is None:
            raise RigFault("refused", f"{self._port}: not connected")
        return self._assembler.assemble(self._reader.drain())

    @abstractmethod
    def _start(self, stream: SerialStream) -> dict[str, Any]:
        """Set `_assembler`, start `_reader` on the open port, and return the board's identity."""


def select_inputs(inputs: Sequence[int], n_inputs: int) -> tuple[int, ...]:
    """Return the inputs to read, all in order if `inputs` is empty; RigFault("refused") for a missing input."""
    for fibre, number in enumerate(inputs, start=1):
        if not 0 <= number < n_inputs:
            message = f"[rig] channels: fibre {fibre} is on input {number}, the board has 0 to {n_inputs - 1}"
            raise RigFault("refused", message, "it may take a board with more inputs")
    return tuple(inputs) or tuple(range(n_inputs))


class Point(NamedTuple):
    """Arrival of a block."""

    nominal_s: float  # time by the board since the first block
    delay_s: float  # arrival since that of the first block, less this time


class SampleClock:
    """Converts a board's sample index or clock to host time, from the arrival times of its blocks.

    A block cannot arrive before its last sample was measured, and some blocks arrive with hardly any delay. The host
    time is therefore modelled as the highest straight line below all arrivals of the last minute: late blocks have no
    influence, and the slope is the relative rate of the board's clock, limited to `max_skew`. A delay common to all
    blocks cannot be observed and remains in the times.
    """

    def __init__(self, period_s: float, max_skew: float) -> None:
        self._period_s, self._max_skew = period_s, max_skew
        self._origin: tuple[int, float] | None = None  # index and arrival of the first block
        self._bucket_min: Point | None = None  # of the current bucket
        self._buckets: deque[Point] = deque(maxlen=60)  # minima of complete buckets
        self._offset = self._slope = 0.0  # of the fitted line, delay = offset + slope * nominal time
        self._last: tuple[int, float] | None = None  # index and time returned last

    def observe(self, index: int, arrival_s: float) -> None:
        """Add the arrival of a block whose last sample, or clock, has this unwrapped index."""
        if self._origin is None:
            self._origin = (index, arrival_s)
        start, start_s = self._origin
        nominal_s = (index - start) * self._period_s
        delay_s = arrival_s - start_s - nominal_s
        minimum = self._bucket_min
        is_new_bucket = minimum is None or nominal_s // _BUCKET_S > minimum.nominal_s // _BUCKET_S
        if minimum is not None and is_new_bucket:
            self._buckets.append(minimum)
            self._offset, self._slope = _fit_lower_line(list(self._buckets), self._max_skew)
        residual = delay_s - self._slope * nominal_s
        if minimum is None or is_new_bucket or residual < minimum.delay_s - self._slope * minimum.nominal_s:
            self._bucket_min = Point(nominal_s, delay_s)
        self._offset = min(self._offset, residual)

    def times(self, indices: Indices) -> Array:
        """Return ascending host times (n,), s, of ascending indices (n,), later than all returned before.

        Times follow a changed line by steps of `_MIN_STEP` to `_MAX_STEP` periods. Raises ValueError before the first
        `observe`.
        """
        if self._origin is None:
            raise ValueError("no block has been observed")
        start, start_s = self._origin
        first, last = int(indices[0]), int(indices[-1])
        nominal_s = (last - start) * self._period_s
        end_s = start_s + nominal_s * (1 + self._slope) + self._offset
        previous, previous_s = self._last or (first - 1, end_s - (last - first + 1) * self._period_s)
        span_s = (last - previous) * self._period_s
        end_s = min(max(end_s, previous_s + _MIN_STEP * span_s), previous_s + _MAX_STEP * span_s)
        self._last = (last, end_s)
        steps = (indices - previous).astype(np.float64)
        return previous_s + steps * ((end_s - previous_s) / (last - previous))


def _fit_lower_line(points: list[Point], max_slope: float) -> tuple[float, float]:
    """Return offset and slope of the line below all `points`, in order of time, that is highest at their mean time.

    Without the limit of the slope, it is the edge of the lower convex hull at the mean time.
    """
    hull: list[Point] = []  # lower convex hull, by Andrew's monotone chain
    for point in points:
        while len(hull) > 1 and _slope(hull[-2], point) <= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(point)
    mean_s = sum(point.nominal_s for point in points) / len(points)
    edge = next((i for i in range(1, len(hull)) if hull[i].nominal_s >= mean_s), 0)
    slope = _slope(hull[edge - 1], hull[edge]) if edge else 0.0
    slope = min(max(slope, -max_slope), max_slope)
    return min(point.delay_s - slope * point.nominal_s for point in points), slope


def _slope(a: Point, b: Point) -> float:
    return (b.delay_s - a.delay_s) / (b.nominal_s - a.nominal_s)


class SampleAssembler(ABC):
    """Converts samples to `BoardSamples`: host times by a clock, voltages of the fibres, numbers of lost samples.

    `columns` are those of the fibres in a sample's values, in units of `volts`.
    """

    def __init__(self, clock: SampleClock, columns: Sequence[int], volts: float) -> None:
        self._clock, self._columns, self._volts = clock, columns, volts

    def assemble(self, arrivals: Arrivals) -> BoardSamples:
        """Return the samples of blocks with their arrival times; RigFault("data") for repeated impossible ones."""
        indices, rows, gaps = [], [], []
        for arrival_s, block in arrivals:
            for sample in block:
                if (placed := self._place(sample)) is not None:
                    index, values, missing = placed
                    indices.append(index)
                    rows.append([values[column] for column in self._columns])
                    gaps.append(missing)
            if indices:
                self._clock.observe(indices[-1], arrival_s)
        return BoardSamples(
            self._clock.times(np.array(indices)) if indices else np.empty(0),
            np.array(rows, np.float64).reshape(-1, len(self._columns)) * self._volts,
            np.array(gaps, np.int64),
        )

    @abstractmethod
    def _place(self, sample: Any) -> tuple[int, Sequence[float], int] | None:
        """Return a sample's index by the clock, its values, and the number lost before it; None if it is dropped."""
