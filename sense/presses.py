"""From readings to presses: what the localizer is given of each fibre for each press.

Inputs are (Q, C, F): F numbers of each fibre, made of that fibre's readings alone, so that a lost fibre can be masked
and takes nothing of the others with it. Readings are counted from the one at which the probe was sent down or up; a
window that would reach into a neighbouring press is filled with the nearest reading that does not.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Window = tuple[int, int]

REST: Window = (-10, 0)
"""Readings before the probe is sent down whose mean is the rest that windows are measured from."""
DOWN: tuple[Window, ...] = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Windows after the probe was sent down: fine while it sinks in, broad while it rests in the silicone."""
UP: tuple[Window, ...] = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 6), (6, 9), (9, 14), (14, 20))
"""Windows after the probe was sent up: the release tells as much of the place as the press."""
MEDIAN = 15
"""Width of the published running median, readings."""


def window_inputs(readings: Array, begun: Indices, lifted: Indices) -> Array:
    """Means over windows of the press and its release, minus the mean at rest before it.

    Args:
        readings: (R, C) volts. begun, lifted: (Q,) first reading after the probe was sent down, and up.

    Returns:
        (Q, C, 17) volts.
    """
    free, following = _neighbours(begun, lifted, len(readings))
    rest = _gather(readings, begun, REST, free, begun).mean(axis=1)
    down = [_gather(readings, begun, window, begun, lifted).mean(axis=1) for window in DOWN]
    up = [_gather(readings, lifted, window, begun, following).mean(axis=1) for window in UP]
    return np.stack(down + up, axis=2) - rest[:, :, None]


def published_inputs(readings: Array, begun: Indices, lifted: Indices) -> Array:
    """The published inputs: the running median of 15 readings before, in and after the press.

    Args and returns as `window_inputs`, but (Q, C, 3) volts.
    """
    free, following = _neighbours(begun, lifted, len(readings))
    reach = (-(MEDIAN // 2), MEDIAN // 2 + 1)
    ranges = ((begun - 10, free, begun), (begun + 10, begun, lifted), (lifted + 10, begun, following))
    return np.stack([np.median(_gather(readings, at, reach, low, high), axis=1) for at, low, high in ranges], axis=2)


INPUTS: dict[str, Callable[[Array, Indices, Indices], Array]] = {
    "windows": window_inputs,
    "published": published_inputs,
}
"""How the inputs of `[localizer] features` are made."""
SIZES = {"windows": len(DOWN) + len(UP), "published": 3}
"""F, how many numbers of each fibre they are."""


def _neighbours(begun: Indices, lifted: Indices, readings: int) -> tuple[Indices, Indices]:
    """(Q,) the first reading that no earlier press owns, and the first that belongs to the next press."""
    return np.concatenate([[0], lifted[:-1]]), np.concatenate([begun[1:], [readings]])


def _gather(readings: Array, at: Indices, window: Window, low: Indices, high: Indices) -> Array:
    """(Q, W, C) readings `at` + window, held within low <= index < high (and within the readings)."""
    index = at[:, None] + np.arange(*window)
    high = np.minimum(high, len(readings))
    return readings[np.clip(index, low[:, None], high[:, None] - 1)]
