"""PCHIP curves: slopes and samples, in grid units."""

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def piece_of(at: float, edges: Any, pieces: int) -> int:
    """Return the index of the piece that contains `at` by bisection of ascending `edges`; the first if none does."""
    low, high = 0, pieces
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] <= at:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def extremes(values: Any) -> tuple[float, float]:
    """Return the smallest and the largest of (n,) values."""
    least = largest = values[0]
    for value in values:
        least, largest = min(least, value), max(largest, value)
    return least, largest


@njit(cache=True, error_model="numpy")
def _end_slope(h0: float, h1: float, m0: float, m1: float) -> float:
    """Return the slope at an end knot: three-point rule, limited to preserve the shape."""
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    if d * m0 <= 0:
        return 0.0
    if m0 * m1 <= 0 and abs(d) > 3 * abs(m0):
        return 3 * m0
    return d


@njit(cache=True, error_model="numpy")
def pchip_slopes(t: Any, v: Any, d: Any) -> None:
    """Compute the slopes d of the PCHIP interpolant of (t, v) at its knots (Fritsch and Butland 1984)."""
    n = len(t)
    if n == 2:
        d[0] = d[1] = (v[1] - v[0]) / (t[1] - t[0])
        return
    for k in range(1, n - 1):
        h0, h1 = t[k] - t[k - 1], t[k + 1] - t[k]
        m0, m1 = (v[k] - v[k - 1]) / h0, (v[k + 1] - v[k]) / h1
        if m0 * m1 <= 0:
            d[k] = 0.0
        else:
            w0, w1 = 2 * h1 + h0, h1 + 2 * h0
            d[k] = (w0 + w1) / (w0 / m0 + w1 / m1)
    h0, h1 = t[1] - t[0], t[2] - t[1]
    d[0] = _end_slope(h0, h1, (v[1] - v[0]) / h0, (v[2] - v[1]) / h1)
    h0, h1 = t[n - 1] - t[n - 2], t[n - 2] - t[n - 3]
    d[n - 1] = _end_slope(h0, h1, (v[n - 1] - v[n - 2]) / h0, (v[n - 2] - v[n - 3]) / h1)


@njit(cache=True, error_model="numpy")
def pchip_sample(t: Any, v: Any, step: float, out: Any) -> None:
    """Sample the PCHIP interpolant of (t, v) at 0, step, 2 step, ... into `out`; the last sample is the last knot."""
    d = np.empty(len(t))
    pchip_slopes(t, v, d)
    i = 0
    for j in range(len(t) - 1):
        h, rise = t[j + 1] - t[j], v[j + 1] - v[j]
        a1, a2, a3 = h * d[j], 3 * rise - h * (2 * d[j] + d[j + 1]), h * (d[j] + d[j + 1]) - 2 * rise
        end = max(min(math.ceil(t[j + 1] / step), len(out) - 1), i)
        part, start, first, per_h = out[i:end], t[j], v[j], 1 / h
        for k in range(len(part)):  # over a slice: the compiler need not look for negative indices, and vectorises
            s = ((i + k) * step - start) * per_h
            part[k] = first + s * (a1 + s * (a2 + s * a3))
        i = end
    out[-1] = v[-1]


@njit(cache=True, error_model="numpy", nogil=True)
def population_slopes(along: Any, across: Any) -> Any:
    """Compute the slopes (P, F, n) of the PCHIP curves of a population."""
    out = np.empty_like(across)
    for p in range(len(along)):
        for f in range(along.shape[1]):
            pchip_slopes(along[p, f], across[p, f], out[p, f])
    return out
