"""Forward pass of robust total-variation denoising: min sum |y_i - x_i| + lam sum |x_{i+1} - x_i|.

The message of reading i is the least cost of all up to it as a function of x_i. Its derivative is a rising staircase;
a reading adds a stair of height 2 where it lies, the coupling to the next cuts all beyond +-lam off, and where it does
so are the places x_i is clipped to (N. Johnson, "A dynamic programming algorithm for the fused lasso and L0
segmentation", J. Comput. Graph. Stat. 22, 2013; V. Kolmogorov, T. Pock, M. Rolinek, "Total variation on a tree", SIAM
J. Imaging Sci. 9, 2016). The stairs lie in two double-ended queues, below and above the message's minimum, so a
reading costs O(log min(R, lam)) and the minimum is at hand.
"""

from typing import Any

import numpy as np
from numba import njit

from padforge.sense.recordings.processing.kernels.interval_heap import HIGH, LOW, end_slot, pop, push

Message = tuple[Any, Any, Any]
"""(2,) the derivative's greatest value, which negated is its least, and its level between the queues, the least that is
not negative. (2, a) and (2, b) place and height of the stairs below that level, and above, as interval heaps."""

GRAIN = 2.0**40
"""Heights are whole multiples of 1 / GRAIN: their sums are exact, and nothing drifts however long a recording is."""


def silent() -> Message:
    """The message before any reading."""
    return np.zeros(2), np.empty((2, 0)), np.empty((2, 0))


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _halfway(place: float, other: float) -> float:
    """The middle of two places: of one stair where a cut ends within it, else of the tread that is left bare."""
    return 0.5 * place + 0.5 * other


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _cut(places: Any, heights: Any, size: int, end: int, excess: float) -> tuple[int, float, float]:
    """Take `excess` height off one end of a queue; return its size, where the cut ends, and what it had too little."""
    place = np.nan
    while excess > 0 and size > 0:
        slot = end_slot(size, end)
        place = places[slot]
        taken = min(excess, heights[slot])
        heights[slot] -= taken
        excess -= taken
        if heights[slot] == 0:
            pop(places, heights, size, end)
            size -= 1
    return size, place, excess


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _minimum(level: float, lower: Any, lowers: int, upper: Any, uppers: int) -> float:
    """Where the message is least, halfway where it is so on an interval; NaN before any reading."""
    if lowers == 0:
        return np.nan
    place = lower[end_slot(lowers, HIGH)]
    return place if level > 0 else _halfway(place, upper[end_slot(uppers, LOW)])


@njit(cache=True, error_model="numpy", nogil=True)
def forward_sweep(readings: Any, lam: float, message: Any, low: Any, high: Any, ends: Any) -> tuple[float, Any]:
    """Carry a message on over readings (R,).

    Args:
        readings: any unit; NaN is missing and changes nothing.
        lam: above 0; taken to 1 / GRAIN, which moves no minimum by more than that (below 1/2 no reading changes).
        low, high: (R,) overwritten with the places x_i is clipped to, given the next: x_i = clip(x_{i+1}, low, high).
            Where the minimum allows an interval for either, it is the middle.
        ends: (R,) overwritten with the last value of the minimiser of each reading and those before it, or (0,).

    Returns:
        The last value of the minimiser of all, NaN if there was no reading, and the message.
    """
    lam = max(np.rint(lam * GRAIN), 1.0) / GRAIN
    reach, level = message[0]
    lowers, uppers = message[1].shape[1], message[2].shape[1]
    room = lowers + uppers + len(readings)
    lower, lower_heights = np.empty(room), np.empty(room)
    upper, upper_heights = np.empty(room), np.empty(room)
    lower[:lowers], lower_heights[:lowers] = message[1]
    upper[:uppers], upper_heights[:uppers] = message[2]
    for i in range(len(readings)):
        low[i], high[i] = -np.inf, np.inf
        reading = readings[i]
        if not np.isnan(reading):
            if lowers > 0 and reading <= lower[end_slot(lowers, HIGH)]:
                push(lower, lower_heights, lowers, reading, 2.0)
                lowers, level = lowers + 1, level + 1.0
            else:
                push(upper, upper_heights, uppers, reading, 2.0)
                uppers, level = uppers + 1, level - 1.0
            while level < 0:  # the stairs next to the level change queues
                place, height = upper[LOW], upper_heights[LOW]
                pop(upper, upper_heights, uppers, LOW)
                push(lower, lower_heights, lowers, place, height)
                lowers, uppers, level = lowers + 1, uppers - 1, level + height
            while level >= lower_heights[end_slot(lowers, HIGH)]:
                place, height = lower[end_slot(lowers, HIGH)], lower_heights[end_slot(lowers, HIGH)]
                pop(lower, lower_heights, lowers, HIGH)
                push(upper, upper_heights, uppers, place, height)
                lowers, uppers, level = lowers - 1, uppers + 1, level - height
            excess = reach + 1.0 - lam
            reach = min(reach + 1.0, lam)
            if excess > 0:  # the lower queue always has enough: level + reach, which is not below the excess
                lowers, place, _ = _cut(lower, lower_heights, lowers, LOW, excess)
                low[i] = _halfway(place, lower[LOW])
                uppers, place, lacking = _cut(upper, upper_heights, uppers, HIGH, excess)
                if lacking > 0:
                    lowers, place, _ = _cut(lower, lower_heights, lowers, HIGH, lacking)
                    level -= lacking
                inner = upper[end_slot(uppers, HIGH)] if uppers > 0 else lower[end_slot(lowers, HIGH)]
                high[i] = _halfway(place, inner)
        if len(ends):
            ends[i] = _minimum(level, lower, lowers, upper, uppers)
    below, above = np.empty((2, lowers)), np.empty((2, uppers))
    below[0], below[1] = lower[:lowers], lower_heights[:lowers]
    above[0], above[1] = upper[:uppers], upper_heights[:uppers]
    return _minimum(level, lower, lowers, upper, uppers), (np.array([reach, level]), below, above)
