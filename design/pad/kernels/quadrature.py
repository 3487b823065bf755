"""Weighted length of a stretch of a span: a closed form where there is one, else adaptive Gauss-Kronrod.

A span is the (6,) array r, h, e0..e3 of `exact_signals`: t = r + h s, v = e0 + e1 s + e2 s^2 + e3 s^3 from the centre
of the press.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from .press import MANHATTAN, PROFILE, UNIFORM, weigh

# G7-K15 nodes and weights on [-1, 1], positive half, the centre last; Gauss weights for every second node
NODES = np.array(
    [
        0.991455371120812639206854697526329,
        0.949107912342758524526189684047851,
        0.864864423359769072789712788640926,
        0.741531185599394439863864773280788,
        0.586087235467691130294144691693013,
        0.405845151377397166906606412076961,
        0.207784955007898467600689403773245,
        0.0,
    ]
)
KRONROD = np.array(
    [
        0.022935322010529224963732008058970,
        0.063092092629978553290700663189204,
        0.104790010322250183839876322541518,
        0.140653259715525918745189590510238,
        0.169004726639267902826583426598550,
        0.190350578064785409913256402421014,
        0.204432940075298892414161999234649,
        0.209482141084727828012999174891714,
    ]
)
GAUSS = np.array(
    [
        0.129484966168869693270611432679082,
        0.279705391489276667901467771423780,
        0.381830050505118944950369775488975,
        0.417959183673469387755102040816327,
    ]
)
HALVINGS = 48
PRECISION, PROFILE_PRECISION = 1e-11, 5e-10
"""To which a piece is integrated where it is no closed form, as a share; of a profile, as a share at weight 1."""
PIECES, PATIENCE = 500, 100
"""Beyond PIECES, what counts as precise doubles with every PATIENCE more: where rounding is all that is left, halving
would never end."""


@njit(cache=True, error_model="numpy")
def across(span: Any, s: float) -> float:
    """v at s."""
    return span[2] + s * (span[3] + s * (span[4] + s * span[5]))


@njit(cache=True, error_model="numpy")
def _density(span: Any, s: float, law: Any) -> float:
    """Weighted length per unit of s."""
    rise = span[3] + s * (2 * span[4] + 3 * s * span[5])
    run = span[1] + abs(rise) if law.length == MANHATTAN else math.sqrt(span[1] ** 2 + rise**2)
    if law.weight == UNIFORM:
        return run
    t, v = span[0] + span[1] * s, across(span, s)
    return run * weigh(t * t + v * v, law)


@njit(cache=True, error_model="numpy")
def kronrod(span: Any, a: float, b: float, law: Any) -> tuple[float, float]:
    """15-point Kronrod integral over [a, b] and its error estimate (difference to 7-point Gauss, sharpened).

    The estimate is a share of the integral, but for a profile, whose weights may cancel, of what it would be at weight
    1; there it is the plain difference, as sharpening holds for smooth functions only, and splines bend at their knots.
    """
    middle, half = 0.5 * (a + b), 0.5 * (b - a)
    centre = _density(span, middle, law)
    fine, coarse = KRONROD[7] * centre, GAUSS[3] * centre
    for i in range(7):
        x = half * NODES[i]
        pair = _density(span, middle - x, law) + _density(span, middle + x, law)
        fine += KRONROD[i] * pair
        if i % 2 == 1:
            coarse += GAUSS[i // 2] * pair
    if law.weight == PROFILE:
        run = span[1] + abs(across(span, b) - across(span, a)) / (b - a)  # spans are monotone
        return fine * half, abs(fine - coarse) / run
    gap = abs(fine - coarse) / fine if fine > 0 else 0.0
    return fine * half, min(1.0, (200 * gap) ** 1.5)


@njit(cache=True, error_model="numpy")
def precise(error: float, pieces: int, law: Any) -> bool:
    """Whether a piece need not be halved, the `pieces`-th that is looked at."""
    least = PROFILE_PRECISION if law.weight == PROFILE else PRECISION
    return error <= least * 2.0 ** (max(pieces - PIECES, 0) / PATIENCE)


@njit(cache=True, error_model="numpy")
def length_element(span: Any, a: float, b: float, law: Any, stack: Any) -> float:
    """Integral of the density over a stretch [a, b] that lies wholly inside the press."""
    if law.weight == UNIFORM and law.length == MANHATTAN:
        mean_rise = span[3] + span[4] * (a + b) + span[5] * (a * a + a * b + b * b)
        return (b - a) * (span[1] + abs(mean_rise))
    total, pieces = 0.0, 0
    stack[0, 0], stack[0, 1] = a, b
    top = 0
    while top >= 0:
        low, high = stack[top]
        part, error = kronrod(span, low, high, law)
        pieces += 1
        if precise(error, pieces, law) or top >= HALVINGS:
            total += part
            top -= 1
        else:
            middle = 0.5 * (low + high)
            stack[top, 1] = middle
            top += 1
            stack[top, 0], stack[top, 1] = middle, high
    return total
