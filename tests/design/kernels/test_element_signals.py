"""Signals of a measured profile and of a pressed layer against dense quadrature, to the precision that is asked for."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline, PchipInterpolator

from padforge.design import Contact, Morphology, signals, signals_quantized
from padforge.design.contact import fibre_axes, profile_weights
from padforge.design.kernels.element_signals import FINE_PRECISION, LAYER_PRECISION
from padforge.design.kernels.geometry import DEGREE
from padforge.design.settings import DEFAULT_PITCH_MM, PUBLISHED_CONTACT
from padforge.design.signal_gradients import FibreCurves
from tests.design.wild_pads import Length


def contact_of(*profile, length: Length = "euclidean"):
    """The contact of a profile by distances in grid units, on pads of the default pitch."""
    return Contact(sensitivity_profile=tuple((DEFAULT_PITCH_MM * d, w) for d, w in profile), length=length)


BROAD = (0.0, 1.0), (0.3, 0.9), (0.6, 0.5), (0.9, 0.15), (1.2, -0.04), (1.6, 0.0)
PROFILES = {
    "broad": contact_of(*BROAD),
    "manhattan": contact_of(*BROAD, length="manhattan"),
    "below 0": contact_of((0.0, -0.3), (0.2, -0.5), (0.35, -0.35), (0.5, 0.1), (0.6, 0.2), (0.9, 0.0)),
    "beyond the pad": contact_of((0.0, 1.0), (2.0, 0.8), (4.0, 0.3), (6.0, 0.0)),
}
LAYERS = {
    "default": Contact(),
    "stretched": Contact(squeeze=0.0),
    "flat, shallow": Contact(tool="flat", tool_radius_mm=4.0, depth_mm=1.0, fibre_depths_mm=(3.0, 1.0)),
    "wider": Contact(tool="finger", thickness_mm=10.0, scale=1.3),
}
CONTACTS = PROFILES | LAYERS


def curves(pad, move: np.ndarray | float = 0.0):
    """Fibres as a search takes them, with knots moved by (2, F, n)."""
    axes = fibre_axes(pad)
    along, across = np.array([axes[0][0], axes[1][0]]) + move
    return FibreCurves(along, across, pad.layout)


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_signals_are_as_precise_as_asked(contact):
    pad, press = Morphology.random((1, 1), 3, seed=1), np.random.default_rng(1).uniform(0.3, 1.7, (1, 2))
    expected = np.array([[dense_oracle(pad, press[0], contact, fibre) for fibre in range(2)]])
    for precision in (1e-3, 1e-5, 1e-6):
        found = signals(pad, press, contact, precision=precision)
        np.testing.assert_allclose(found, expected, rtol=0, atol=precision * np.abs(expected).max())
    sampled = signals_quantized(pad, press, contact, samples=50_001)
    np.testing.assert_allclose(sampled, expected, rtol=0, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("contact", "seed", "press", "fibre"),
    [(Contact(model="profile"), 41, 2, 3), (LAYERS["default"], 40, 1, 2), (LAYERS["flat, shallow"], 38, 2, 0)],
)
def test_signals_are_precise_where_a_bend_may_be_missed(contact, seed, press, fibre):
    """A profile bends between the nodes of the quadrature, or a fibre turns there within a thousandth of its span."""
    pad = Morphology.random((2, 2), 4, seed=seed, pitch_mm=4.0)
    at = np.random.default_rng(seed).uniform(0, 3, (3, 2))[press]
    expected = dense_oracle(pad, at, contact, fibre)
    assert signals(pad, [at], contact)[0, fibre] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("function", [signals, signals_quantized])
@pytest.mark.parametrize("contact", [PROFILES["broad"], Contact(), PUBLISHED_CONTACT], ids=lambda c: c.model)
def test_signals_agree_in_every_form(contact, function):
    """One press by one, of several pads, of presses at once, and of more than a thread takes."""
    pads = [Morphology.random(2, 3, seed=seed) for seed in (1, 2)]
    presses = np.random.default_rng(0).uniform(0, 3, (4000, 2))
    found = function(np.array([pad.knots for pad in pads]), presses, contact)
    for part in (slice(7, 8), slice(1995, 2005)):
        np.testing.assert_array_equal(function(pads[1], presses[part], contact), found[1, part])
    together = function(pads[0], presses.reshape(2000, 2, 2), contact)
    np.testing.assert_allclose(together, found[0, ::2] + found[0, 1::2], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_signals_of_a_search_are_within_their_precision(contact):
    pad = Morphology.random((3, 2), 5, seed=2, pitch_mm=(8.0, 12.0))
    presses = np.random.default_rng(2).uniform(0, pad.layout.extent, (60, 2))
    fine = signals(pad, presses, contact, precision=1e-6)
    error = curves(pad).signals(presses, contact)[0].T - fine
    if contact.model == "layer":
        assert np.sqrt((error**2).mean()) < LAYER_PRECISION * np.abs(fine).max()
    else:
        assert np.abs(error).max() < FINE_PRECISION * np.abs(fine).max()


def dense_oracle(pad, press, contact, fibre):
    """One signal: Gauss's rule on 1000 pieces of every span of the PCHIP curve, in mm, shortest at its knots.

    Between them the curve may turn within a thousandth of the span. Weights are interpolated anew between the family's.
    """
    axis = pad.layout.family(fibre)
    distance, *weights = profile_weights(contact)[axis if contact.model == "layer" else 0]
    spline = partial(CubicSpline, bc_type=((2, 0), (1, 0)))  # pyright: ignore[reportArgumentType]
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


def panel_polynomials(squares, values):
    """The function of a squared distance that is a polynomial between every eighth of them."""
    parts = [slice(i, i + DEGREE + 1) for i in range(0, len(squares) - 1, DEGREE)]
    panels = [Polynomial.fit(squares[part], values[part], DEGREE) for part in parts]

    def evaluate(square):
        panel = np.searchsorted(squares[:-1:DEGREE], square, side="right") - 1
        return np.piecewise(square, [panel == index for index in range(len(panels))], panels)

    return evaluate
