"""Filters of readings: total-variation denoising, exact, and the running median (`stream_filters` has both of streams).
Total-variation denoising keeps the steps that presses make and flattens what lies between. A missing reading is NaN:
it counts for nothing and is bridged at its neighbours' level. Channels are filtered each by itself.
References: the published filter is the robust one with lam = 4, or a median of 15 (T. G. Thuruthel, J. Hughes, F. Iida,
IEEE Sensors J. 2020); the algorithms are those of `kernels.total_variation_l1` and `kernels.total_variation_l2`.

Filters of streams: they take readings in blocks of any size and give what `filters` gives of the whole, as it comes.
A total variation is decided from the past on: each value is the next one clipped, and where a chain of clips has become
a constant no later reading matters any more. So a recording too long for memory is filtered exactly, a block at a time.
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

KERNELS = {
    "robust": (filter_kernels.forward_sweep_l1, filter_kernels.silent_l1),
    "squares": (filter_kernels.forward_sweep_l2, filter_kernels.silent_l2),
}
GREATEST = 1e100
"""Greatest amount of a reading and of lam: beyond, sums may overflow."""
WIDEST = 2**31 - 1
"""Greatest width of a running median: no recording is longer."""
NOBODY = np.empty(0)
"""In place of the causal values of a forward pass where nobody asks for them."""

_GRAIN = 20_000  # readings below which a thread costs more than it saves


def stretches(times_s: ArrayLike, longest_s: float) -> Indices:
    """Where a recording with gaps begins anew: indices of the readings that follow a longer interval than `longest_s`.

    Args:
        times_s: (R,) ascending, s. longest_s: above 0.

    Returns:
        (K,) ascending, for `starts` of the filters.

    Raises:
        InputError: times that are not finite, beyond 1e10 s or do not ascend, or an interval that is not above 0.
    """
    times = check_numbers(times_s, np.float64, "times_s")
    if times.ndim != 1:
        raise InputError(f"times_s have shape {times.shape}, expected (R,)")
    check_magnitude("times_s", times[:, None], MAX_S, "s")
    if (np.diff(times) < 0).any():
        raise InputError(f"times_s are {short_repr(times_s)}, expected finite numbers that ascend")
    if not (longest := check_float("longest_s", longest_s, 0.0, 1e300)):
        raise InputError(f"longest_s is {longest_s!r}, allowed is a number above 0")
    return np.flatnonzero(np.diff(times) > longest) + 1


def total_variation(
    readings: ArrayLike, lam: float, fidelity: Fidelity = "robust", starts: ArrayLike = (), causal: bool = False
) -> Array:
    """The exact minimiser x of fidelity + lam * sum |x_{i+1} - x_i|.

    The fidelity "robust" is sum |y_i - x_i|: outliers do not count by how far they are off, and lam counts readings,
    whatever the unit of y: a bump of fewer than 2 lam readings is cut. "squares" is 1/2 sum (y_i - x_i)^2: lam has the
    unit of y, and a bump of n readings is lowered by 2 lam / n. The robust minimum is often not one point alone: going
    back from the last reading, each choice between places is for the middle of them.

    Takes O(R log min(R, lam)) for "robust" and O(R) for "squares".

    Args:
        readings: (R,) or (R, C) of any real type, NaN where one is missing: there x has the value of the next present
            reading, else of the last. A channel without any stays NaN.
        lam: above 0.
        starts: (K,) ascending indices at which a new stretch begins: nothing is coupled across (see `stretches`).
        causal: give at each reading the last value of the minimiser of its stretch up to there, what a live filter
            knows. For "squares" this takes O(R K) for K knots: a dozen on noise, up to 2 R.

    Returns:
        float64 of the shape of `readings`.

    Raises:
        InputError: readings that are no numbers of such a shape, or beyond 1e100; lam, fidelity or starts that are not
            as above.
    """
    check_variation(lam, fidelity)
    check_type("causal", causal, bool)
    forward_sweep, silent = KERNELS[fidelity]

    def denoise(stretch: Array) -> Array:
        low, high, out = np.empty((3, len(stretch)))
        latest, _ = forward_sweep(stretch, float(lam), silent(), low, high, out if causal else NOBODY)
        if not causal:
            filter_kernels.clip_back(low, high, latest, out)
        return out

    return _by_channel(readings, starts, denoise)


def running_median(readings: ArrayLike, width: int, starts: ArrayLike = (), causal: bool = False) -> Array:
    """The median of the `width` readings around each, or up to each; windows shrink at the ends of a stretch.

    NaN are left out of their windows; where the number left is even it is the mean of the two in the middle, where
    none is left NaN. Takes O(R width), most of it short moves of memory.

    Args:
        readings: (R,) or (R, C) of any real type. width: odd. starts: as `total_variation`.
        causal: the window ends at the reading, instead of having it in its middle.

    Returns:
        float64 of the shape of `readings`.

    Raises:
        InputError: readings or starts as `total_variation`, or a width that is no odd whole number above 0.
    """
    before, after = window_reach(width, causal)
    return _by_channel(readings, starts, lambda stretch: median_of(stretch, before, after))


def median_of(stretch: Array, before: int, after: int) -> Array:
    """(R,) medians of the readings i - before .. i + after that there are in a stretch (R,)."""
    out = np.empty(len(stretch))
    filter_kernels.running_median(stretch, min(before, len(stretch)), min(after, len(stretch)), out)
    return out


def _by_channel(readings: ArrayLike, starts: ArrayLike, work: Callable[[Array], Array]) -> Array:
    """What `work` makes of every stretch (r,) of every channel, in the shape of the readings."""
    array = checked_readings(readings)
    if array.ndim not in (1, 2):
        raise InputError(f"readings have shape {array.shape}, expected (R,) or (R, C)")
    count = len(array)
    columns = np.ascontiguousarray(np.atleast_2d(array.T))
    edges = [0, *_checked_starts(starts, count), count]
    out = np.empty_like(columns)

    def filter_channels(begin: int, end: int) -> None:
        for c in range(begin, end):
            for first, last in pairwise(edges):
                out[c, first:last] = work(columns[c, first:last])

    map_chunks(filter_channels, len(columns), 1 + _GRAIN // max(count, 1))
    return np.ascontiguousarray(out.T).reshape(array.shape)


def checked_readings(readings: ArrayLike) -> Array:
    """Readings as float64, of any shape.

    Raises:
        InputError: they are no real numbers, or beyond GREATEST.
    """
    array = check_numbers(readings, np.float64, "readings")
    beyond = np.abs(array) > GREATEST
    if beyond.any():
        first = np.argwhere(beyond)[0].tolist()
        raise InputError(
            f"readings hold {array[beyond][0]:g} (first at {first}), allowed is {-GREATEST:g} to {GREATEST:g}, "
            "or NaN for one that is missing"
        )
    return array


def _checked_starts(starts: ArrayLike, readings: int) -> list[int]:
    array = check_numbers(starts, np.int64, "starts")
    if array.ndim != 1 or (np.diff(array) <= 0).any() or (len(array) and not 0 <= array[0] <= array[-1] < readings):
        raise InputError(f"starts are {short_repr(starts)}, allowed are ascending indices of {readings} readings")
    return array.tolist()


def check_variation(lam: float, fidelity: str) -> None:
    """Raise InputError unless `total_variation` takes these."""
    if not isinstance(fidelity, str) or fidelity not in KERNELS:
        raise InputError(f"fidelity is {short_repr(fidelity)}, allowed is {' or '.join(KERNELS)}")
    if not check_float("lam", lam, 0.0, GREATEST):
        raise InputError(f"lam is {lam!r}, allowed is a number above 0, up to {GREATEST:g}")


def window_reach(width: int, causal: bool) -> tuple[int, int]:
    """How many readings before and after each are in the window of a running median.

    Raises:
        InputError: a width that is no odd whole number above 0.
    """
    if (width := check_int("width", width, 1, WIDEST)) % 2 != 1:
        raise InputError(f"width is {width!r}, allowed is an odd whole number above 0")
    return (width - 1, 0) if check_type("causal", causal, bool) else (width // 2, width // 2)


MOST_HELD = 100_000
"""Readings of a channel that are held back undecided, at most: two hours at 13 Hz."""


class TotalVariation:
    """`filters.total_variation` of a stream: the same values, as soon as no later reading can change them.

    A channel of which `most_held` readings are undecided is decided as if the recording ended there and began anew
    with the next reading. So memory is bounded: by some 200 bytes for each of `most_held`, a channel, while a block is
    taken. What is fed takes time in proportion to itself and to what is held.
    """

    def __init__(self, channels: int, lam: float, fidelity: Fidelity = "robust", most_held: int = MOST_HELD) -> None:
        """A stream of (n, `channels`) readings; `lam` and `fidelity` as `filters.total_variation`.

        Raises:
            InputError: an argument out of range.
        """
        check_variation(lam, fidelity)
        channels, most_held = (
            check_int("channels", channels, 1, MAX_FIBRES),
            check_int("most_held", most_held, 1, 2**31),
        )
        self._channels = [_Channel(float(lam), fidelity, most_held) for _ in range(channels)]

    @property
    def latest(self) -> Array:
        """(C,) the last value of the minimiser of the stretch so far, what a live filter knows; NaN before a reading.

        It is what `total_variation` with `causal` gives.
        """
        return np.array([channel.latest for channel in self._channels])

    def feed(self, readings: ArrayLike) -> Array:
        """Take (n, C) readings; return the (m, C) values decided since the last call, in order.

        Raises:
            InputError: readings as `filters.total_variation`, or another number of channels.
        """
        for channel, column in zip(self._channels, _block(readings, len(self._channels)), strict=True):
            channel.feed(column)
        return self._decided()

    def finish(self) -> Array:
        """End the recording, or a stretch of it: return the (m, C) values left. What is fed next begins anew."""
        for channel in self._channels:
            channel.settle(ended=True)
        return self._decided()

    def _decided(self) -> Array:
        count = min(len(channel.decided) for channel in self._channels)
        return np.column_stack([channel.take(count) for channel in self._channels])


class _Channel:
    """One channel: the message that the next reading meets, the clips of values not decided, and values that wait."""

    def __init__(self, lam: float, fidelity: Fidelity, most_held: int) -> None:
        self._lam, self._most_held = lam, most_held
        self._forward_sweep, self._silent = KERNELS[fidelity]
        self._message: Any = self._silent()
        self._low, self._high = np.empty((2, 0))
        self.decided = np.empty(0)
        self.latest = np.nan

    def feed(self, readings: Array) -> None:
        while len(readings):  # never more than may be held, so that it does not depend on the size of blocks
            room = self._most_held - len(self._low)
            piece, readings = readings[:room], readings[room:]
            low, high = np.empty((2, len(piece)))
            self.latest, self._message = self._forward_sweep(piece, self._lam, self._message, low, high, NOBODY)
            self._low, self._high = np.concatenate([self._low, low]), np.concatenate([self._high, high])
            self.settle(ended=False)

    def settle(self, ended: bool) -> None:
        """Decide what no later reading can change: all, if the stretch has ended or no more may be held."""
        values = np.empty(len(self._low))
        count = filter_kernels.clip_back(self._low, self._high, self.latest, values)
        if ended or (count == 0 and len(values) == self._most_held):
            count, self._message = len(values), self._silent()
        self._low, self._high = self._low[count:].copy(), self._high[count:].copy()
        self.decided = np.concatenate([self.decided, values[:count]])

    def take(self, count: int) -> Array:
        """Hand over the first of the decided values."""
        taken, self.decided = self.decided[:count], self.decided[count:]
        return taken


class RunningMedian:
    """`filters.running_median` of a stream: the same values, half a width later, or at once if `causal`.

    It holds `width` - 1 readings; what is fed takes time in proportion to `width` times itself and those.
    """

    def __init__(self, channels: int, width: int, causal: bool = False) -> None:
        """A stream of (n, `channels`) readings; `width` and `causal` as `filters.running_median`.

        Raises:
            InputError: an argument out of range.
        """
        channels = check_int("channels", channels, 1, MAX_FIBRES)
        self._before, self._after = window_reach(width, causal)
        self._held = np.empty((channels, 0))
        self._given = 0  # of the readings held, those whose median has been given

    def feed(self, readings: ArrayLike) -> Array:
        """Take (n, C) readings; return the (m, C) medians known since the last call, in order.

        Raises:
            InputError: readings as `filters.running_median`, or another number of channels.
        """
        self._held = np.concatenate([self._held, _block(readings, len(self._held))], axis=1)
        return self._known(max(self._held.shape[1] - self._after, 0))

    def finish(self) -> Array:
        """End the recording, or a stretch of it: return the (m, C) medians left. What is fed next begins anew."""
        left = self._known(self._held.shape[1])
        self._held, self._given = self._held[:, :0], 0
        return left

    def _known(self, end: int) -> Array:
        """Medians up to reading `end` of those held; readings that no later window has go."""
        medians = np.stack([median_of(column, self._before, self._after) for column in self._held], axis=1)
        known = medians[self._given : end]
        gone = max(end - self._before, 0)
        self._held, self._given = self._held[:, gone:].copy(), end - gone
        return known


def _block(readings: ArrayLike, channels: int) -> Array:
    """(C, n) of readings (n, C)."""
    array = checked_readings(readings)
    if array.ndim != 2 or array.shape[1] != channels:
        raise InputError(f"readings have shape {array.shape}, expected (n, {channels})")
    return np.ascontiguousarray(array.T)
