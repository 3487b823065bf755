"""Forward pass of total-variation denoising by squares: min 1/2 sum (y_i - x_i)^2 + lam sum |x_{i+1} - x_i|.

The message of reading i is the least cost of all up to it as a function of x_i. Its derivative is piecewise linear
and rising; a reading adds x - y_i, the coupling to the next cuts all beyond +-lam off, and where it does so are the
places x_i is clipped to (N. Johnson, J. Comput. Graph. Stat. 22, 2013; L. Condat, IEEE Signal Process. Lett. 20, 2013,
has the same geometry as a taut string). Each cut leaves a knot; knots beyond the next cut never matter again, so
finding a cut pools them with the new reading as pooled adjacent violators are, O(1) a reading on average.
"""

from typing import Any

import numpy as np
from numba import njit

PLACE, SUM, LAMS, COUNT = range(4)

Message = tuple[Any, Any]
"""(1,) the first reading, NaN before any; (4, K) knots by place. All places are counted from that reading.

Beyond its PLACE a knot adds COUNT x - SUM - LAMS lam to the derivative. Sums of readings and multiples of lam are kept
apart, and readings counted from the first, so that neither a great lam nor a great offset costs digits."""


def silent() -> Message:
    """The message before any reading."""
    return np.full(1, np.nan), np.empty((4, 0))


@njit(cache=True, error_model="numpy", nogil=True)
def _cut(step: int, reading: float, lams: float, lam: float, knots: Any, k: int, stop: int) -> int:
    """Cut the derivative, a reading added, at -lam (step 1, from the left) or at lam (-1): a knot where it is cut.

    Args:
        reading: counted from the first.
        lams: multiple of lam by which the derivative stood away from the cut before the reading.
        k: the outermost knot. stop: the first, on the way in, that stays; those before it make way if beyond the cut.

    Returns:
        Where the new knot is.
    """
    total, count = step * reading, float(step)
    place = (total + lams * lam) / count
    while k != stop and step * (place - knots[PLACE, k]) >= 0:
        total += knots[SUM, k]
        lams += knots[LAMS, k]
        count += knots[COUNT, k]
        place = (total + lams * lam) / count
        k += step
    k -= step
    knots[PLACE, k], knots[SUM, k], knots[LAMS, k], knots[COUNT, k] = place, total, lams, count
    return k


@njit(cache=True, error_model="numpy", nogil=True)
def _minimum(lam: float, knots: Any, first: int, last: int) -> float:
    """Where the message is least: its derivative, -lam before the first knot, is followed until it is 0."""
    total, lams, count = 0.0, 1.0, 0.0
    for k in range(first, last):
        total += knots[SUM, k]
        lams += knots[LAMS, k]
        count += knots[COUNT, k]
        place = (total + lams * lam) / count
        if place <= knots[PLACE, k + 1]:
            return place
    return knots[PLACE, last]


@njit(cache=True, error_model="numpy", nogil=True)
def forward_sweep(readings: Any, lam: float, message: Any, low: Any, high: Any, ends: Any) -> tuple[float, Any]:
    """Carry a message on over readings (R,): as `total_variation_l1.forward_sweep`; `ends` costs O(knots) a reading."""
    origin, kept = message[0][0], message[1]
    room = len(readings)
    knots = np.empty((4, kept.shape[1] + 2 * room))
    knots[:, room : room + kept.shape[1]] = kept
    first, last = room, room + kept.shape[1] - 1
    for i in range(len(readings)):
        low[i], high[i] = -np.inf, np.inf
        if not np.isnan(readings[i]):
            fresh = last < first
            if fresh:
                origin = readings[i]
            reading, lams = readings[i] - origin, -1.0 if fresh else 0.0
            first = _cut(1, reading, lams, lam, knots, first, last + 1)
            if fresh:
                last = first
            last = _cut(-1, reading, lams, lam, knots, last, first)
            low[i] = origin + knots[PLACE, first]
            high[i] = origin + knots[PLACE, last]
        if len(ends):
            ends[i] = origin + _minimum(lam, knots, first, last) if last > first else np.nan
    latest = origin + _minimum(lam, knots, first, last) if last > first else np.nan
    return latest, (np.array([origin]), knots[:, first : last + 1].copy())
