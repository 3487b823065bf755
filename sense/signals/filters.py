"""Filters of readings: total variation denoising, exact, and the running median; of recordings and of streams.

Total variation denoising keeps the steps that presses make and flattens what lies between. A missing reading is NaN:
it has no weight and takes the level of its neighbours. Channels are filtered independently. The published filter is
the robust one with lam = 4, or a median of 15 (T. G. Thuruthel, J. Hughes, F. Iida, IEEE Sensors J. 2020).

The filters of streams return what the filters of recordings do, for blocks of any size.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.parallel import map_chunks
from padforge.design.common.validation import InputError, check_float, check_int, check_type, short_repr
from padforge.sense.arrays import MAX_FIBRES, MAX_S, Array, Indices, check_magnitude, check_numbers
from padforge.sense.signals import filter_kernels

Fidelity = Literal["robust", "squares"]

_PASSES = {
    "robust": (filter_kernels.forward_pass_l1, filter_kernels.initial_message_l1),
    "squares": (filter_kernels.forward_pass_l2, filter_kernels.initial_message_l2),
}
MAX_VALUE = 1e100  # largest absolute reading, and lam: beyond, sums may overflow
MAX_WIDTH = 2**31 - 1  # largest width of a running median: no recording is longer
MAX_PENDING = 100_000  # readings of a channel that are held back: two hours at 13 Hz
_NOT_NEEDED = np.empty(0)  # in place of the causal values of a forward pass
_GRAIN = 20_000  # readings below which a thread costs more than it saves


def find_segment_starts(times_s: ArrayLike, max_interval_s: float) -> Indices:
    """Find where a recording with gaps starts anew, for `starts` of the filters.

    Args:
        times_s: ascending; shape (R,), s.
        max_interval_s: longest interval between two readings of a segment, above 0.

    Returns:
        Indices of the readings that follow a longer interval; shape (K,).

    Raises:
        InputError: times that are not finite, are beyond 1e10 s or do not ascend, or an interval that is not above 0.
    """
    times = check_numbers(times_s, np.float64, "times_s")
    check_magnitude("times_s", times.reshape(-1, 1), MAX_S, "s")
    if times.ndim != 1 or (np.diff(times) < 0).any():
        raise InputError(f"times_s are {short_repr(times_s)}, expected finite numbers that ascend")
    if not (interval := check_float("max_interval_s", max_interval_s, 0.0, 1e300)):
        raise InputError(f"max_interval_s is {max_interval_s!r}, allowed is a number above 0")
    return np.flatnonzero(np.diff(times) > interval) + 1


def total_variation(
    readings: ArrayLike, lam: float, fidelity: Fidelity = "robust", starts: ArrayLike = (), causal: bool = False
) -> Array:
    """Minimise fidelity + lam * sum |x_{i+1} - x_i| exactly (total variation denoising, fused lasso).

    The fidelity "robust" is sum |y_i - x_i|: outliers do not count by their distance, and lam counts readings, whatever
    the unit of y: a bump of fewer than 2 lam readings is removed. "squares" is 1/2 sum (y_i - x_i)^2: lam has the unit
    of y, and a bump of n readings is lowered by 2 lam / n. The robust minimiser is often not unique: from the last
    reading back, the middle of the choices is taken. Cost: O(R log min(R, lam)) for "robust", O(R) for "squares".

    Args:
        readings: any real type, NaN where missing (x then has the value of the next reading, else of the last; a
            channel without any stays NaN); shape (R,) or (R, C).
        lam: weight of the variation, above 0.
        fidelity: "robust" or "squares".
        starts: ascending indices of readings at which a new segment starts, independent of the one before; shape (K,).
        causal: return at each reading the last value of the minimiser up to there, as a live filter does; for
            "squares" in O(R K) with K knots, a dozen on noise, up to 2 R.

    Returns:
        The minimiser, float64 of the shape of `readings`.

    Raises:
        InputError: readings that are no numbers of such a shape, or beyond 1e100; lam, fidelity or starts that are not
            as above.
    """
    _check_variation(lam, fidelity)
    check_type("causal", causal, bool)
    forward_pass, initial_message = _PASSES[fidelity]

    def denoise(segment: Array) -> Array:
        low, high, out = np.empty((3, len(segment)))
        ends = out if causal else _NOT_NEEDED
        latest, _ = forward_pass(segment, float(lam), initial_message(), low, high, ends)
        if not causal:
            filter_kernels.backward_pass(low, high, latest, out)
        return out

    return _filter_channels(readings, starts, denoise)


def running_median(readings: ArrayLike, width: int, starts: ArrayLike = (), causal: bool = False) -> Array:
    """Compute the median of the readings around each; windows shrink at the ends of a segment. O(R width).

    NaN are ignored; an even number of readings has the mean of the two in the middle, none has NaN.

    Args:
        readings: any real type; shape (R,) or (R, C).
        width: readings in a window, odd.
        starts: as in `total_variation`.
        causal: the window ends at the reading, instead of having it in its middle.

    Returns:
        The medians, float64 of the shape of `readings`.

    Raises:
        InputError: readings or starts as in `total_variation`, or a width that is no odd whole number above 0.
    """
    window = _window(width, causal)
    return _filter_channels(readings, starts, lambda segment: _median(segment, *window))


class TotalVariation:
    """Total variation denoising of a stream: the values of `total_variation`, as soon as they are final.

    A channel of which `max_pending` readings are not final is finished as if the recording ended there and started anew
    with the next reading. So memory is bounded, by some 200 bytes for each of `max_pending` and channel.

    Args:
        channels: number of channels, C.
        lam: as in `total_variation`.
        fidelity: as in `total_variation`.
        max_pending: readings of a channel that are held back at most.

    Raises:
        InputError: an argument out of range.
    """

    def __init__(
        self, channels: int, lam: float, fidelity: Fidelity = "robust", max_pending: int = MAX_PENDING
    ) -> None:
        _check_variation(lam, fidelity)
        channels = check_int("channels", channels, 1, MAX_FIBRES)
        max_pending = check_int("max_pending", max_pending, 1, 2**31)
        self._channels = [_TvChannel(float(lam), fidelity, max_pending) for _ in range(channels)]

    @property
    def latest(self) -> Array:
        """(C,) last values of the minimiser so far, as `total_variation` with `causal`; NaN before a reading."""
        return np.array([channel.latest for channel in self._channels])

    def update(self, readings: ArrayLike) -> Array:
        """Process readings, and return the (m, C) values that have become final.

        Args:
            readings: (n, C), as in `total_variation`.
        """
        for channel, column in zip(self._channels, _check_block(readings, len(self._channels)), strict=True):
            channel.update(column)
        return self._pop_final()

    def flush(self) -> Array:
        """End a segment; return the (m, C) values that were pending."""
        for channel in self._channels:
            channel.finalise(is_end=True)
        return self._pop_final()

    def _pop_final(self) -> Array:
        count = min(len(channel.final) for channel in self._channels)
        values = np.column_stack([channel.final[:count] for channel in self._channels])
        for channel in self._channels:
            channel.final = channel.final[count:]
        return values


class _TvChannel:
    """A channel: the message to the next reading, bounds of the pending values, and final ones not yet returned."""

    def __init__(self, lam: float, fidelity: Fidelity, max_pending: int) -> None:
        self._lam, self._max_pending = lam, max_pending
        self._forward_pass, self._initial_message = _PASSES[fidelity]
        self._message: Any = self._initial_message()
        self._low, self._high = np.empty((2, 0))
        self.final = np.empty(0)
        self.latest = np.nan

    def update(self, readings: Array) -> None:
        while len(readings):  # never more than may be pending, so that the result does not depend on the size of blocks
            room = self._max_pending - len(self._low)
            piece, readings = readings[:room], readings[room:]
            low, high = np.empty((2, len(piece)))
            self.latest, self._message = self._forward_pass(piece, self._lam, self._message, low, high, _NOT_NEEDED)
            self._low, self._high = np.concatenate([self._low, low]), np.concatenate([self._high, high])
            self.finalise(is_end=False)

    def finalise(self, is_end: bool) -> None:
        """Compute the values that no later reading can change, or all at an end or if too many are pending."""
        values = np.empty(len(self._low))
        count = filter_kernels.backward_pass(self._low, self._high, self.latest, values)
        if is_end or (count == 0 and len(values) == self._max_pending):
            count, self._message = len(values), self._initial_message()
        self._low, self._high = self._low[count:].copy(), self._high[count:].copy()
        self.final = np.concatenate([self.final, values[:count]])


class RunningMedian:
    """Running median of a stream: the values of `running_median`, half a width later, or at once if `causal`.

    Args:
        channels: number of channels, C.
        width: as in `running_median`.
        causal: as in `running_median`.

    Raises:
        InputError: an argument out of range.
    """

    def __init__(self, channels: int, width: int, causal: bool = False) -> None:
        channels = check_int("channels", channels, 1, MAX_FIBRES)
        self._before, self._after = _window(width, causal)
        self._readings = np.empty((channels, 0))  # up to width - 1 are kept
        self._n_returned = 0  # of these, whose median has been returned

    def update(self, readings: ArrayLike) -> Array:
        """Process readings, and return the (m, C) medians that have become known.

        Args:
            readings: (n, C), as in `running_median`.
        """
        self._readings = np.concatenate([self._readings, _check_block(readings, len(self._readings))], axis=1)
        return self._pop_medians(max(self._readings.shape[1] - self._after, 0))

    def flush(self) -> Array:
        """End a segment; return the (m, C) medians that were pending."""
        medians = self._pop_medians(self._readings.shape[1])
        self._readings, self._n_returned = self._readings[:, :0], 0
        return medians

    def _pop_medians(self, end: int) -> Array:
        """Return medians up to reading `end`, and drop the readings that no later window has."""
        medians = np.stack([_median(column, self._before, self._after) for column in self._readings], axis=1)
        new = medians[self._n_returned : end]
        n_dropped = max(end - self._before, 0)
        self._readings, self._n_returned = self._readings[:, n_dropped:].copy(), end - n_dropped
        return new


def _filter_channels(readings: ArrayLike, starts: ArrayLike, apply: Callable[[Array], Array]) -> Array:
    """Apply a filter of segments (r,) to every segment of every channel."""
    array = _check_readings(readings)
    if array.ndim not in (1, 2):
        raise InputError(f"readings have shape {array.shape}, expected (R,) or (R, C)")
    count = len(array)
    first = check_numbers(starts, np.int64, "starts")
    if first.ndim != 1 or (np.diff(first) <= 0).any() or (len(first) and not 0 <= first[0] <= first[-1] < count):
        raise InputError(f"starts are {short_repr(starts)}, allowed are ascending indices of {count} readings")
    edges = [0, *first.tolist(), count]
    columns = np.ascontiguousarray(np.atleast_2d(array.T))
    out = np.empty_like(columns)

    def filter_chunk(begin: int, end: int) -> None:
        for c in range(begin, end):
            for start, stop in pairwise(edges):
                out[c, start:stop] = apply(columns[c, start:stop])

    map_chunks(filter_chunk, len(columns), 1 + _GRAIN // max(count, 1))
    return np.ascontiguousarray(out.T).reshape(array.shape)


def _median(segment: Array, before: int, after: int) -> Array:
    out = np.empty(len(segment))
    filter_kernels.running_median(segment, min(before, len(segment)), min(after, len(segment)), out)
    return out


def _window(width: int, causal: bool) -> tuple[int, int]:
    """Return how many readings before and after each are in its window."""
    if (width := check_int("width", width, 1, MAX_WIDTH)) % 2 != 1:
        raise InputError(f"width is {width!r}, allowed is an odd whole number above 0")
    return (width - 1, 0) if check_type("causal", causal, bool) else (width // 2, width // 2)


def _check_variation(lam: float, fidelity: str) -> None:
    if not isinstance(fidelity, str) or fidelity not in _PASSES:
        raise InputError(f"fidelity is {short_repr(fidelity)}, allowed is {' or '.join(_PASSES)}")
    if not check_float("lam", lam, 0.0, MAX_VALUE):
        raise InputError(f"lam is {lam!r}, allowed is a number above 0, up to {MAX_VALUE:g}")


def _check_readings(readings: ArrayLike) -> Array:
    array = check_numbers(readings, np.float64, "readings")
    beyond = np.abs(array) > MAX_VALUE
    if beyond.any():
        first = np.argwhere(beyond)[0].tolist()
        raise InputError(
            f"readings hold {array[beyond][0]:g} (first at {first}), allowed is up to {MAX_VALUE:g}, or NaN"
        )
    return array


def _check_block(readings: ArrayLike, channels: int) -> Array:
    """Check readings (n, C) of a stream, and transpose them to (C, n)."""
    array = _check_readings(readings)
    if array.ndim != 2 or array.shape[1] != channels:
        raise InputError(f"readings have shape {array.shape}, expected (n, {channels})")
    return np.ascontiguousarray(array.T)
