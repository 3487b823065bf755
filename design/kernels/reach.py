"""Which fibres a press can touch: an index range, since a family's fibres keep to their levels within its stray."""

import math
from typing import Any

import numpy as np
from numba import njit

EPS = 2.0**-52


@njit(cache=True, error_model="numpy", nogil=True)
def family_strays(cross: Any) -> Any:
    """(P, 2) how far the fibres of each family stray from their own level, from knots' cross (P, 2M, n)."""
    population, fibres, _ = cross.shape
    grid = fibres // 2
    out = np.zeros((population, 2))
    for p in range(population):
        for f in range(fibres):
            level = f % grid + 1
            out[p, f // grid] = max(out[p, f // grid], level - cross[p, f].min(), cross[p, f].max() - level)
    return out


@njit(cache=True, error_model="numpy")
def touched_range(cv: float, reach: Any, stray: float, grid: int) -> tuple[int, int]:
    """Fibres [first, end) of a family, by index, that a press at cross coordinate cv can touch.

    Fibre i (from 0) keeps to level i + 1 within the family's stray.
    """
    slack = 8 * EPS * (abs(cv) + reach[3])  # a fibre on the boundary is touched, whichever way rounding goes
    first = min(max(math.ceil(cv + reach[2] - stray - slack) - 1, 0.0), float(grid))
    end = min(max(math.floor(cv + reach[3] + stray + slack), 0.0), float(grid))
    return int(first), int(end)


@njit(cache=True, error_model="numpy")
def count_touched(strays: Any, presses: Any, reach: Any, grid: int) -> Any:
    """(Q + 1,) running number of fibres that presses (Q, 2) can touch on one pad with strays (2,)."""
    starts = np.zeros(len(presses) + 1, np.int64)
    for q in range(len(presses)):
        starts[q + 1] = starts[q]
        for family in range(2):
            first, end = touched_range(presses[q, 1 - family], reach[family], strays[family], grid)
            starts[q + 1] += max(end - first, 0)
    return starts
