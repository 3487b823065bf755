"""Backward pass of total-variation denoising: from the last value back, each is the next one clipped."""

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
