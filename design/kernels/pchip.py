"""PCHIP curves: slopes, samples and lengths, in grid units, and their gradients by knots."""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


@kernel
def piece_of(at: float, edges: Any, pieces: int) -> int:
    """Return the index of the piece that contains `at`, or the nearest one, by bisection of ascending `edges`."""
    low, high = 0, pieces
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] <= at:
            low = middle
        else:
            high = middle
    return low


@kernel
def extremes(values: Any) -> tuple[float, float]:
    """Return the smallest and the largest of (n,) values."""
    least = largest = values[0]
    for value in values:
        least, largest = min(least, value), max(largest, value)
    return least, largest


@kernel
def _end_slope(h0: float, h1: float, m0: float, m1: float) -> float:
    """Return the slope at an end knot by the three-point formula, limited to preserve the shape."""
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    if d * m0 <= 0:
        return 0.0
    if m0 * m1 <= 0 and abs(d) > 3 * abs(m0):
        return 3 * m0
    return d


@kernel
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


@kernel(inline="always")
def _add_end_slope_gradient(h0: float, h1: float, m0: float, m1: float, upstream: float, out: Any) -> None:
    """Add the derivatives of `_end_slope` by its arguments, times `upstream`, to out (4,)."""
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    if d * m0 <= 0:
        return
    if m0 * m1 <= 0 and abs(d) > 3 * abs(m0):
        out[2] += 3 * upstream
        return
    share = upstream / (h0 + h1)
    out[0] += share * (2 * m0 - m1 - d)
    out[1] += share * (m0 - d)
    out[2] += share * (2 * h0 + h1)
    out[3] -= share * h0


@kernel(inline="always")
def add_slopes_gradient(t: Any, v: Any, d: Any, upstream: Any, grad_t: Any, grad_v: Any) -> None:
    """Add the gradient of sum(upstream * d) of `pchip_slopes`, by t and by v."""
    n = len(t)
    grad_h, grad_m, change = np.zeros(n - 1), np.zeros(n - 1), np.empty(4)
    if n == 2:
        grad_m[0] = upstream[0] + upstream[1]
    else:
        for k in range(1, n - 1):
            if d[k] == 0:
                continue
            h0, h1 = t[k] - t[k - 1], t[k + 1] - t[k]
            m0, m1 = (v[k] - v[k - 1]) / h0, (v[k + 1] - v[k]) / h1
            w0, w1 = 2 * h1 + h0, h1 + 2 * h0
            share = upstream[k] * d[k] / (w0 + w1)
            grad_m[k - 1] += share * d[k] * w0 / m0**2
            grad_m[k] += share * d[k] * w1 / m1**2
            grad_w0, grad_w1 = share * (1 - d[k] / m0), share * (1 - d[k] / m1)
            grad_h[k - 1] += grad_w0 + 2 * grad_w1
            grad_h[k] += grad_w1 + 2 * grad_w0
        for end, beside in ((0, 1), (n - 2, n - 3)):
            h0, h1 = t[end + 1] - t[end], t[beside + 1] - t[beside]
            m0, m1 = (v[end + 1] - v[end]) / h0, (v[beside + 1] - v[beside]) / h1
            change[:] = 0
            _add_end_slope_gradient(h0, h1, m0, m1, upstream[0 if end == 0 else n - 1], change)
            grad_h[end] += change[0]
            grad_h[beside] += change[1]
            grad_m[end] += change[2]
            grad_m[beside] += change[3]
    for k in range(n - 1):
        h = t[k + 1] - t[k]
        rise = grad_m[k] / h
        run = grad_h[k] - rise * (v[k + 1] - v[k]) / h
        grad_v[k] -= rise
        grad_v[k + 1] += rise
        grad_t[k] -= run
        grad_t[k + 1] += run


@kernel
def pchip_value(t: Any, v: Any, d: Any, j: int, s: float) -> tuple[float, float]:
    """Return value and slope of the curve through (t, v) with the slopes d, at a fraction s of span j."""
    h, r = t[j + 1] - t[j], 1 - s
    m = (v[j + 1] - v[j]) / h
    value = v[j] + h * s * (m * s * (3 - 2 * s) + r * (d[j] * r - d[j + 1] * s))
    return value, 6 * m * s * r + d[j] * r * (1 - 3 * s) - d[j + 1] * s * (2 - 3 * s)


@kernel
def add_value_gradient(
    t: Any,
    v: Any,
    d: Any,
    j: int,
    s: float,
    grad_value: float,
    grad_slope: float,
    grad_t: Any,
    grad_v: Any,
    grad_d: Any,
) -> None:
    """Add the gradient of grad_value * value + grad_slope * slope of `pchip_value`, for s held, by t, by v and by d."""
    h, r = t[j + 1] - t[j], 1 - s
    m = (v[j + 1] - v[j]) / h
    rise = grad_value * s * s * (3 - 2 * s) + grad_slope * 6 * s * r / h
    grad_v[j] += grad_value - rise
    grad_v[j + 1] += rise
    grad_d[j] += grad_value * h * s * r * r + grad_slope * r * (1 - 3 * s)
    grad_d[j + 1] -= grad_value * h * s * s * r + grad_slope * s * (2 - 3 * s)
    run = grad_value * s * r * (d[j] * r - d[j + 1] * s) - grad_slope * 6 * m * s * r / h
    grad_t[j] -= run
    grad_t[j + 1] += run


@kernel
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
        for k in range(len(part)):  # a slice has no negative indices, so that the compiler vectorises the loop
            s = ((i + k) * step - start) * per_h
            part[k] = first + s * (a1 + s * (a2 + s * a3))
        i = end
    out[-1] = v[-1]


@kernel
def population_slopes(along: Any, across: Any) -> Any:
    """Compute the slopes (P, F, n) of the PCHIP curves of a population."""
    out = np.empty_like(across)
    for p in range(len(along)):
        for f in range(along.shape[1]):
            pchip_slopes(along[p, f], across[p, f], out[p, f])
    return out


@kernel
def sample_spans(along: Any, across: Any, slope: Any, shares: Any, points: Any, slopes: Any) -> None:
    """Sample fibres (F, n) at the fractions `shares` (K,) of every span, and at the last knot.

    Results are `points` (F, P, 2), along and across, and `slopes` (F, P), with P = K (n - 1) + 1.
    """
    count, n = len(shares), along.shape[1]
    for f in range(len(along)):
        t, v, d = along[f], across[f], slope[f]
        for j in range(n - 1):
            for k in range(count):
                i = j * count + k
                points[f, i, 0] = t[j] + (t[j + 1] - t[j]) * shares[k]
                points[f, i, 1], slopes[f, i] = pchip_value(t, v, d, j, shares[k])
        points[f, -1, 0], points[f, -1, 1], slopes[f, -1] = t[n - 1], v[n - 1], d[n - 1]


@kernel
def add_samples_gradient(
    along: Any,
    across: Any,
    slope: Any,
    shares: Any,
    grad_points: Any,
    grad_slopes: Any,
    grad_along: Any,
    grad_across: Any,
    grad_slope: Any,
) -> None:
    """Add the gradient of sum(grad_points * points + grad_slopes * slopes) of `sample_spans` by knots and slopes."""
    count, n = len(shares), along.shape[1]
    for f in range(len(along)):
        t, v, d, grad_t, grad_v, grad_d = along[f], across[f], slope[f], grad_along[f], grad_across[f], grad_slope[f]
        for j in range(n - 1):
            for k in range(count):
                i = j * count + k
                grad_t[j] += grad_points[f, i, 0] * (1 - shares[k])
                grad_t[j + 1] += grad_points[f, i, 0] * shares[k]
                add_value_gradient(
                    t, v, d, j, shares[k], grad_points[f, i, 1], grad_slopes[f, i], grad_t, grad_v, grad_d
                )
        grad_t[n - 1] += grad_points[f, -1, 0]
        grad_v[n - 1] += grad_points[f, -1, 1]
        grad_d[n - 1] += grad_slopes[f, -1]


@kernel
def fibre_slopes_gradient(along: Any, across: Any, slope: Any, upstream: Any) -> Any:
    """Compute the gradient (2, F, n) of sum(upstream * slope), with the slopes of a pad, by along and across."""
    out = np.zeros((2, *along.shape))
    for f in range(len(along)):
        add_slopes_gradient(along[f], across[f], slope[f], upstream[f], out[0, f], out[1, f])
    return out


@kernel
def arc_lengths_gradient(along: Any, across: Any, slope: Any, out: Any) -> Any:
    """Compute the arc lengths (F,) of fibres, to 1e-3 if they are steep.

    The gradient of each length by the along, across and slope of its fibre is written into `out` (3, F, n).
    """
    lengths = np.zeros(len(along))
    out[:] = 0
    for f in range(len(along)):
        t, v, d = along[f], across[f], slope[f]
        for j in range(along.shape[1] - 1):
            h = t[j + 1] - t[j]
            for k in range(len(_NODES)):
                s, weight = 0.5 * _NODES[k] + 0.5, 0.5 * _WEIGHTS[k]
                rate = pchip_value(t, v, d, j, s)[1]
                speed = math.sqrt(1 + rate * rate)
                lengths[f] += weight * h * speed
                out[0, f, j] -= weight * speed
                out[0, f, j + 1] += weight * speed
                grad_rate = weight * h * rate / speed
                add_value_gradient(t, v, d, j, s, 0.0, grad_rate, out[0, f], out[1, f], out[2, f])
    return lengths
