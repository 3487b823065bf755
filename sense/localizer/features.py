"""From readings to presses: what the localizer is given of each fibre for each press.

Inputs are (Q, C, F): F numbers of each fibre, made of that fibre's readings alone, so that a lost fibre can be masked
and takes nothing of the others with it. Readings are counted from the one at which the probe was sent down or up; a
window that would reach into a neighbouring press is filled with the nearest reading that does not. What the fibre gave
before the press, its history, is kept apart (`response_model` says what of it still shows).

Readings may be missing (NaN): short gaps are bridged, and a fibre that lacks too much of a press counts as lost in it.
"""

from dataclasses import dataclass

import numpy as np

from padforge.sense.recordings.processing.limits import Array, Indices, Mask

Window = tuple[int, int]

REST: Window = (-10, 0)
"""Readings before the probe is sent down whose mean is the rest that windows are measured from."""
DOWN: tuple[Window, ...] = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Windows after the probe was sent down: fine while it sinks in, broad while it rests in the silicone."""
EARLY = 6
"""Of them, those over by the sixth reading after the touch, which comes two after the command."""
UP: tuple[Window, ...] = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 6), (6, 9), (9, 14), (14, 20))
"""Windows after the probe was sent up: the release tells as much of the place as the press."""
PAST: tuple[Window, ...] = (
    *((-2, 0), (-5, -2), (-10, -5), (-15, -10), (-18, -15), (-20, -18), (-30, -20), (-40, -30)),
    *((-50, -40), (-60, -50), (-80, -60), (-100, -80), (-120, -100), (-160, -120)),
)
"""Windows before the probe was sent down: silicone remembers what was done to it for seconds to minutes."""
SLOW = (800, 4000)
"""Lengths before the press, readings, whose medians are the fibre's settled rest: a minute and five at 13 Hz."""
SLOW_SAMPLES = 200
"""Readings that such a median is taken of."""
MEDIAN = 15
"""Width of the published running median, readings."""
LEAST_THERE = 0.75
"""Share of a press's readings that a fibre must have given to count."""

FEATURES = ("full", "causal", "early", "published")
"""What inputs are made of: press and release, the press up to its end, its first readings, or the published values."""
SIZES = {"full": len(DOWN) + len(UP), "causal": len(DOWN), "early": EARLY, "published": 3}
"""F, how many numbers of each fibre they are."""
PHASES = {
    "full": (slice(2, 5), slice(5, 9), slice(12, 17)),
    "causal": (slice(2, 5), slice(5, 9)),
    "early": (slice(2, 6),),
    "published": (),
}
"""Windows in which a fibre answers more or less strongly together: while the probe sinks in, rests, and has gone."""
PASTS = {"full": len(PAST) + len(SLOW), "causal": len(PAST) + len(SLOW), "early": len(PAST) + len(SLOW), "published": 0}
"""J, how many numbers of its history."""


@dataclass(frozen=True)
class Inputs:
    """What readings say of Q presses.

    Attributes:
        windows: (Q, C, F) V. history: (Q, C, J) V, relative to the rest before the press.
        alive: (Q, C) whether the fibre gave enough readings to count.
    """

    windows: Array
    history: Array
    alive: Mask

    def __getitem__(self, rows: Indices | slice) -> "Inputs":
        return Inputs(self.windows[rows], self.history[rows], self.alive[rows])

    def __add__(self, other: "Inputs") -> "Inputs":
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("windows", "history", "alive"))
        return Inputs(*(np.concatenate(pair) for pair in pairs))

    def __len__(self) -> int:
        return len(self.windows)


def press_inputs(readings: Array, begun: Indices, lifted: Indices, features: str) -> Inputs:
    """The inputs of every press.

    Args:
        readings: (R, C) volts, NaN where missing. begun, lifted: (Q,) first reading after the probe was sent down, up.
        features: one of `FEATURES`.
    """
    filled = bridged(readings)
    alive = _there(readings, begun, lifted, features)
    if features == "published":
        return Inputs(published_inputs(filled, begun, lifted), np.empty((*alive.shape, 0)), alive)
    windows = window_inputs(filled, begun, lifted, release=features == "full")
    return Inputs(windows[:, :, : SIZES[features]], history(filled, begun), alive)


def bridged(readings: Array) -> Array:
    """(R, C) readings with gaps filled along straight lines, and 0 for a fibre that never gave any."""
    missing = np.isnan(readings)
    if not missing.any():
        return readings
    filled = np.where(missing, 0.0, readings)
    rows = np.arange(len(readings))
    for fibre in np.flatnonzero(missing.any(axis=0) & ~missing.all(axis=0)):
        gone = missing[:, fibre]
        filled[gone, fibre] = np.interp(rows[gone], rows[~gone], readings[~gone, fibre])
    return filled


def _there(readings: Array, begun: Indices, lifted: Indices, features: str) -> Mask:
    """(Q, C) whether enough of a press's readings are there, from its rest to the end of what `features` looks at."""
    counts = np.vstack([np.zeros((1, readings.shape[1])), np.cumsum(~np.isnan(readings), axis=0)])
    first = np.maximum(begun + REST[0], 0)
    ends = lifted if features in ("causal", "early") else lifted + UP[-1][1]
    ends = np.minimum(ends, len(readings))
    return counts[ends] - counts[first] >= LEAST_THERE * (ends - first)[:, None]


def window_inputs(readings: Array, begun: Indices, lifted: Indices, release: bool = True) -> Array:
    """Means over windows of the press and its release, minus the mean at rest before it.

    Args:
        readings: (R, C) volts, none missing. begun, lifted: (Q,) first reading after the probe was sent down, and up.
        release: whether the windows after the release are wanted.

    Returns:
        (Q, C, 17) volts, or (Q, C, 9).
    """
    free, following = _neighbours(begun, lifted, len(readings))
    rest = _gather(readings, begun, REST, free, begun).mean(axis=1)
    means = [_gather(readings, begun, window, begun, lifted).mean(axis=1) for window in DOWN]
    if release:
        means += [_gather(readings, lifted, window, begun, following).mean(axis=1) for window in UP]
    return np.stack(means, axis=2) - rest[:, :, None]


def history(readings: Array, begun: Indices) -> Array:
    """What each fibre gave before the presses, relative to the rest just before: windows, then slow medians.

    Whatever was recorded counts, whether or not a press is known there.

    Args:
        readings: (R, C) volts, none missing. begun: (Q,).

    Returns:
        (Q, C, 16) volts.
    """
    level = readings[0]  # taken off, so that long sums keep their digits
    sums = np.vstack([np.zeros((1, readings.shape[1])), np.cumsum(readings - level, axis=0)])

    def mean(window: Window) -> Array:
        first = np.maximum(begun + window[0], 0)
        end = np.maximum(begun + window[1], first + 1)
        return (sums[end] - sums[first]) / (end - first)[:, None] + level

    rest = mean(REST)
    windows = [mean(window) for window in PAST]
    slow = [_settled(readings, begun, length) for length in SLOW]
    return np.stack(windows + slow, axis=2) - rest[:, :, None]


def _settled(readings: Array, begun: Indices, length: int) -> Array:
    """(Q, C) medians of some readings spread over the `length` before each press."""
    offsets = np.arange(-length, 0, length // SLOW_SAMPLES)
    out = np.empty((len(begun), readings.shape[1]))
    for part in range(0, len(begun), 1024):
        index = np.maximum(begun[part : part + 1024, None] + offsets, 0)
        out[part : part + 1024] = np.median(readings[index], axis=1)
    return out


def published_inputs(readings: Array, begun: Indices, lifted: Indices) -> Array:
    """The published inputs: the running median of 15 readings before, in and after the press.

    Args and returns as `window_inputs`, but (Q, C, 3) volts.
    """
    free, following = _neighbours(begun, lifted, len(readings))
    reach = (-(MEDIAN // 2), MEDIAN // 2 + 1)
    ranges = ((begun - 10, free, begun), (begun + 10, begun, lifted), (lifted + 10, begun, following))
    return np.stack([np.median(_gather(readings, at, reach, low, high), axis=1) for at, low, high in ranges], axis=2)


def _neighbours(begun: Indices, lifted: Indices, readings: int) -> tuple[Indices, Indices]:
    """(Q,) the first reading that no earlier press owns, and the first that belongs to the next press."""
    return np.concatenate([[0], lifted[:-1]]), np.concatenate([begun[1:], [readings]])


def _gather(readings: Array, at: Indices, window: Window, low: Indices, high: Indices) -> Array:
    """(Q, W, C) readings `at` + window, held within low <= index < high (and within the readings)."""
    index = at[:, None] + np.arange(*window)
    high = np.minimum(high, len(readings))
    return readings[np.clip(index, low[:, None], high[:, None] - 1)]
