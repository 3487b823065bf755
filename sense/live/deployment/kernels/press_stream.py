"""What `localizer.h` does with every reading: the same operations on float32, in the same order.

A ring keeps the latest readings. A bank of averages of each fibre, each of which goes another share of its way to every
reading, stands for all that came before; it lags some readings behind, as a touch is known only after it began.

The detector is a simple one. While the pad is free, a baseline follows each fibre within some readings, and the pad is
touched when the squares of the deviations from it, in units of each fibre's noise, add up to more than a threshold in
two readings in a row. The baseline stands still while the pad is pressed. It is let go when the deviations have gone
back by half of the farthest that they went, and the baseline begins anew there.
"""

from typing import Any

import numpy as np
from numba import njit

RING = 32
"""Readings kept, a power of two: `REST` before a press and `SEEN` of it."""
LAG = 8
"""Readings by which the bank is behind: a touch must be found sooner."""
SETTLING = 3
"""Readings after a release in which the baseline is each one as it comes, and no touch is found."""
FOLLOWING = 0.125
"""Share of its way to a reading that the baseline goes while the pad is free."""
GONE_BACK = 0.5
"""Share of the farthest deviation below which a press is over."""
LONGEST = 1024
"""Readings after which what the detector took for a press is taken for the pad's new rest."""
REST, SEEN = 10, 20
"""Readings before a press that its rest is the mean of, and readings of it that are looked at."""
MOST_V = 1e3
"""What is further from 0 is no reading."""
WINDOWS = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Readings of a press, counted from its first, that are looked at together."""

PRESSED, SUSPECTED, BEGUN, LIFTED, FREE, TOLD, TOUCHED = range(7)
"""Numbers of what is known of the pad: whether it is pressed, whether the last reading looked like a touch, the
readings with which the press began and ended, the end of the press before it, whether its place is told, and the
reading at which the press was found."""


@njit(cache=True, error_model="numpy", nogil=True)
def follow(
    readings: Any, held: Any, alive: Any, poles: Any, quiet: Any, judge: Any, edges: Any, shown: Any, there: Any
) -> int:
    """Take readings in order, and give what is seen of every press.

    Args:
        readings: (R, C) V, NaN where missing. held: (R,) whether the pad is pressed, as told from outside; empty where
            the detector is to judge. alive: (C,) fibres that count for it.
        poles: (J,) shares. quiet: (C,) 1/V, one over the noise. judge: threshold, and readings from the beginning of a
            press to the first that shows it.
        edges: (R, 3) overwritten with the readings with which each press began, was seen enough of, and ended; R if it
            has not. shown: (R, C, 9 + J) overwritten with its windows and its history, V, from its rest.
        there: (R, C) overwritten with whether each fibre gave enough of it.

    Returns:
        The number of presses of which enough was seen.
    """
    count, fibres = readings.shape
    ring = np.zeros((RING, fibres), np.float32)
    bank = np.zeros((2, fibres, len(poles)), np.float32)  # as it is, and as it was when the press began
    levels = np.zeros((2, fibres), np.float32)  # baseline, and the farthest deviation of the press
    farthest = np.zeros(1, np.float32)
    missing = np.zeros(fibres, np.int64)
    pad = np.zeros(7, np.int64)
    presses = 0
    for n in range(count):
        _take(n, readings[n], ring, bank[0], levels[0], missing, poles)
        if len(held):
            change = _told(n, held[n], pad)
        else:
            change = _judged(n, ring[n % RING], alive, quiet, judge, levels, farthest, pad)
        if change > 0:
            missing[:] = 0
            pad[TOLD], pad[TOUCHED] = 0, n
            _remember(n, ring, bank, poles, pad)
        ended = change < 0
        if pad[TOLD] == 0 and (ended or (pad[PRESSED] == 1 and n >= pad[BEGUN] + SEEN - 1)):
            pad[TOLD] = 1
            edges[presses, 0], edges[presses, 1], edges[presses, 2] = pad[BEGUN], n, count
            end = n if ended else n + 1
            for c in range(fibres):
                there[presses, c] = 4 * missing[c] <= n - pad[TOUCHED]
                _look(c, end, ring, bank[1, c], pad, shown[presses, c])
            presses += 1
        if ended and presses > 0:
            edges[presses - 1, 2] = pad[LIFTED]
    return presses


@njit(cache=True, error_model="numpy", nogil=True)
def _take(n: int, row: Any, ring: Any, bank: Any, base: Any, missing: Any, poles: Any) -> None:
    """Keep a reading; what is missing or beyond `MOST_V` is as it was in the reading before."""
    for c in range(len(row)):
        x = row[c]
        if not abs(x) <= np.float32(MOST_V):
            missing[c] += 1
            x = ring[(n - 1) % RING, c]
        old = ring[(n - LAG) % RING, c]
        ring[n % RING, c] = x
        if n == 0:
            base[c] = x
        for j in range(len(poles)):
            if n == 0:
                bank[c, j] = x
            elif n >= LAG:
                bank[c, j] += poles[j] * (old - bank[c, j])


@njit(cache=True, error_model="numpy", nogil=True)
def _told(n: int, held: bool, pad: Any) -> int:
    """1 if a press begins with this reading, -1 if it ends, 0 if neither, as told from outside."""
    if held and pad[PRESSED] == 0:
        pad[PRESSED], pad[FREE] = 1, pad[LIFTED]
        pad[BEGUN] = max(n, pad[FREE] + 1)
        return 1
    if not held and pad[PRESSED] == 1:
        pad[PRESSED], pad[LIFTED] = 0, n
        return -1
    return 0


@njit(cache=True, error_model="numpy", nogil=True)
def _judged(n: int, row: Any, alive: Any, quiet: Any, judge: Any, levels: Any, farthest: Any, pad: Any) -> int:
    """The same as the detector judges."""
    base, peak = levels[0], levels[1]
    square, along = np.float32(0), np.float32(0)
    for c in range(len(row)):
        if alive[c]:
            off = (row[c] - base[c]) * quiet[c]
            square += off * off
            along += off * peak[c]
    change = 0
    if pad[PRESSED] == 1:
        if square > farthest[0]:
            farthest[0] = square
            for c in range(len(row)):
                peak[c] = (row[c] - base[c]) * quiet[c]
        elif along < np.float32(GONE_BACK) * farthest[0] or n - pad[BEGUN] > LONGEST:
            pad[PRESSED], pad[LIFTED] = 0, n
            change = -1
            base[:] = row
    elif n < pad[LIFTED] + SETTLING:
        base[:] = row
    elif square > judge[0]:
        if pad[SUSPECTED] == 1:
            pad[PRESSED], pad[SUSPECTED], pad[FREE] = 1, 0, pad[LIFTED]
            pad[BEGUN] = max(n - 1 - int(judge[1]), pad[FREE] + 1)
            farthest[0] = np.float32(0)
            change = 1
        else:
            pad[SUSPECTED] = 1
    else:
        pad[SUSPECTED] = 0
        for c in range(len(row)):
            base[c] += np.float32(FOLLOWING) * (row[c] - base[c])
    return change


@njit(cache=True, error_model="numpy", nogil=True)
def _remember(n: int, ring: Any, bank: Any, poles: Any, pad: Any) -> None:
    """Keep the bank as it was when the press began."""
    for c in range(bank.shape[1]):
        for j in range(len(poles)):
            level = bank[0, c, j]
            for i in range(max(n - LAG + 1, 0), pad[BEGUN]):
                level += poles[j] * (ring[i % RING, c] - level)
            bank[1, c, j] = level


@njit(cache=True, error_model="numpy", nogil=True)
def _look(c: int, end: int, ring: Any, past: Any, pad: Any, out: Any) -> None:
    """Windows of a fibre in the press, of which readings below `end` count, and its history, from its rest."""
    begun = pad[BEGUN]
    first = max(begun - REST, pad[FREE])
    total = np.float32(0)
    for i in range(first, begun):
        total += ring[i % RING, c]
    rest = total / np.float32(begun - first)
    for k in range(len(WINDOWS)):
        total = np.float32(0)
        for i in range(begun + WINDOWS[k][0], begun + WINDOWS[k][1]):
            total += ring[max(min(i, end - 1), begun) % RING, c]
        out[k] = total / np.float32(WINDOWS[k][1] - WINDOWS[k][0]) - rest
    for j in range(len(past)):
        out[len(WINDOWS) + j] = past[j] - rest
