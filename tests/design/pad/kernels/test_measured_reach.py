"""Signals under a measured reach: against adaptive quadrature, sampled, and beyond its end."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import brentq

from design import Contact, Morphology, signals, signals_quantized, signals_sparse
from design.pad.contact import signals_and_spans
from design.settings import DEFAULT_PITCH_MM

REACH = ((0.0, 1.0), (0.3, 0.9), (0.6, 0.5), (0.9, 0.15), (1.2, -0.04), (1.6, 0.0))
"""As measured: broad, and a little below 0 before its end; grid units."""
IN_MM = tuple((DEFAULT_PITCH_MM * d, weight) for d, weight in REACH)


def measured_oracle(pad, press, length, fibre):
    """One signal under REACH: SciPy's adaptive quadrature between the circles on which the spline's pieces meet."""
    axis = 0 if fibre < pad.grid else 1
    knots = pad.knots[fibre]
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    slope = curve.derivative()
    distance, weight = np.array(REACH).T
    spline = CubicSpline(distance**2, weight, bc_type=((2, 0), (1, 0)))  # pyright: ignore[reportArgumentType]

    def square(t):
        return (t - press[axis]) ** 2 + (curve(t) - press[1 - axis]) ** 2

    def density(t):
        run = 1 + abs(slope(t)) if length == "manhattan" else np.hypot(1, slope(t))
        return spline(square(t)) * run if square(t) < distance[-1] ** 2 else 0.0

    total = 0.0
    for begin, end in pairwise(knots[:, axis]):
        at = np.linspace(begin, end, 1500)
        ends = {begin, end}
        for d in distance[1:]:
            sign = np.sign(square(at) - d**2)
            ends |= {
                brentq(lambda t, d=d: square(t) - d**2, at[i], at[i + 1], xtol=1e-15)
                for i in np.flatnonzero(np.diff(sign))
            }
        total += sum(quad(density, *piece, epsabs=1e-13, epsrel=1e-12)[0] for piece in pairwise(sorted(ends)))
    return total


@pytest.mark.parametrize("length", ["manhattan", "euclidean"])
def test_signals_of_a_measured_reach_equal_the_oracle(length):
    for knots in (0, 5):
        rng = np.random.default_rng(knots)
        pad, contact = Morphology.random(2, knots, rng), Contact(reach=IN_MM, length=length)
        presses = rng.uniform(0, 3, (2, 2))
        found = signals(pad, presses, contact)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = [[measured_oracle(pad, press, length, fibre) for fibre in range(4)] for press in presses]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(signals_sparse(pad, presses, contact).toarray(), found)
        sampled = signals_quantized(pad, presses, contact, samples=200_001)
        np.testing.assert_allclose(sampled, found, atol=1e-3)


def test_a_measured_reach_is_not_felt_beyond_its_end():
    contact = Contact(reach=IN_MM, length="euclidean")
    found, looked_at = signals_and_spans(Morphology.straight(4), [[1.0, 1.0], [9.0, 9.0]], contact)
    assert looked_at == 4  # fibres 1 and 2 of both families
    assert not found[1].any()
    assert found[0, 0] == found[0, 4] > 0 > found[0, 1] == found[0, 5]
    assert not found[0, [2, 3, 6, 7]].any()
