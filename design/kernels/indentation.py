"""How much a rigid indenter lengthens the fibres: integrals along PCHIP spans of the surface it deflects.

A span is the cubic of `exact_signals`, t = r + h s, v = e0 + e1 s + e2 s^2 + e3 s^3 from the press centre. The slope of
the surface has a root or a pole in r - a at the edge of the contact; spans are cut there, and the pieces outside run in
u with s - s_edge ~ u^2, in which both are smooth. Spans are monotone, so their ends box them: pieces are halved until
none is long for its distance, and then by the error that Gauss-Kronrod estimates.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from padforge.design.kernels.exact_signals import (
    GAUSS,
    HALVINGS,
    KRONROD,
    NODES,
    across,
    circle_roots,
    local_cubic,
    make_scratch,
)

SPHERE, CONE, FLAT = 0, 1, 2
PRECISION = 1e-6
"""Estimated relative error at which a piece is taken."""
MAX_PIECE_LENGTH = 4.0
"""Length of a piece, of its distance from the centre plus the contact radius, above which it is halved unseen."""
NOTCH_WIDTH = 2e-5
"""Width of the notch in the density, of the contact radius, that may be stepped over."""


@njit(cache=True, error_model="numpy")
def _descent(square: float, a: float, steepness: float, shape: int) -> float:
    """-dw/dr / r of the deflected surface at squared distance `square`; steepness as in `lengthenings`."""
    r = math.sqrt(square)
    if r <= a:
        if shape == CONE:
            return steepness / r if r > 0 else 0.0
        return steepness / a if shape == SPHERE else 0.0
    x = a / r
    rest = math.sqrt((r - a) * (r + a)) / r
    if shape == CONE:
        return steepness * x * x / (1 + rest) / r
    if shape == FLAT:
        return steepness * x * x / rest / r
    # asin(x) / x - sqrt(1 - x^2), by its series where the difference would lose digits
    fall = math.asin(x) / x - rest if x > 0.02 else x * x * (2 / 3 + x * x * (0.2 + 0.107 * x * x))
    return 2 / math.pi * steepness * fall / r


@njit(cache=True, error_model="numpy")
def _density(span: Any, s: float, a: float, steepness: float, shape: int) -> float:
    """Lengthening per unit of s: sqrt(1 + (dw / dl)^2) - 1 times dl / ds, l the fibre's own arc length."""
    t, v = span[0] + span[1] * s, across(span, s)
    rise = span[3] + s * (2 * span[4] + 3 * s * span[5])
    own = span[1] ** 2 + rise**2
    fall = (_descent(t * t + v * v, a, steepness, shape) * (t * span[1] + v * rise)) ** 2
    return fall / (math.sqrt(own + fall) + math.sqrt(own)) if own > 0 else 0.0


@njit(cache=True, error_model="numpy")
def _is_long(span: Any, s0: float, s1: float, from_edge: bool, a: float, shape: int) -> bool:
    """Whether a piece is long for where it lies, by the box of its ends.

    A fibre that passes the tip of a cone, or the edge of a flat punch, at a small distance does not rise or fall for
    as short a length: a notch in the density that quadrature would step over.

    Args:
        from_edge: whether the piece starts at the edge of the contact.
    """
    t0, t1 = span[0] + span[1] * s0, span[0] + span[1] * s1
    v0, v1 = across(span, s0), across(span, s1)
    dt, dv = max(min(t0, t1), -max(t0, t1), 0.0), max(min(v0, v1), -max(v0, v1), 0.0)
    gap = math.sqrt(dt * dt + dv * dv)
    if shape == CONE and gap < a:
        scale = gap + NOTCH_WIDTH * a
    elif shape == FLAT and not from_edge:
        scale = math.sqrt(max(gap - a, 0.0) * (gap + a)) + NOTCH_WIDTH * a
    else:
        scale = gap + a
    return abs(t1 - t0) + abs(v1 - v0) > MAX_PIECE_LENGTH * scale


@njit(cache=True, error_model="numpy")
def _integral(
    span: Any, start: float, end: float, bent: bool, a: float, steepness: float, floor: float, shape: int, stack: Any
) -> float:
    """Lengthening between s = start and s = end, in either order.

    Args:
        bent: whether s - start ~ u^2, for a start at the edge of the contact; else s - start ~ u.
        floor: an error that does not matter.
    """
    width = end - start
    total = 0.0
    stack[0, 0], stack[0, 1] = 0.0, 1.0
    top = 0
    while top >= 0:
        low, high = stack[top]
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        s0, s1 = (
            (start + width * low * low, start + width * high * high)
            if bent
            else (start + width * low, start + width * high)
        )
        taken = top >= HALVINGS or not _is_long(span, s0, s1, bent and low == 0, a, shape)
        if taken:
            fine, coarse = 0.0, 0.0
            for i in range(15):
                k = i if i < 8 else 14 - i
                u = middle + half * (NODES[k] if i >= 8 else -NODES[k])
                value = _density(span, start + width * (u * u if bent else u), a, steepness, shape)
                value *= 2 * u if bent else 1.0
                fine += KRONROD[k] * value
                if k % 2 == 1:
                    coarse += GAUSS[k // 2] * value
            error = (200 * abs(fine - coarse) / fine) ** 1.5 if fine > 0 else 0.0
            fine *= half * abs(width)
            taken = top >= HALVINGS or error <= PRECISION or min(error, 1.0) * fine <= floor
            if taken:
                total += fine
                top -= 1
        if not taken:
            stack[top, 1] = middle
            top += 1
            stack[top, 0], stack[top, 1] = middle, high
    return total


@njit(cache=True, error_model="numpy")
def _span_lengthening(
    span: Any, low: float, high: float, a: float, steepness: float, floor: float, shape: int, scratch: Any
) -> float:
    """Lengthening of a span from s = low to s = high."""
    roots, work, p, stack, _ = scratch
    t0, t1 = span[0] + span[1] * low, span[0] + span[1] * high
    v0, v1 = across(span, low), across(span, high)
    near_t, near_v = max(t0, -t1, 0.0), max(min(v0, v1), -max(v0, v1), 0.0)
    far_t, far_v = max(abs(t0), abs(t1)), max(abs(v0), abs(v1))
    count = 0
    if near_t**2 + near_v**2 < a * a < far_t**2 + far_v**2:
        count = circle_roots(span, low, high, a, roots, np.int64(0), work, p)
    total, begin = 0.0, low
    for i in range(count + 1):
        end = high if i == count else roots[i]
        middle = 0.5 * (begin + end)
        t, v = span[0] + span[1] * middle, across(span, middle)
        if t * t + v * v <= a * a:
            if shape != FLAT:
                total += _integral(span, begin, end, False, a, steepness, floor, shape, stack)
        elif 0 < i < count:
            total += _integral(span, begin, middle, True, a, steepness, floor, shape, stack)
            total += _integral(span, end, middle, True, a, steepness, floor, shape, stack)
        elif i < count:
            total += _integral(span, end, begin, True, a, steepness, floor, shape, stack)
        else:
            total += _integral(span, begin, end, i > 0, a, steepness, floor, shape, stack)
        begin = end
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def lengthenings(
    travel: Any,
    cross: Any,
    slope: Any,
    horizontals: int,
    presses: Any,
    contact_radius: Any,
    steepness: Any,
    floor: Any,
    shape: int,
    begin: int,
    end: int,
    out: Any,
) -> None:
    """Lengthening of every fibre of one pad for presses begin..end, into out (Q, F), zeros before.

    Args:
        travel, cross, slope: (F, n) knots and slopes. horizontals: how many of them. presses: (Q, 2) x and y.
        contact_radius: (Q,) a; 0 for no press.
        steepness: (Q,) what scales dw/dr: of a sphere the slope at the edge a / R, of a cone that of its flank, of a
            flat punch 2 d / (pi a).
        floor: (Q,) an error in a piece's lengthening that does not matter.
    """
    fibres, knots = travel.shape
    span, scratch = np.empty(6), make_scratch(0)
    for q in range(begin, end):
        a = contact_radius[q]
        if a == 0:
            continue
        for f in range(fibres):
            family = 0 if f < horizontals else 1
            ct, cv = presses[q, family], presses[q, 1 - family]
            t, v, d = travel[f], cross[f], slope[f]
            for j in range(knots - 1):
                s0 = local_cubic(t[j], t[j + 1], v[j], v[j + 1], d[j], d[j + 1], ct, cv, span)
                out[q, f] += _span_lengthening(span, -s0, 1 - s0, a, steepness[q], floor[q], shape, scratch)
