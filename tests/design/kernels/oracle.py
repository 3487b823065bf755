"""Signals of a layer or a profile by brute force, for comparison."""

from itertools import pairwise

import numpy as np
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline, PchipInterpolator

from padforge.design.contact import profile_weights
from padforge.design.kernels.geometry import DEGREE


def dense_oracle(pad, press, contact, fibre):
    """One signal: Gauss's rule on 1000 pieces of every span of the PCHIP curve, in mm, shortest at its knots.

    Between them the curve may turn within a thousandth of the span. Weights are interpolated anew between the family's.
    """
    axis = pad.layout.family(fibre)
    distance, *weights = profile_weights(contact)[axis if contact.model == "layer" else 0]
    interpolate = panel_polynomials if contact.model == "layer" else spline
    plain, directed = (interpolate(distance**2, values) for values in weights)
    knots, centre = pad.unit_mm * pad.knots[fibre], pad.unit_mm * np.asarray(press)
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    slope, total = curve.derivative(), 0.0
    nodes, shares = np.polynomial.legendre.leggauss(10)
    ends = (1 - np.cos(np.pi * np.linspace(0, 1, 1001))) / 2
    at = (ends[:-1, None] + np.diff(ends)[:, None] * (nodes + 1) / 2).ravel()
    length = (np.diff(ends)[:, None] * shares / 2).ravel()
    for begin, end in pairwise(knots[:, axis]):
        t = begin + (end - begin) * at
        x, y, rise = t - centre[axis], curve(t) - centre[1 - axis], slope(t)
        square = x * x + y * y
        inside = square < distance[-1] ** 2
        x, y, rise, square = x[inside], y[inside], rise[inside], square[inside]
        weight = plain(square) + directed(square) * (x + y * rise) ** 2 / (square * (1 + rise**2))
        run = 1 + np.abs(rise) if contact.length == "manhattan" else np.hypot(1, rise)
        total += weight * run @ length[inside] * (end - begin)
    return total / pad.unit_mm


def spline(squares, values):
    """The cubic spline through a measured profile."""
    return CubicSpline(squares, values, bc_type=((2, 0), (1, 0)))  # pyright: ignore[reportArgumentType]


def panel_polynomials(squares, values):
    """The function of a squared distance that is a polynomial between every eighth of them."""
    begins = squares[:-1:DEGREE]
    panels = [
        Polynomial.fit(squares[i : i + DEGREE + 1], values[i : i + DEGREE + 1], DEGREE)
        for i in range(0, len(squares) - 1, DEGREE)
    ]

    def evaluate(square):
        panel = np.searchsorted(begins, square, side="right") - 1
        return np.piecewise(square, [panel == index for index in range(len(panels))], panels)

    return evaluate
