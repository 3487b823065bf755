"""Elongation of fibres by a rigid indenter: integrals along PCHIP spans on the deflected surface.

A span is the cubic of `exact_signals`, t = r + h s, v = e0 + e1 s + e2 s^2 + e3 s^3 from the press centre. The slope of
the surface has a root or a pole in r - a at the edge of the contact. Spans are cut there, and the pieces outside are
integrated in u with s - s_edge ~ u^2, in which both are smooth. Spans are monotone, so their ends bound them: pieces
are halved until none is long for its distance, and then by the Gauss-Kronrod error estimate.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from padforge.design.kernels.exact_signals import (
    GAUSS,
    KRONROD,
    MAX_HALVINGS,
    NODES,
    centre_cubic,
    evaluate_cubic,
    find_circle_roots,
    make_scratch,
)

SPHERE, CONE, FLAT = 0, 1, 2
PRECISION = 1e-6
"""Estimated relative error at which a piece is accepted."""
MAX_PIECE_LENGTH = 4.0
"""Length of a piece above which it is halved at once, relative to its distance plus the contact radius."""
NOTCH_WIDTH = 2e-5
"""Width of the notch in the density that may be skipped, relative to the contact radius."""


@njit(cache=True, error_model="numpy")
def _surface_slope(square: float, a: float, steepness: float, shape: int) -> float:
    """Return -dw/dr / r of the deflected surface at a squared distance; `steepness` as in `integrate_elongations`."""
    r = math.sqrt(square)
    if r <= a:
        if shape == CONE:
            return steepness / r if r > 0 else 0.0
        return steepness / a if shape == SPHERE else 0.0
    x = a / r
    cosine = math.sqrt((r - a) * (r + a)) / r
    if shape == CONE:
        return steepness * x * x / (1 + cosine) / r
    if shape == FLAT:
        return steepness * x * x / cosine / r
    # asin(x) / x - sqrt(1 - x^2), by its series where the difference would lose digits
    slope_part = math.asin(x) / x - cosine if x > 0.02 else x * x * (2 / 3 + x * x * (0.2 + 0.107 * x * x))
    return 2 / math.pi * steepness * slope_part / r


@njit(cache=True, error_model="numpy")
def _density(span: Any, s: float, a: float, steepness: float, shape: int) -> float:
    """Return elongation per unit of s: sqrt(1 + (dw / dl)^2) - 1 times dl / ds; l is arc length."""
    t, v = span[0] + span[1] * s, evaluate_cubic(span, s)
    rise = span[3] + s * (2 * span[4] + 3 * s * span[5])
    speed_square = span[1] ** 2 + rise**2
    slope_part = (_surface_slope(t * t + v * v, a, steepness, shape) * (t * span[1] + v * rise)) ** 2
    return slope_part / (math.sqrt(speed_square + slope_part) + math.sqrt(speed_square)) if speed_square > 0 else 0.0


@njit(cache=True, error_model="numpy")
def _is_long(span: Any, s0: float, s1: float, from_edge: bool, a: float, shape: int) -> bool:
    """Whether a piece is long for its distance, by the box of its ends.

    If a fibre passes the tip of a cone or the edge of a flat punch at a small distance, it does not rise or fall over
    just as short a length: a notch in the density that quadrature would miss.
    """
    t0, t1 = span[0] + span[1] * s0, span[0] + span[1] * s1
    v0, v1 = evaluate_cubic(span, s0), evaluate_cubic(span, s1)
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
def _integrate_piece(span: Any, start: float, end: float, is_quadratic: bool, press: Any, stack: Any) -> float:
    """Integrate the elongation between s = start and s = end, in either order, by adaptive Gauss-Kronrod.

    If `is_quadratic`, for a start at the edge of the contact, then s - start ~ u^2; else s - start ~ u.
    """
    a, steepness, max_error, shape = press
    width, total = end - start, 0.0
    stack[0, 0], stack[0, 1] = 0.0, 1.0
    top = 0
    while top >= 0:
        low, high = stack[top]
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        s0 = start + width * low * (low if is_quadratic else 1.0)
        s1 = start + width * high * (high if is_quadratic else 1.0)
        is_accepted = top >= MAX_HALVINGS or not _is_long(span, s0, s1, is_quadratic and low == 0, a, shape)
        if is_accepted:
            fine, coarse = 0.0, 0.0
            for i in range(15):
                k = i if i < 8 else 14 - i
                u = middle + half * (NODES[k] if i >= 8 else -NODES[k])
                value = _density(span, start + width * (u * u if is_quadratic else u), a, steepness, shape)
                value *= 2 * u if is_quadratic else 1.0
                fine += KRONROD[k] * value
                if k % 2 == 1:
                    coarse += GAUSS[k // 2] * value
            error = (200 * abs(fine - coarse) / fine) ** 1.5 if fine > 0 else 0.0
            fine *= half * abs(width)
            is_accepted = top >= MAX_HALVINGS or error <= PRECISION or min(error, 1.0) * fine <= max_error
            if is_accepted:
                total += fine
                top -= 1
        if not is_accepted:
            stack[top, 1] = middle
            top += 1
            stack[top, 0], stack[top, 1] = middle, high
    return total


@njit(cache=True, error_model="numpy")
def _integrate_span(span: Any, low: float, high: float, press: Any, scratch: Any) -> float:
    """Integrate the elongation of a span from s = low to s = high by a press (a, steepness, max_error, shape)."""
    (a, _, _, shape), (roots, work, p, stack, _) = press, scratch
    t0, t1 = span[0] + span[1] * low, span[0] + span[1] * high
    v0, v1 = evaluate_cubic(span, low), evaluate_cubic(span, high)
    near_t, near_v = max(t0, -t1, 0.0), max(min(v0, v1), -max(v0, v1), 0.0)
    far_t, far_v = max(abs(t0), abs(t1)), max(abs(v0), abs(v1))
    count = 0
    if near_t**2 + near_v**2 < a * a < far_t**2 + far_v**2:
        count = find_circle_roots(span, low, high, a, roots, np.int64(0), work, p)
    total, begin = 0.0, low
    for i in range(count + 1):
        end = high if i == count else roots[i]
        middle = 0.5 * (begin + end)
        t, v = span[0] + span[1] * middle, evaluate_cubic(span, middle)
        if t * t + v * v <= a * a:
            if shape != FLAT:
                total += _integrate_piece(span, begin, end, False, press, stack)
        elif 0 < i < count:
            total += _integrate_piece(span, begin, middle, True, press, stack)
            total += _integrate_piece(span, end, middle, True, press, stack)
        elif i < count:
            total += _integrate_piece(span, end, begin, True, press, stack)
        else:
            total += _integrate_piece(span, begin, end, i > 0, press, stack)
        begin = end
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def integrate_elongations(
    curves: Any, horizontals: int, presses: Any, indentation: Any, begin: int, end: int, out: Any
) -> None:
    """Compute the elongation of every fibre of one pad for presses `begin` to `end`, into `out` (Q, F), zeros before.

    `curves` are along, across and slope. `indentation` is the contact radius a of each press, 0 for no press; the scale
    of dw/dr, `steepness`: slope at the edge a / R of a sphere, slope of the flank of a cone, 2 d / (pi a) of a flat
    punch; the negligible error of a piece; all (Q,); and SPHERE, CONE or FLAT.
    """
    (along, across, slope), (radii, steepness, max_error, shape) = curves, indentation
    fibres, knots = along.shape
    span, scratch = np.empty(6), make_scratch(0)
    for q in range(begin, end):
        if radii[q] == 0:
            continue
        press = radii[q], steepness[q], max_error[q], shape
        for f in range(fibres):
            family = 0 if f < horizontals else 1
            ct, cv = presses[q, family], presses[q, 1 - family]
            t, v, d = along[f], across[f], slope[f]
            for j in range(knots - 1):
                s0 = centre_cubic(t[j], t[j + 1], v[j], v[j + 1], d[j], d[j + 1], ct, cv, span)
                out[q, f] += _integrate_span(span, -s0, 1 - s0, press, scratch)
