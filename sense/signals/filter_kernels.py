"""Compiled passes of total variation denoising, and the running median.

Total variation denoising is solved by dynamic programming (N. Johnson, J. Comput. Graph. Stat. 22, 2013; V. Kolmogorov,
T. Pock, M. Rolinek, SIAM J. Imaging Sci. 9, 2016). The message of reading i is the least cost of all readings up to it
as a function of x_i. A reading adds its fidelity; the coupling to the next one clips the derivative of the message to
+-lam. The positions at which that begins are the bounds of x_i: the backward pass, from the end, clips x_{i+1} to them.
"""

from typing import Any

import numpy as np

from padforge.common.compilation import kernel


@kernel
def backward_pass(low: Any, high: Any, last: float, out: Any) -> None:
    """Compute the minimiser `out` (R,) from its last value: each value is the next one, clipped to its bounds."""
    value = last
    for i in range(len(low) - 1, -1, -1):
        value = min(max(value, low[i]), high[i])  # NaN, of a channel without readings, stays NaN
        out[i] = value


@kernel
def running_median(readings: Any, before: int, after: int, out: Any) -> None:
    """Compute the medians of the readings i - before .. i + after into out (R,), ignoring NaN; sorts by insertion."""
    width = before + 1 + after
    window, count = np.empty(min(width, len(readings))), 0
    for entering in range(len(readings) + after):
        leaving, i = entering - width, entering - after
        if leaving >= 0 and not np.isnan(readings[leaving]):
            count -= 1
            for k in range(np.searchsorted(window[: count + 1], readings[leaving]), count):
                window[k] = window[k + 1]
        if entering < len(readings) and not np.isnan(readings[entering]):
            index = np.searchsorted(window[:count], readings[entering])
            for k in range(count, index, -1):
                window[k] = window[k - 1]
            window[index] = readings[entering]
            count += 1
        if i >= 0:
            half = count // 2
            middle = window[half] if count % 2 else 0.5 * window[half - 1] + 0.5 * window[half] if count else np.nan
            out[i] = middle


GRAIN = 2.0**40  # heights are whole multiples of 1 / GRAIN, so that sums are exact in a recording of any length


@kernel
def forward_pass_l1(readings: Any, lam: float, low: Any, high: Any) -> float:
    """Carry the message over readings (R,), with fidelity |y_i - x_i|; return the last value of the minimiser.

    The derivative is a rising staircase, to which a reading adds a step of height 2; clipped, it rises by 2 lam in all,
    so that a step is inserted in O(min(R, lam)). `lam` is rounded to 1 / GRAIN. The bounds `low` and `high` (R,) of
    x_i = clip(x_{i+1}, low, high) are overwritten; where the minimum allows an interval, they are its middle.
    """
    lam = max(np.rint(lam * GRAIN), 1.0) / GRAIN
    positions, heights = np.empty(len(readings)), np.empty(len(readings))
    first, end, greatest = 0, 0, 0.0  # steps first .. end - 1, by which the derivative rises from -greatest to greatest
    for i in range(len(readings)):
        low[i], high[i] = -np.inf, np.inf
        reading = readings[i]
        if np.isnan(reading):
            continue
        # 1. Add a step of height 2 at the reading.
        index = first + np.searchsorted(positions[first:end], reading)
        for k in range(end, index, -1):
            positions[k], heights[k] = positions[k - 1], heights[k - 1]
        positions[index], heights[index] = reading, 2.0
        end += 1
        # 2. Cut the derivative at -lam, from the first step on, and at lam, from the last one.
        excess = greatest + 1.0 - lam
        greatest = min(greatest + 1.0, lam)
        if excess > 0:
            last, remaining = first, excess
            while remaining > 0:
                last, cut = first, min(remaining, heights[first])
                heights[first] -= cut
                remaining -= cut
                if heights[first] == 0:
                    first += 1
            low[i] = 0.5 * positions[last] + 0.5 * positions[first]
            remaining = excess
            while remaining > 0:
                last, cut = end - 1, min(remaining, heights[end - 1])
                heights[end - 1] -= cut
                remaining -= cut
                if heights[end - 1] == 0:
                    end -= 1
            high[i] = 0.5 * positions[last] + 0.5 * positions[end - 1]
    # 3. The minimum is where the derivative passes 0.
    level, k = -greatest, first
    while level < 0:
        level += heights[k]
        k += 1
    if end == 0:
        return np.nan
    return positions[k - 1] if level > 0 else 0.5 * positions[k - 1] + 0.5 * positions[k]


# Rows of knots. Beyond its POSITION, relative to the first reading, a knot adds COUNT x - SUM - LAMS lam to the
# derivative. Sums of readings and multiples of lam are separate, and readings are relative to the first one, so that
# neither a large lam nor a large offset costs digits.
POSITION, SUM, LAMS, COUNT = range(4)


@kernel
def _cut_l2(step: int, reading: float, lams: float, lam: float, knots: Any, k: int, stop: int) -> int:
    """Cut the derivative, with a reading added, at -lam (step 1, inwards from knot k) or at lam (-1); return the knot.

    Without the reading, it differs from the cut by `lams` lam. Knots beyond the cut, up to `stop`, are pooled.
    """
    total, count = step * reading, float(step)
    position = (total + lams * lam) / count
    while k != stop and step * (position - knots[POSITION, k]) >= 0:
        total += knots[SUM, k]
        lams += knots[LAMS, k]
        count += knots[COUNT, k]
        position = (total + lams * lam) / count
        k += step
    k -= step
    knots[POSITION, k], knots[SUM, k], knots[LAMS, k], knots[COUNT, k] = position, total, lams, count
    return k


@kernel
def forward_pass_l2(readings: Any, lam: float, low: Any, high: Any) -> float:
    """Carry the message over readings, with fidelity (y_i - x_i)^2 / 2; as `forward_pass_l1`.

    The derivative is piecewise linear. Knots beyond a cut never matter again, so they are pooled with the new reading
    as in the pool-adjacent-violators algorithm: O(1) a reading on average, like the taut string (L. Condat, IEEE Signal
    Process. Lett. 20, 2013).
    """
    origin, room = np.nan, len(readings)
    knots = np.empty((4, 2 * room))
    first, last = room, room - 1
    for i in range(len(readings)):
        low[i], high[i] = -np.inf, np.inf
        if np.isnan(readings[i]):
            continue
        is_first = last < first
        if is_first:
            origin = readings[i]
        reading, lams = readings[i] - origin, -1.0 if is_first else 0.0
        first = _cut_l2(1, reading, lams, lam, knots, first, last + 1)
        if is_first:
            last = first
        last = _cut_l2(-1, reading, lams, lam, knots, last, first)
        low[i] = origin + knots[POSITION, first]
        high[i] = origin + knots[POSITION, last]
    # The minimum is where the derivative, which is -lam before the first knot, passes 0.
    total, lams, count = 0.0, 1.0, 0.0
    for k in range(first, last):
        total += knots[SUM, k]
        lams += knots[LAMS, k]
        count += knots[COUNT, k]
        position = (total + lams * lam) / count
        if position <= knots[POSITION, k + 1]:
            return origin + position
    return origin + knots[POSITION, last] if last > first else np.nan
