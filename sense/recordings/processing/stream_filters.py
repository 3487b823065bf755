"""Filters of streams: they take readings in blocks of any size and give what `filters` gives of the whole, as it comes.

A total variation is decided from the past on: each value is the next one clipped, and where a chain of clips has become
a constant no later reading matters any more. So a recording too long for memory is filtered exactly, a block at a time.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.validation import InputError, check_int

from padforge.sense.recordings.processing.filters import KERNELS, NOBODY, Fidelity, check_variation, checked_readings, median_of, window_reach
from padforge.sense.recordings.processing.kernels import clipping
from padforge.sense.recordings.processing.limits import MAX_FIBRES, Array

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
        self._lam, self._kernel, self._most_held = lam, KERNELS[fidelity], most_held
        self._message: Any = self._kernel.silent()
        self._low, self._high = np.empty((2, 0))
        self.decided = np.empty(0)
        self.latest = np.nan

    def feed(self, readings: Array) -> None:
        while len(readings):  # never more than may be held, so that it does not depend on the size of blocks
            room = self._most_held - len(self._low)
            piece, readings = readings[:room], readings[room:]
            low, high = np.empty((2, len(piece)))
            self.latest, self._message = self._kernel.forward_sweep(piece, self._lam, self._message, low, high, NOBODY)
            self._low, self._high = np.concatenate([self._low, low]), np.concatenate([self._high, high])
            self.settle(ended=False)

    def settle(self, ended: bool) -> None:
        """Decide what no later reading can change: all, if the stretch has ended or no more may be held."""
        values = np.empty(len(self._low))
        count = clipping.clip_back(self._low, self._high, self.latest, values)
        if ended or (count == 0 and len(values) == self._most_held):
            count, self._message = len(values), self._kernel.silent()
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
