"""Gradient of the exact signals with respect to knots and slopes.

The signal of a stretch [a, b] of a span is S = integral of w(|p|^2) l ds, with the position p relative to the press
centre and the length l per s. By the Leibniz integral rule, its derivative by a variable x of the span is

    dS/dx = [w l ds/dx]_a^b + integral of (2 w' (p . dp/dx) l + w dl/dx) ds,   ds/dx = -(n . dp/dx) / (n . dp/ds)

at an end at which the span crosses a boundary with normal n, and ds/dx = 0 at an end that is a knot.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.design.kernels.exact_signals import (
    MAX_HALVINGS,
    centre_cubic,
    evaluate_cubic,
    find_stretches_inside,
    integrate_kronrod,
    is_precise,
    make_scratch,
)
from padforge.design.kernels.geometry import EPS, INVERSE, MANHATTAN, UNIFORM, find_touched_range, select_frame, weigh
from padforge.design.kernels.pchip import piece_of

MIN_SINE = 0.02  # minimum sine of the angle between fibre and boundary; the derivative would be unbounded without it
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


@kernel
def differentiate_cubic(s: float, h: float, d0: float, d1: float, d_point: Any, d_tangent: Any) -> None:
    """Compute dp/dx and its derivative by s for x = t0, t1, v0, v1, d0, d1 into two arrays (6, 2).

    The span has the length h along its axis and the slopes d0 and d1 at its knots; s is between 0 and 1.
    """
    d_point[:] = 0.0
    d_tangent[:] = 0.0
    r = 1 - s
    lift, lift_rate = d0 * s * r * r - d1 * s * s * r, d0 * r * (1 - 3 * s) - d1 * s * (2 - 3 * s)
    d_point[0, 0], d_point[0, 1], d_tangent[0, 0], d_tangent[0, 1] = r, -lift, -1.0, -lift_rate
    d_point[1, 0], d_point[1, 1], d_tangent[1, 0], d_tangent[1, 1] = s, lift, 1.0, lift_rate
    d_point[2, 1], d_tangent[2, 1] = (1 + 2 * s) * r * r, -6 * s * r
    d_point[3, 1], d_tangent[3, 1] = s * s * (3 - 2 * s), 6 * s * r
    d_point[4, 1], d_tangent[4, 1] = h * s * r * r, h * r * (1 - 3 * s)
    d_point[5, 1], d_tangent[5, 1] = -h * s * s * r, -h * s * (2 - 3 * s)


@kernel
def _boundary_normal(t: float, v: float, chains: Any, radius: float) -> tuple[float, float]:
    """Return a normal, of any length, of the boundary at (t, v) from the centre."""
    breaks, upper, lower = chains
    last = len(breaks) - 1
    if last < 0:
        return t, v
    k = piece_of(t, breaks, last)
    width = breaks[k + 1] - breaks[k]
    x = (t - breaks[k]) / width
    above = abs(upper[k] + x * (upper[k + 1] - upper[k]) - v)
    below = abs(lower[k] + x * (lower[k + 1] - lower[k]) - v)
    if min(above, below) > 1e-9 * radius:
        return 1.0, 0.0
    chain = upper if above < below else lower
    return -(chain[k + 1] - chain[k]) / width, 1.0


@kernel
def _differentiate_weight(square: float, law: Any) -> float:
    """Return the derivative of `weigh` by the squared distance, for all weights except a profile."""
    radius, weight = law.radius, law.weight
    if weight == UNIFORM:
        return 0.0
    if weight == INVERSE:
        return -0.5 * square**-1.5 if square > (radius / 100) ** 2 else 0.0
    return -1 / (radius + square) ** 2


@kernel
def _add_boundary_term(s: float, s0: float, sign: float, d0: float, d1: float, shape: Any, work: Any, out: Any) -> None:
    """Add the boundary term at s of a stretch to out (6,); sign is 1 at its end and -1 at its beginning."""
    (chains, _, law), (span, d_point, d_tangent) = shape, work
    t, v = span[0] + span[1] * s, evaluate_cubic(span, s)
    dt_ds, dv_ds = span[1], span[3] + s * (2 * span[4] + 3 * s * span[5])
    nt, nv = _boundary_normal(t, v, chains, law.radius)
    normal_rate = nt * dt_ds + nv * dv_ds
    min_rate = MIN_SINE * math.hypot(nt, nv) * math.hypot(dt_ds, dv_ds)
    if abs(normal_rate) < min_rate:
        normal_rate = min_rate if normal_rate > 0 else -min_rate
    speed = dt_ds + abs(dv_ds) if law.length == MANHATTAN else math.hypot(dt_ds, dv_ds)
    value = sign * weigh(t * t + v * v, law) * speed
    differentiate_cubic(s + s0, span[1], d0, d1, d_point, d_tangent)
    for x in range(6):
        out[x] -= value * (nt * d_point[x, 0] + nv * d_point[x, 1]) / normal_rate


@kernel
def _add_inner_term(
    a: float, b: float, s0: float, d0: float, d1: float, shape: Any, work: Any, stack: Any, out: Any
) -> None:
    """Add the integral over [a, b] to out (6,), in closed form or by quadrature on the same pieces as the signal."""
    law, (span, d_point, d_tangent) = shape[2], work
    is_manhattan = law.length == MANHATTAN
    if law.weight == UNIFORM and is_manhattan:
        rise_sign = 1.0 if evaluate_cubic(span, b) >= evaluate_cubic(span, a) else -1.0
        for sign, s in ((1.0, b), (-1.0, a)):
            differentiate_cubic(s + s0, span[1], d0, d1, d_point, d_tangent)
            for x in range(6):
                out[x] += sign * (d_point[x, 0] + rise_sign * d_point[x, 1])
        return
    stack[0, 0], stack[0, 1] = a, b
    top, pieces = 0, 0
    while top >= 0:
        low, high = stack[top]
        pieces += 1
        if top < MAX_HALVINGS and not is_precise(integrate_kronrod(span, low, high, law)[1], pieces):
            stack[top, 1] = 0.5 * (low + high)
            top += 1
            stack[top, 0], stack[top, 1] = 0.5 * (low + high), high
            continue
        top -= 1
        for i in range(len(_NODES)):
            s = 0.5 * (low + high) + 0.5 * (high - low) * _NODES[i]
            share = 0.5 * (high - low) * _WEIGHTS[i]
            t, v = span[0] + span[1] * s, evaluate_cubic(span, s)
            dv_ds = span[3] + s * (2 * span[4] + 3 * s * span[5])
            square = t * t + v * v
            speed = span[1] + abs(dv_ds) if is_manhattan else math.hypot(span[1], dv_ds)
            w, dw_dsquare = weigh(square, law), _differentiate_weight(square, law)
            speed_t = 1.0 if is_manhattan else span[1] / speed
            speed_v = math.copysign(1.0, dv_ds) if is_manhattan else dv_ds / speed
            differentiate_cubic(s + s0, span[1], d0, d1, d_point, d_tangent)
            for x in range(6):
                radial = t * d_point[x, 0] + v * d_point[x, 1]
                out[x] += share * (
                    2 * dw_dsquare * radial * speed + w * (speed_t * d_tangent[x, 0] + speed_v * d_tangent[x, 1])
                )


@kernel
def _differentiate_span(
    t: Any,
    v: Any,
    d: Any,
    j: int,
    ct: float,
    cv: float,
    shape: Any,
    stretches: Any,
    scratch: Any,
    work: Any,
    change: Any,
) -> None:
    """Compute the derivatives of the signal of span j for a press at (ct, cv) into `change` (6,).

    The shape is framed; `work` has arrays for the span (6,) and for the results of `differentiate_cubic`.
    """
    span, (chains, extents, law) = work[0], shape
    s0 = centre_cubic(t[j], t[j + 1], v[j], v[j + 1], d[j], d[j + 1], ct, cv, span)
    change[:] = 0.0
    tolerance = 4 * EPS * (abs(cv) + law.radius)
    count = find_stretches_inside(span, -s0, 1 - s0, chains, extents, law.radius, tolerance, scratch, stretches)
    for i in range(count):
        a, b = stretches[i]
        _add_inner_term(a, b, s0, d[j], d[j + 1], shape, work, scratch[3], change)
        for s, sign, is_knot in ((a, -1.0, a <= -s0), (b, 1.0, b >= 1 - s0)):
            if not is_knot:
                _add_boundary_term(s, s0, sign, d[j], d[j + 1], shape, work, change)


@kernel
def signals_gradient(
    along: Any, across: Any, slope: Any, max_offsets: Any, ends: Any, presses: Any, upstream: Any, shape: Any
) -> Any:
    """Compute the gradient (3, F, n) of sum(upstream * signals) by along, across and slope of one pad.

    Slopes are treated as independent of knots. `upstream` is (Q, F), `max_offsets` (2,). The weight of the law must not
    be PROFILE, for which see `element_signals`.
    """
    (fibres, n), (chains, extents, law) = along.shape, shape
    out, change = np.zeros((3, fibres, n)), np.empty(6)
    work = np.empty(6), np.empty((6, 2)), np.empty((6, 2))
    stretches, scratch = make_scratch(max(chains[0].shape[1], chains[1].shape[1]))
    for q in range(len(presses)):
        for family in range(2):
            ct, cv = presses[q, family], presses[q, 1 - family]
            framed = select_frame(shape, family)
            tolerance = 4 * EPS * (abs(cv) + law.radius)
            low, high = cv + extents[family, 2] - tolerance, cv + extents[family, 3] + tolerance
            first, last = find_touched_range(cv, extents[family], max_offsets[family], ends, family)
            for f in range(first, last):
                t, v, d = along[f], across[f], slope[f]
                j = piece_of(ct + extents[family, 0], t, n)
                while j < n - 1 and t[j] < ct + extents[family, 1]:
                    if min(v[j], v[j + 1]) <= high and max(v[j], v[j + 1]) >= low:
                        _differentiate_span(t, v, d, j, ct, cv, framed, stretches, scratch, work, change)
                        for x in range(6):
                            out[x // 2, f, j + x % 2] += upstream[q, f] * change[x]
                    j += 1
    return out
