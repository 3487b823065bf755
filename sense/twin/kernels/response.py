"""What one channel answers to presses, and how that changes with all it depends on.

A fibre is a row of short elements. An element at distance d from the press, whose tangent makes the angle phi with the
way to the press, counts with (w(d) + v(d) cos 2 phi) times its length and its sensitivity; w and v are sums of uniform
cubic B-splines mirrored at 0, so that they are smooth at the centre and 0 from their end on.
"""

import math
from typing import Any

import numpy as np
from numba import njit

CENTRE = 1e-6
"""Squared distance below which the way to the press has no direction, squared grid units."""


@njit(cache=True, error_model="numpy")
def spline_weights(f: float, out: Any) -> None:
    """Values (4,) of the B-splines centred at -1, 0, 1 and 2 at f in [0, 1), and their derivatives, into out (2, 4)."""
    g = 1 - f
    out[0, 0], out[0, 3] = g * g * g / 6, f * f * f / 6
    out[0, 1], out[0, 2] = (3 * f * f * f - 6 * f * f + 4) / 6, (3 * g * g * g - 6 * g * g + 4) / 6
    out[1, 0], out[1, 3] = -g * g / 2, f * f / 2
    out[1, 1], out[1, 2] = (3 * f - 4) * f / 2, -(3 * g - 4) * g / 2


@njit(cache=True, error_model="numpy")
def along_fibre(coefficients: Any, elements: int) -> Any:
    """Smooth curves over a row of elements, cubic B-splines of (n, J) coefficients from end to end.

    Returns:
        Their values at each element and how they change over it, (2, n, F); the first coefficient that each depends on
        (F,), and how its value and its change do on four of them (2, F, 4).
    """
    curves, count = coefficients.shape
    pieces = count - 3
    found, first, share = np.zeros((2, curves, elements)), np.empty(elements, np.int64), np.empty((2, elements, 4))
    bend = np.empty((2, 4))
    for i in range(elements):
        x = (i + 0.5) / elements * pieces
        first[i] = min(int(x), pieces - 1)
        spline_weights(x - first[i], bend)
        for j in range(4):
            share[0, i, j], share[1, i, j] = bend[0, j], bend[1, j] * pieces / elements
            for a in range(curves):
                found[0, a, i] += share[0, i, j] * coefficients[a, first[i] + j]
                found[1, a, i] += share[1, i, j] * coefficients[a, first[i] + j]
    return found, first, share


@njit(cache=True, error_model="numpy", nogil=True)
def channel_response(
    course: Any, tangent: Any, length: Any, aside: Any, sensitivity: Any, places: Any, profile: Any, step: float
) -> Any:
    """Signals of one fibre for presses, and their derivatives.

    Args:
        course, tangent: (F, 2) planned elements, evenly spaced along the fibre, and their unit tangents.
        length: (F,) of the elements.
        aside: (2, J) coefficients of how far each lies beside its plan in x and in y, which also stretches it.
        sensitivity: (1, J') coefficients of the logarithm of how much an element counts.
        places: (Q, 2). profile: (2, K) coefficients of w and of v, whose splines are `step` apart.

    Returns:
        Signals (Q,), and their derivatives by profile (Q, 2, K), aside (Q, 2, J), sensitivity (Q, J'), place (Q, 2).
    """
    elements, splines, presses = len(course), profile.shape[1], len(places)
    end = (splines + 1) * step
    signal, by_profile, by_place = np.zeros(presses), np.zeros((presses, 2, splines)), np.zeros((presses, 2))
    by_aside, by_sensitivity = np.zeros((presses, 2, aside.shape[1])), np.zeros((presses, sensitivity.shape[1]))
    (off, off_first, off_share), here = along_fibre(aside, elements), np.empty((2, 4))
    gain, gain_first, gain_share = along_fibre(sensitivity, elements)
    for i in range(elements):
        at_x, at_y = course[i, 0] + off[0, 0, i], course[i, 1] + off[0, 1, i]
        tx, ty = length[i] * tangent[i, 0] + off[1, 0, i], length[i] * tangent[i, 1] + off[1, 1, i]
        laid = math.sqrt(tx * tx + ty * ty)
        tx, ty = tx / laid, ty / laid
        factor, counts = math.exp(gain[0, 0, i]), math.exp(gain[0, 0, i]) * laid
        for q in range(presses):
            x, y = at_x - places[q, 0], at_y - places[q, 1]
            square = x * x + y * y
            if square >= end * end:
                continue
            far = math.sqrt(square)
            along = x * tx + y * ty
            double = 2 * along * along / (square + CENTRE) - 1
            piece = int(far / step)
            spline_weights(far / step - piece, here)
            weight, rate, turning = 0.0, 0.0, 0.0
            for j in range(4):
                k = abs(piece + j - 1)
                if k < splines:
                    weight += here[0, j] * (profile[0, k] + double * profile[1, k])
                    rate += here[1, j] * (profile[0, k] + double * profile[1, k])
                    turning += here[0, j] * profile[1, k]
                    by_profile[q, 0, k] += counts * here[0, j]
                    by_profile[q, 1, k] += counts * here[0, j] * double
            signal[q] += counts * weight
            pull = counts * rate / (step * max(far, 1e-9))
            twist = counts * turning * 4 * along / (square + CENTRE)
            shrink = pull - twist * along / (square + CENTRE)
            for axis in range(2):
                aim, way = (tx, x) if axis == 0 else (ty, y)
                moved = shrink * way + twist * aim
                stretched = factor * weight * aim + twist * (way - along * aim) / laid
                by_place[q, axis] -= moved
                for j in range(4):
                    by_aside[q, axis, off_first[i] + j] += moved * off_share[0, i, j] + stretched * off_share[1, i, j]
            for j in range(4):
                by_sensitivity[q, gain_first[i] + j] += counts * weight * gain_share[0, i, j]
    return signal, by_profile, by_aside, by_sensitivity, by_place
