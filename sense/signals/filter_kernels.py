"""Compiled passes of total variation denoising, and the running median.

Total variation denoising is solved by dynamic programming (N. Johnson, J. Comput. Graph. Stat. 22, 2013; V. Kolmogorov,
T. Pock, M. Rolinek, SIAM J. Imaging Sci. 9, 2016). The message of reading i is the least cost of all readings up to it
as a function of x_i. A reading adds its fidelity; the coupling to the next clips the derivative of the message to
+-lam, and where it does so are the bounds that x_i is clipped to, given the next. The backward pass clips from the end.
"""

from typing import Any

import numpy as np

from padforge.design.common.compilation import inner_kernel, kernel


@kernel
def backward_pass(low: Any, high: Any, last: float, out: Any) -> int:
    """Clip from the last value back, into `out` (R,); return the number of values that no later reading can change.

    A chain of clips is a clip. Where its bounds have met, what comes later does not matter: all before is final.
    """
    value, lowest, highest = last, -np.inf, np.inf
    n_final = 0
    for i in range(len(low) - 1, -1, -1):
        value = min(max(value, low[i]), high[i])  # NaN, no reading so far, stays: no comparison with it holds
        out[i] = value
        if n_final == 0:
            lowest, highest = min(max(lowest, low[i]), high[i]), min(max(highest, low[i]), high[i])
            if lowest == highest:
                n_final = i + 1
    return n_final


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


# An interval heap: a double-ended priority queue in a flat array (J. van Leeuwen, D. Wood, The Computer Journal 36,
# 1993). Node k holds entries 2k and 2k + 1, the low and the high end of an interval within its parent's; so the low
# ends are a heap with the smallest at 0, the high ends one with the greatest at 1. A last node may hold one entry,
# which is both its ends. Each entry is a key with a value that travels along. Operations are inlined: a call takes
# longer than the work.
LOW, HIGH = 0, 1


@inner_kernel(forceinline=True)
def _end_slot(size: int, end: int) -> int:
    """Return where the smallest (LOW) or greatest (HIGH) of `size` > 0 entries is."""
    return end if size > 1 else 0


@inner_kernel(forceinline=True)
def _is_beyond(key: float, other: float, end: int) -> bool:
    """Return whether `key` is nearer to the end: strictly, so that equal keys stay where they are."""
    return key < other if end == LOW else key > other


@inner_kernel(forceinline=True)
def _push(keys: Any, values: Any, size: int, key: float, value: float) -> None:
    """Add an entry to `size` others; the arrays are longer than that."""
    slot, end = size, size % 2
    if end == HIGH and key < keys[slot - 1]:  # the node's other entry becomes its high end
        keys[slot], values[slot] = keys[slot - 1], values[slot - 1]
        slot, end = slot - 1, LOW
    elif end == LOW and slot > 0 and key > keys[2 * ((slot // 2 - 1) // 2) + HIGH]:
        end = HIGH
    while slot > 1:
        parent = 2 * ((slot // 2 - 1) // 2) + end
        if not _is_beyond(key, keys[parent], end):
            break
        keys[slot], values[slot] = keys[parent], values[parent]
        slot = parent
    keys[slot], values[slot] = key, value


@inner_kernel(forceinline=True)
def _pop(keys: Any, values: Any, size: int, end: int) -> None:
    """Remove the smallest (LOW) or greatest (HIGH) of `size` > 0 entries."""
    size -= 1
    key, value = keys[size], values[size]  # the last entry sinks along the gap that opens at the end
    slot = end
    if slot >= size:
        return
    while True:
        nearest = -1
        for node in (slot // 2 * 2 + 1, slot // 2 * 2 + 2):
            child = 2 * node + end  # a node of one entry has lost the last as its high end, which is not below it
            if child < size and (nearest < 0 or _is_beyond(keys[child], keys[nearest], end)):
                nearest = child
        if nearest < 0 or not _is_beyond(keys[nearest], key, end):
            break
        keys[slot], values[slot] = keys[nearest], values[nearest]
        slot = nearest
        other = slot ^ 1
        if other < size and _is_beyond(keys[other], key, end):
            keys[other], key = key, keys[other]
            values[other], value = value, values[other]
    keys[slot], values[slot] = key, value


GRAIN = 2.0**40
"""Heights are whole multiples of 1 / GRAIN: their sums are exact, and nothing drifts however long a recording is."""


def initial_message_l1() -> tuple[Any, Any, Any]:
    """Return the message before any reading: (2,) greatest value of the derivative and its level between the queues,
    the least that is not negative; (2, a), (2, b) positions and heights of the steps below and above it, in heaps.
    """
    return np.zeros(2), np.empty((2, 0)), np.empty((2, 0))


@inner_kernel(forceinline=True)
def _halfway(position: float, other: float) -> float:
    """Return the middle of two positions, without overflow."""
    return 0.5 * position + 0.5 * other


@inner_kernel(forceinline=True)
def _cut_l1(positions: Any, heights: Any, size: int, end: int, excess: float) -> tuple[int, float, float]:
    """Cut the height `excess` off one end of a queue; return its size, where the cut ends, and the excess left."""
    position = np.nan
    while excess > 0 and size > 0:
        slot = _end_slot(size, end)
        position = positions[slot]
        cut = min(excess, heights[slot])
        heights[slot] -= cut
        excess -= cut
        if heights[slot] == 0:
            _pop(positions, heights, size, end)
            size -= 1
    return size, position, excess


@inner_kernel(forceinline=True)
def _minimum_l1(level: float, lower: Any, n_lower: int, upper: Any, n_upper: int) -> float:
    """Return where the message is least, the middle if that is an interval; NaN before any reading."""
    if n_lower == 0:
        return np.nan
    position = lower[_end_slot(n_lower, HIGH)]
    return position if level > 0 else _halfway(position, upper[_end_slot(n_upper, LOW)])


@kernel
def forward_pass_l1(readings: Any, lam: float, message: Any, low: Any, high: Any, ends: Any) -> tuple[float, Any]:
    """Carry a message on over readings (R,), with fidelity |y_i - x_i|; return the last value of the minimiser, too.

    The derivative is a rising staircase, to which a reading adds a step of height 2. Its steps are in two double-ended
    queues, below and above the minimum: O(log min(R, lam)) a reading. `lam` is rounded to 1 / GRAIN. Overwritten are
    the bounds of x_i = clip(x_{i+1}, low, high), the middle where the minimum allows an interval; and `ends`, the last
    value of the minimiser up to each reading; shape (R,), or (0,) if not needed.
    """
    lam = max(np.rint(lam * GRAIN), 1.0) / GRAIN
    greatest, level = message[0]
    n_lower, n_upper = message[1].shape[1], message[2].shape[1]
    room = n_lower + n_upper + len(readings)
    lower, lower_heights = np.empty(room), np.empty(room)
    upper, upper_heights = np.empty(room), np.empty(room)
    for k in range(n_lower):  # one by one: assigning slices compiles the wording of an error about their shapes
        lower[k], lower_heights[k] = message[1][0, k], message[1][1, k]
    for k in range(n_upper):
        upper[k], upper_heights[k] = message[2][0, k], message[2][1, k]
    for i in range(len(readings)):
        low[i], high[i] = -np.inf, np.inf
        reading = readings[i]
        if not np.isnan(reading):
            # 1. Add a step of height 2 at the reading.
            if n_lower > 0 and reading <= lower[_end_slot(n_lower, HIGH)]:
                _push(lower, lower_heights, n_lower, reading, 2.0)
                n_lower, level = n_lower + 1, level + 1.0
            else:
                _push(upper, upper_heights, n_upper, reading, 2.0)
                n_upper, level = n_upper + 1, level - 1.0
            # 2. Move the steps next to the minimum to the queue that they belong to now.
            while level < 0:
                position, height = upper[LOW], upper_heights[LOW]
                _pop(upper, upper_heights, n_upper, LOW)
                _push(lower, lower_heights, n_lower, position, height)
                n_lower, n_upper, level = n_lower + 1, n_upper - 1, level + height
            while level >= lower_heights[_end_slot(n_lower, HIGH)]:
                position, height = lower[_end_slot(n_lower, HIGH)], lower_heights[_end_slot(n_lower, HIGH)]
                _pop(lower, lower_heights, n_lower, HIGH)
                _push(upper, upper_heights, n_upper, position, height)
                n_lower, n_upper, level = n_lower - 1, n_upper + 1, level - height
            # 3. Cut the derivative at -lam and lam.
            excess = greatest + 1.0 - lam
            greatest = min(greatest + 1.0, lam)
            if excess > 0:  # the lower queue always has enough: level + greatest, which is not below the excess
                n_lower, position, _ = _cut_l1(lower, lower_heights, n_lower, LOW, excess)
                low[i] = _halfway(position, lower[LOW])
                n_upper, position, remaining = _cut_l1(upper, upper_heights, n_upper, HIGH, excess)
                if remaining > 0:
                    n_lower, position, _ = _cut_l1(lower, lower_heights, n_lower, HIGH, remaining)
                    level -= remaining
                inner = upper[_end_slot(n_upper, HIGH)] if n_upper > 0 else lower[_end_slot(n_lower, HIGH)]
                high[i] = _halfway(position, inner)
        if len(ends):
            ends[i] = _minimum_l1(level, lower, n_lower, upper, n_upper)
    below, above = np.empty((2, n_lower)), np.empty((2, n_upper))
    for k in range(n_lower):
        below[0, k], below[1, k] = lower[k], lower_heights[k]
    for k in range(n_upper):
        above[0, k], above[1, k] = upper[k], upper_heights[k]
    return _minimum_l1(level, lower, n_lower, upper, n_upper), (np.array([greatest, level]), below, above)


# Rows of knots. Beyond its POSITION, counted from the first reading, a knot adds COUNT x - SUM - LAMS lam to the
# derivative. Sums of readings and multiples of lam are separate, and readings counted from the first, so that neither a
# great lam nor a great offset costs digits.
POSITION, SUM, LAMS, COUNT = range(4)


def initial_message_l2() -> tuple[Any, Any]:
    """Return the message before any reading: (1,) the first reading, NaN before any, and (4, K) knots by position."""
    return np.full(1, np.nan), np.empty((4, 0))


@inner_kernel
def _cut_l2(step: int, reading: float, lams: float, lam: float, knots: Any, k: int, stop: int) -> int:
    """Cut the derivative, with a reading added, at -lam (step 1, inwards from knot k) or at lam (-1); return the knot.

    Before the reading it differed from the cut by `lams` lam. Knots up to `stop` are pooled if they are beyond the cut.
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


@inner_kernel
def _minimum_l2(lam: float, knots: Any, first: int, last: int) -> float:
    """Return where the message is least: its derivative, -lam before the first knot, is followed until it is 0."""
    total, lams, count = 0.0, 1.0, 0.0
    for k in range(first, last):
        total += knots[SUM, k]
        lams += knots[LAMS, k]
        count += knots[COUNT, k]
        position = (total + lams * lam) / count
        if position <= knots[POSITION, k + 1]:
            return position
    return knots[POSITION, last]


@kernel
def forward_pass_l2(readings: Any, lam: float, message: Any, low: Any, high: Any, ends: Any) -> tuple[float, Any]:
    """Carry a message on over readings, with fidelity (y_i - x_i)^2 / 2; as `forward_pass_l1`.

    The derivative is piecewise linear. Knots beyond a cut never matter again, so they are pooled with the new reading
    like adjacent violators: O(1) a reading on average, as the taut string (L. Condat, IEEE Signal Process. Lett. 20,
    2013); `ends` costs O(knots).
    """
    origin, old_knots = message[0][0], message[1]
    room = len(readings)
    knots = np.empty((4, old_knots.shape[1] + 2 * room))
    for k in range(old_knots.shape[1]):  # one by one, as in `forward_pass_l1`
        for row in range(4):
            knots[row, room + k] = old_knots[row, k]
    first, last = room, room + old_knots.shape[1] - 1
    for i in range(len(readings)):
        low[i], high[i] = -np.inf, np.inf
        if not np.isnan(readings[i]):
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
        if len(ends):
            ends[i] = origin + _minimum_l2(lam, knots, first, last) if last > first else np.nan
    latest = origin + _minimum_l2(lam, knots, first, last) if last > first else np.nan
    return latest, (np.array([origin]), knots[:, first : last + 1].copy())
