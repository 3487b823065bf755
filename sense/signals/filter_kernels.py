"""Backward pass of total-variation denoising: from the last value back, each is the next one clipped.

The running median, of a sorted window that readings enter and leave.

A double-ended priority queue in two flat arrays: smallest and greatest at hand, insertion and removal in log time.
Node k holds entries 2k and 2k + 1, the low and the high end of an interval that lies within its parent's; so the low
ends are a heap with the smallest at 0, the high ends one with the greatest at 1. A last node may hold one entry, which
is both its ends. Each entry is a key with a value that travels along (J. van Leeuwen, D. Wood, "Interval heaps", The
Computer Journal 36, 1993). All is inlined where it is used: a call takes longer than the work on a short queue.

Forward pass of robust total-variation denoising: min sum |y_i - x_i| + lam sum |x_{i+1} - x_i|.
The message of reading i is the least cost of all up to it as a function of x_i. Its derivative is a rising staircase;
a reading adds a stair of height 2 where it lies, the coupling to the next cuts all beyond +-lam off, and where it does
so are the places x_i is clipped to (N. Johnson, "A dynamic programming algorithm for the fused lasso and L0
segmentation", J. Comput. Graph. Stat. 22, 2013; V. Kolmogorov, T. Pock, M. Rolinek, "Total variation on a tree", SIAM
J. Imaging Sci. 9, 2016). The stairs lie in two double-ended queues, below and above the message's minimum, so a
reading costs O(log min(R, lam)) and the minimum is at hand.

Forward pass of total-variation denoising by squares: min 1/2 sum (y_i - x_i)^2 + lam sum |x_{i+1} - x_i|.
The message of reading i is the least cost of all up to it as a function of x_i. Its derivative is piecewise linear
and rising; a reading adds x - y_i, the coupling to the next cuts all beyond +-lam off, and where it does so are the
places x_i is clipped to (N. Johnson, J. Comput. Graph. Stat. 22, 2013; L. Condat, IEEE Signal Process. Lett. 20, 2013,
has the same geometry as a taut string). Each cut leaves a knot; knots beyond the next cut never matter again, so
finding a cut pools them with the new reading as pooled adjacent violators are, O(1) a reading on average.
"""

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", nogil=True)
def clip_back(low: Any, high: Any, last: float, out: Any) -> int:
    """The minimiser of the readings so far, and how many of its values no later reading can change.

    A chain of clips is a clip. Once its bounds have met, what comes in no longer matters: from there on back all is
    decided.

    Args:
        low, high: (R,) from a forward pass. last: the last value of the minimiser.
        out: (R,) overwritten with the minimiser; NaN where there is no reading at all.

    Returns:
        The number of decided values.
    """
    value, least, greatest = last, -np.inf, np.inf
    decided = 0
    for i in range(len(low) - 1, -1, -1):
        value = min(max(value, low[i]), high[i])  # NaN, no reading so far, stays: no comparison with it holds
        out[i] = value
        if decided == 0:
            least, greatest = min(max(least, low[i]), high[i]), min(max(greatest, low[i]), high[i])
            if least == greatest:
                decided = i + 1
    return decided


@njit(cache=True, error_model="numpy", nogil=True)
def _place(window: Any, count: int, value: float) -> int:
    """The number of the `count` sorted values of the window that are below `value`."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if window[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy", nogil=True)
def running_median(readings: Any, before: int, after: int, out: Any) -> None:
    """Median of the readings i - before .. i + after that there are, NaN (missing) left out, into out (R,).

    Of an even number it is the mean of the two in the middle; of none, NaN. O(before + after) a reading, most of it
    one short move of memory.
    """
    width = before + 1 + after
    window, count = np.empty(min(width, len(readings))), 0
    for entering in range(len(readings) + after):
        leaving, i = entering - width, entering - after
        if leaving >= 0 and not np.isnan(readings[leaving]):
            count -= 1
            for k in range(_place(window, count + 1, readings[leaving]), count):
                window[k] = window[k + 1]
        if entering < len(readings) and not np.isnan(readings[entering]):
            at = _place(window, count, readings[entering])
            for k in range(count, at, -1):
                window[k] = window[k - 1]
            window[at] = readings[entering]
            count += 1
        if i >= 0:
            half = count // 2
            middle = window[half] if count % 2 else 0.5 * window[half - 1] + 0.5 * window[half] if count else np.nan
            out[i] = middle


LOW, HIGH = 0, 1


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def end_slot(size: int, end: int) -> int:
    """Where the smallest (LOW) or greatest (HIGH) of `size` > 0 entries is."""
    return end if size > 1 else 0


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _beyond(key: float, other: float, end: int) -> bool:
    """Whether `key` is nearer to the end than `other`: strictly, so that equal keys stay where they are."""
    return key < other if end == LOW else key > other


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def push(keys: Any, values: Any, size: int, key: float, value: float) -> None:
    """Add an entry to the `size` that are there; the arrays hold more than that."""
    slot, end = size, size % 2
    if end == HIGH and key < keys[slot - 1]:  # the node's other entry becomes its high end
        keys[slot], values[slot] = keys[slot - 1], values[slot - 1]
        slot, end = slot - 1, LOW
    elif end == LOW and slot > 0 and key > keys[2 * ((slot // 2 - 1) // 2) + HIGH]:
        end = HIGH
    while slot > 1:
        parent = 2 * ((slot // 2 - 1) // 2) + end
        if not _beyond(key, keys[parent], end):
            break
        keys[slot], values[slot] = keys[parent], values[parent]
        slot = parent
    keys[slot], values[slot] = key, value


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def pop(keys: Any, values: Any, size: int, end: int) -> None:
    """Remove the smallest (LOW) or greatest (HIGH) of `size` > 0 entries."""
    size -= 1
    key, value = keys[size], values[size]  # the last entry looks for a place along the gap that opens at the end
    slot = end
    if slot >= size:
        return
    while True:
        nearest = -1
        for node in (slot // 2 * 2 + 1, slot // 2 * 2 + 2):
            child = 2 * node + end  # a node of one entry has lost the last as its high end, which is not below it
            if child < size and (nearest < 0 or _beyond(keys[child], keys[nearest], end)):
                nearest = child
        if nearest < 0 or not _beyond(keys[nearest], key, end):
            break
        keys[slot], values[slot] = keys[nearest], values[nearest]
        slot = nearest
        other = slot ^ 1
        if other < size and _beyond(keys[other], key, end):
            keys[other], key = key, keys[other]
            values[other], value = value, values[other]
    keys[slot], values[slot] = key, value


Message = tuple[Any, Any, Any]
"""(2,) the derivative's greatest value, which negated is its least, and its level between the queues, the least that is
not negative. (2, a) and (2, b) place and height of the stairs below that level, and above, as interval heaps."""

GRAIN = 2.0**40
"""Heights are whole multiples of 1 / GRAIN: their sums are exact, and nothing drifts however long a recording is."""


def silent_l1() -> Message:
    """The message before any reading."""
    return np.zeros(2), np.empty((2, 0)), np.empty((2, 0))


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _halfway(place: float, other: float) -> float:
    """The middle of two places: of one stair where a cut ends within it, else of the tread that is left bare."""
    return 0.5 * place + 0.5 * other


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _cut_l1(places: Any, heights: Any, size: int, end: int, excess: float) -> tuple[int, float, float]:
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
def _minimum_l1(level: float, lower: Any, lowers: int, upper: Any, uppers: int) -> float:
    """Where the message is least, halfway where it is so on an interval; NaN before any reading."""
    if lowers == 0:
        return np.nan
    place = lower[end_slot(lowers, HIGH)]
    return place if level > 0 else _halfway(place, upper[end_slot(uppers, LOW)])


@njit(cache=True, error_model="numpy", nogil=True)
def forward_sweep_l1(readings: Any, lam: float, message: Any, low: Any, high: Any, ends: Any) -> tuple[float, Any]:
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
                lowers, place, _ = _cut_l1(lower, lower_heights, lowers, LOW, excess)
                low[i] = _halfway(place, lower[LOW])
                uppers, place, lacking = _cut_l1(upper, upper_heights, uppers, HIGH, excess)
                if lacking > 0:
                    lowers, place, _ = _cut_l1(lower, lower_heights, lowers, HIGH, lacking)
                    level -= lacking
                inner = upper[end_slot(uppers, HIGH)] if uppers > 0 else lower[end_slot(lowers, HIGH)]
                high[i] = _halfway(place, inner)
        if len(ends):
            ends[i] = _minimum_l1(level, lower, lowers, upper, uppers)
    below, above = np.empty((2, lowers)), np.empty((2, uppers))
    below[0], below[1] = lower[:lowers], lower_heights[:lowers]
    above[0], above[1] = upper[:uppers], upper_heights[:uppers]
    return _minimum_l1(level, lower, lowers, upper, uppers), (np.array([reach, level]), below, above)


PLACE, SUM, LAMS, COUNT = range(4)

MessageL2 = tuple[Any, Any]
"""(1,) the first reading, NaN before any; (4, K) knots by place. All places are counted from that reading.

Beyond its PLACE a knot adds COUNT x - SUM - LAMS lam to the derivative. Sums of readings and multiples of lam are kept
apart, and readings counted from the first, so that neither a great lam nor a great offset costs digits."""


def silent_l2() -> MessageL2:
    """The message before any reading."""
    return np.full(1, np.nan), np.empty((4, 0))


@njit(cache=True, error_model="numpy", nogil=True)
def _cut_l2(step: int, reading: float, lams: float, lam: float, knots: Any, k: int, stop: int) -> int:
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
def _minimum_l2(lam: float, knots: Any, first: int, last: int) -> float:
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
def forward_sweep_l2(readings: Any, lam: float, message: Any, low: Any, high: Any, ends: Any) -> tuple[float, Any]:
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
            first = _cut_l2(1, reading, lams, lam, knots, first, last + 1)
            if fresh:
                last = first
            last = _cut_l2(-1, reading, lams, lam, knots, last, first)
            low[i] = origin + knots[PLACE, first]
            high[i] = origin + knots[PLACE, last]
        if len(ends):
            ends[i] = origin + _minimum_l2(lam, knots, first, last) if last > first else np.nan
    latest = origin + _minimum_l2(lam, knots, first, last) if last > first else np.nan
    return latest, (np.array([origin]), knots[:, first : last + 1].copy())
