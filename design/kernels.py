"""Compiled kernels: PCHIP slopes and the contact model's sums. Pure functions on arrays, grid units."""

import math
from typing import Any

import numpy as np
from numba import njit, prange

UNIFORM, INVERSE_SQUARE, INVERSE = 0, 1, 2
MANHATTAN, EUCLIDEAN = 0, 1


@njit(cache=True, error_model="numpy")
def _end_slope(h0: float, h1: float, m0: float, m1: float) -> float:
    """Slope at an end knot from the two spans next to it: three-point rule, kept shape-preserving."""
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    if d * m0 <= 0:
        return 0.0
    if m0 * m1 <= 0 and abs(d) > 3 * abs(m0):
        return 3 * m0
    return d


@njit(cache=True, error_model="numpy")
def pchip_slopes(t: Any, v: Any, d: Any) -> None:
    """Fritsch-Butland slopes of the PCHIP through (t, v), both (n,) with t ascending, into d (n,)."""
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
    """Values of the PCHIP through (t, v) at 0, step, 2 step, ... into out; the last sample is the last knot."""
    d = np.empty(len(t))
    pchip_slopes(t, v, d)
    j = 0
    for i in range(len(out) - 1):
        x = i * step
        while j < len(t) - 2 and x >= t[j + 1]:
            j += 1
        h = t[j + 1] - t[j]
        m = (v[j + 1] - v[j]) / h
        s = (x - t[j]) / h
        out[i] = v[j] + h * s * (d[j] + s * ((3 * m - 2 * d[j] - d[j + 1]) + s * (d[j] + d[j + 1] - 2 * m)))
    out[-1] = v[-1]


@njit(cache=True, error_model="numpy")
def inside(dx: float, dy: float, radius: float, sides: int) -> bool:
    """Whether (dx, dy) from the press centre lies in the regular polygon, or the circle where sides is 0."""
    square = dx * dx + dy * dy
    if square > radius * radius:
        return False
    if sides == 0:
        return True
    apothem = radius * math.cos(math.pi / sides)
    if square <= apothem * apothem:
        return True
    wedge = 2 * math.pi / sides
    middle = (math.floor(math.atan2(dy, dx) / wedge) + 0.5) * wedge
    return dx * math.cos(middle) + dy * math.sin(middle) <= apothem


@njit(cache=True, error_model="numpy")
def weigh(square: float, radius: float, weight: int) -> float:
    """Weight of a fibre element at squared distance `square` from the press centre."""
    if weight == UNIFORM:
        return 1.0
    if weight == INVERSE_SQUARE:
        return 1 / (radius + square)
    return 1 / max(math.sqrt(square), radius / 100)


@njit(cache=True, error_model="numpy", parallel=True)
def quantized_signals(
    knots: Any, presses: Any, radius: float, sides: int, weight: int, length: int, samples: int
) -> Any:
    """The published rule: sum over sampled segments that start inside the press.

    Args:
        knots: (P, 2M, N+2, 2). presses: (Q, 2). samples: points per fibre, uniform along its travel axis.

    Returns:
        (P, Q, 2M). Only samples whose travel coordinate a press can reach are looked at.
    """
    population, fibres = knots.shape[:2]
    step = (fibres // 2 + 1) / (samples - 1)
    out = np.zeros((population, len(presses), fibres))
    for index in prange(population * fibres):
        p, f = index // fibres, index % fibres
        travel = 0 if f < fibres // 2 else 1
        curve = np.empty(samples)
        pchip_sample(knots[p, f, :, travel].copy(), knots[p, f, :, 1 - travel].copy(), step, curve)
        for q in range(len(presses)):
            t0, v0 = presses[q, travel], presses[q, 1 - travel]
            first = max(0, math.ceil((t0 - radius) / step) - 1)
            last = min(samples - 2, math.floor((t0 + radius) / step) + 1)
            total = 0.0
            for k in range(first, last + 1):
                dt, dv = k * step - t0, curve[k] - v0
                if abs(dv) > radius:
                    continue
                dx, dy = (dt, dv) if travel == 0 else (dv, dt)
                if inside(dx, dy, radius, sides):
                    rise = abs(curve[k + 1] - curve[k])
                    run = step + rise if length == MANHATTAN else math.hypot(step, rise)
                    total += run * weigh(dt * dt + dv * dv, radius, weight)
            out[p, q, f] = total
    return out


@njit(cache=True, error_model="numpy", parallel=True)
def sample_curves(knots: Any, samples: int) -> Any:
    """Cross coordinates (P, 2M, samples) of the fibres `knots` (P, 2M, N+2, 2), uniform along the travel axis."""
    population, fibres = knots.shape[:2]
    step = (fibres // 2 + 1) / (samples - 1)
    out = np.empty((population, fibres, samples))
    for index in prange(population * fibres):
        p, f = index // fibres, index % fibres
        travel = 0 if f < fibres // 2 else 1
        pchip_sample(knots[p, f, :, travel].copy(), knots[p, f, :, 1 - travel].copy(), step, out[p, f])
    return out
