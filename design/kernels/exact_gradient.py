"""The exact signals differentiated with respect to knots and slopes.

The signal of a stretch [a, b] of a span, S = integral of w(|p|^2) l ds with p the place from the press centre and l the
length per s, changes with a variable x of the span by

    dS/dx = [w l ds/dx]_a^b + integral of (2 w' (p . dp/dx) l + w dl/dx) ds,   ds/dx = -(n . dp/dx) / (n . dp/ds)

at an end where the span crosses a boundary with normal n, and ds/dx = 0 at an end that is a knot.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from padforge.design.kernels.exact_signals import (
    HALVINGS,
    across,
    kronrod,
    local_cubic,
    make_scratch,
    precise,
    stretches_inside,
)
from padforge.design.kernels.geometry import EPS, INVERSE, MANHATTAN, UNIFORM, in_frame, touched_range, weigh
from padforge.design.kernels.pchip import piece_of

GRAZING = 0.02
"""Least sine of the angle of a fibre to the boundary: flatter ones change their length there without bound."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


@njit(cache=True, error_model="numpy")
def variations(s: float, h: float, d0: float, d1: float, place: Any, rate: Any) -> None:
    """dp/dx and its derivative by s, both (6, 2), for x = t0, t1, v0, v1, d0, d1, at s in [0, 1] of the span."""
    place[:] = 0.0
    rate[:] = 0.0
    r = 1 - s
    lift, lift_rate = d0 * s * r * r - d1 * s * s * r, d0 * r * (1 - 3 * s) - d1 * s * (2 - 3 * s)
    place[0, 0], place[0, 1], rate[0, 0], rate[0, 1] = r, -lift, -1.0, -lift_rate
    place[1, 0], place[1, 1], rate[1, 0], rate[1, 1] = s, lift, 1.0, lift_rate
    place[2, 1], rate[2, 1] = (1 + 2 * s) * r * r, -6 * s * r
    place[3, 1], rate[3, 1] = s * s * (3 - 2 * s), 6 * s * r
    place[4, 1], rate[4, 1] = h * s * r * r, h * r * (1 - 3 * s)
    place[5, 1], rate[5, 1] = -h * s * s * r, -h * s * (2 - 3 * s)


@njit(cache=True, error_model="numpy")
def _normal(t: float, v: float, chains: Any, radius: float) -> tuple[float, float]:
    """Normal, of any length, of the boundary at (t, v) from the centre."""
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


@njit(cache=True, error_model="numpy")
def _weight_rate(square: float, law: Any) -> float:
    """Derivative of `weigh` by the squared distance, but of a profile."""
    radius, weight = law.radius, law.weight
    if weight == UNIFORM:
        return 0.0
    if weight == INVERSE:
        return -0.5 * square**-1.5 if square > (radius / 100) ** 2 else 0.0
    return -1 / (radius + square) ** 2


@njit(cache=True, error_model="numpy")
def _end(s: float, s0: float, sign: float, d0: float, d1: float, shape: Any, work: Any, out: Any) -> None:
    """Add to out (6,) what the end at s of a stretch contributes; sign is 1 for its last end and -1 for its first."""
    (chains, _, law), (span, place, rate) = shape, work
    t, v = span[0] + span[1] * s, across(span, s)
    along_t, along_v = span[1], span[3] + s * (2 * span[4] + 3 * s * span[5])
    nt, nv = _normal(t, v, chains, law.radius)
    through = nt * along_t + nv * along_v
    least = GRAZING * math.hypot(nt, nv) * math.hypot(along_t, along_v)
    if abs(through) < least:
        through = least if through > 0 else -least
    run = along_t + abs(along_v) if law.length == MANHATTAN else math.hypot(along_t, along_v)
    value = sign * weigh(t * t + v * v, law) * run
    variations(s + s0, span[1], d0, d1, place, rate)
    for x in range(6):
        out[x] -= value * (nt * place[x, 0] + nv * place[x, 1]) / through


@njit(cache=True, error_model="numpy")
def _inner(a: float, b: float, s0: float, d0: float, d1: float, shape: Any, work: Any, stack: Any, out: Any) -> None:
    """Add to out (6,) the integral over [a, b]: a closed form, or quadrature on the pieces that suit the signal."""
    law, (span, place, rate) = shape[2], work
    is_manhattan = law.length == MANHATTAN
    if law.weight == UNIFORM and is_manhattan:
        rising = 1.0 if across(span, b) >= across(span, a) else -1.0
        for sign, s in ((1.0, b), (-1.0, a)):
            variations(s + s0, span[1], d0, d1, place, rate)
            for x in range(6):
                out[x] += sign * (place[x, 0] + rising * place[x, 1])
        return
    stack[0, 0], stack[0, 1] = a, b
    top, pieces = 0, 0
    while top >= 0:
        low, high = stack[top]
        pieces += 1
        if top < HALVINGS and not precise(kronrod(span, low, high, law)[1], pieces, law):
            stack[top, 1] = 0.5 * (low + high)
            top += 1
            stack[top, 0], stack[top, 1] = 0.5 * (low + high), high
            continue
        top -= 1
        for i in range(len(_NODES)):
            s = 0.5 * (low + high) + 0.5 * (high - low) * _NODES[i]
            share = 0.5 * (high - low) * _WEIGHTS[i]
            t, v = span[0] + span[1] * s, across(span, s)
            along = span[3] + s * (2 * span[4] + 3 * s * span[5])
            square = t * t + v * v
            run = span[1] + abs(along) if is_manhattan else math.hypot(span[1], along)
            w, w_rate = weigh(square, law), _weight_rate(square, law)
            run_t = 1.0 if is_manhattan else span[1] / run
            run_v = math.copysign(1.0, along) if is_manhattan else along / run
            variations(s + s0, span[1], d0, d1, place, rate)
            for x in range(6):
                moved = t * place[x, 0] + v * place[x, 1]
                out[x] += share * (2 * w_rate * moved * run + w * (run_t * rate[x, 0] + run_v * rate[x, 1]))


@njit(cache=True, error_model="numpy")
def _span(
    t: Any, v: Any, d: Any, j: int, ct: float, cv: float, shape: Any, scratch: Any, work: Any, change: Any
) -> None:
    """Set change (6,) to the derivatives of what span j of a fibre signals for a press at (ct, cv).

    Args:
        shape: of `in_frame`. work: (6,) the span, and (6, 2) place and rate of `variations`, all overwritten.
    """
    span, tolerance = work[0], 4 * EPS * (abs(cv) + shape[2].radius)
    s0 = local_cubic(t[j], t[j + 1], v[j], v[j + 1], d[j], d[j + 1], ct, cv, span)
    change[:] = 0.0
    for i in range(stretches_inside(span, -s0, 1 - s0, shape, tolerance, scratch)):
        a, b = scratch[4][i]
        _inner(a, b, s0, d[j], d[j + 1], shape, work, scratch[3], change)
        for s, sign, is_knot in ((a, -1.0, a <= -s0), (b, 1.0, b >= 1 - s0)):
            if not is_knot:
                _end(s, s0, sign, d[j], d[j + 1], shape, work, change)


@njit(cache=True, error_model="numpy", nogil=True)
def signals_gradient(
    travel: Any,
    cross: Any,
    slope: Any,
    strays: Any,
    ends: Any,
    presses: Any,
    upstream: Any,
    chains: tuple[Any, Any],
    reach: Any,
    law: Any,
) -> Any:
    """Gradient (3, F, n) of sum(upstream * signals) by knots' travel and cross coordinates and slopes, one pad.

    Args:
        travel, cross, slope: (F, n), held independent. strays: (2,). ends: `Ends`. presses: (Q, 2). upstream: (Q, F).
        law: of any weight but PROFILE, whose gradient `measured_signals` has.
    """
    fibres, n = travel.shape
    out = np.zeros((3, fibres, n))
    change = np.empty(6)
    work = np.empty(6), np.empty((6, 2)), np.empty((6, 2))
    scratch = make_scratch(max(chains[0].shape[1], chains[1].shape[1]))
    for q in range(len(presses)):
        for family in range(2):
            ct, cv = presses[q, family], presses[q, 1 - family]
            shape = in_frame((chains, reach, law), family)
            tolerance = 4 * EPS * (abs(cv) + law.radius)
            low, high = cv + reach[family, 2] - tolerance, cv + reach[family, 3] + tolerance
            first, last = touched_range(cv, reach[family], strays[family], ends, family)
            for f in range(first, last):
                t, v, d = travel[f], cross[f], slope[f]
                j = piece_of(ct + reach[family, 0], t, n)
                while j < n - 1 and t[j] < ct + reach[family, 1]:
                    if min(v[j], v[j + 1]) <= high and max(v[j], v[j + 1]) >= low:
                        _span(t, v, d, j, ct, cv, shape, scratch, work, change)
                        for x in range(6):
                            out[x // 2, f, j + x % 2] += upstream[q, f] * change[x]
                    j += 1
    return out
