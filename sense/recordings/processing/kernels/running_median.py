"""The running median, of a sorted window that readings enter and leave."""

from typing import Any

import numpy as np
from numba import njit


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
