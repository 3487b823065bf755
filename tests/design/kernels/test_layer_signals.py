"""Signals of a pressed layer: exact ones against adaptive quadrature, those of a search beside them, and lengths."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.interpolate import BarycentricInterpolator, PchipInterpolator

from padforge.design import Contact, Morphology, signals, signals_quantized, signals_sparse
from padforge.design.contact import fibre_axes, half_width_mm, profile_weights
from padforge.design.kernels.geometry import DEGREE
from padforge.design.kernels.measured_signals import LAYER_PRECISION
from padforge.design.settings import BUILT_CONTACT
from padforge.design.torch_signals import pchip_slopes, press_signals

CONTACTS = {
    "default": Contact(),
    "built pad": BUILT_CONTACT,
    "squeezed": Contact(stretch=0.0),
    "stretched": Contact(squeeze=0.0),
    "flat, shallow": Contact(tool="flat", tool_radius_mm=4.0, depth_mm=1.0, fibre_depths_mm=(3.0, 1.0)),
    "wider": Contact(tool="finger", thickness_mm=10.0, scale=1.3),
}


def layer_oracle(pad, press, contact, fibre):
    """One signal: adaptive quadrature on the PCHIP curve, in mm, by the polynomials through the family's weights."""
    axis = pad.layout.family(fibre)
    distance, *weights = profile_weights(contact)[axis]
    plain, directed = (panel_polynomials(distance**2, values) for values in weights)
    knots, centre = pad.unit_mm * pad.knots[fibre], pad.unit_mm * np.asarray(press)
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    slope = curve.derivative()

    def density(t):
        way, tangent = np.array([t - centre[axis], curve(t) - centre[1 - axis]]), np.array([1, slope(t)])
        square = way @ way
        if square >= distance[-1] ** 2:
            return 0.0
        return (plain(square) + directed(square) * (way @ tangent) ** 2 / (square * (tangent @ tangent))) * np.hypot(
            *tangent
        )

    parts = (np.linspace(*span, 5) for span in pairwise(knots[:, axis]))  # else `quad` takes steps too long
    spans = (part for ends in parts for part in pairwise(ends))
    return sum(quad(density, *span, epsabs=1e-10, epsrel=1e-11, limit=400)[0] for span in spans) / pad.unit_mm


def panel_polynomials(squares, values):
    """The function of a squared distance that is a polynomial between every eighth of them."""
    ends, degree = squares[::DEGREE], DEGREE + 1
    panels = [
        BarycentricInterpolator(squares[i : i + degree], values[i : i + degree])
        for i in range(0, len(squares) - 1, DEGREE)
    ]
    return lambda square: panels[np.searchsorted(ends[1:], square, side="right")](square)


def search_signals(pad, presses, contact, along=None, across=None):
    """Signals (F, Q) of the kind that a search takes; of other knots if given."""
    axes = fibre_axes(pad)
    along, across = (torch.tensor(x[0]) if y is None else y for x, y in zip(axes[:2], (along, across), strict=True))
    return press_signals(along, across, pchip_slopes(along, across), presses, contact, axes[2], pad.unit_mm)


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_layer_signals_equal_adaptive_quadrature(contact):
    pad, rng = Morphology.random((1, 1), 3, seed=1), np.random.default_rng(1)
    presses = rng.uniform(0.3, 1.7, (2, 2))
    found = signals(pad, presses, contact)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rounding, which the tolerances are near
        expected = [[layer_oracle(pad, press, contact, fibre) for fibre in range(2)] for press in presses]
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-9)  # each piece is to 5e-10, and full scale about 1


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_layer_signals_agree_in_every_form(contact):
    pad = Morphology.random((3, 2), 5, seed=2, pitch_mm=(8.0, 12.0))
    presses = np.random.default_rng(2).uniform(0, pad.layout.extent, (60, 2))
    exact = signals(pad, presses, contact)
    largest = np.abs(exact).max()
    np.testing.assert_array_equal(signals_sparse(pad, presses, contact).toarray(), exact)
    sampled = signals_quantized(pad, presses[:10], contact, samples=50_001)
    np.testing.assert_allclose(sampled, exact[:10], rtol=0, atol=2e-3 * largest)
    error = search_signals(pad, presses, contact).numpy().T - exact
    assert np.sqrt((error**2).mean()) < LAYER_PRECISION * largest


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_layer_gradient_equals_differences_of_search_signals(contact):
    """Steps so short that no span passes from near elements to far ones, and none is cut into other pieces."""
    pad, rng = Morphology.random((2, 1), 3, seed=3), np.random.default_rng(3)
    presses = rng.uniform(0, pad.layout.extent, (12, 2))
    along, across = (torch.tensor(axis[0], requires_grad=True) for axis in fibre_axes(pad)[:2])
    upstream = torch.tensor(rng.normal(size=(3, 12)))
    moves = [torch.tensor(rng.normal(size=along.shape)) for _ in range(2)]
    for move in moves:
        move[:, [0, -1]] = 0

    def value(step):
        moved = (axis + step * move for axis, move in zip((along, across), moves, strict=True))
        return (upstream * search_signals(pad, presses, contact, *moved)).sum()

    gradients = torch.autograd.grad(value(0.0), (along, across))
    with torch.no_grad():
        difference = ((value(1e-6) - value(-1e-6)) / 2e-6).item()
    expected = sum((gradient * move).sum().item() for gradient, move in zip(gradients, moves, strict=True))
    assert difference == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_layer_gradient_passes_gradcheck():
    pad = Morphology.random((1, 1), 2, seed=4)
    presses = np.random.default_rng(4).uniform(0, 2, (3, 2))
    along, across = (torch.tensor(axis[0], requires_grad=True) for axis in fibre_axes(pad)[:2])

    def compute(along, across):
        return search_signals(pad, presses, Contact(), along, across)

    assert torch.autograd.gradcheck(compute, (along, across), eps=1e-6, atol=1e-5, rtol=1e-3)


def test_families_at_other_depths_respond_differently():
    """On a pad that is its own transpose, pressed along its diagonal; `test_rectangles` has any other."""
    pad, presses = Morphology.straight(1), np.outer(np.linspace(0.2, 1.8, 9), [1, 1])
    shallow, deep = signals(pad, presses, Contact(fibre_depths_mm=(0.5, 4.0))).T
    assert np.abs(shallow - deep).max() > 0.05 * deep.max()
    exchanged = signals(pad, presses, Contact(fibre_depths_mm=(4.0, 0.5)))
    np.testing.assert_allclose(exchanged, np.column_stack([deep, shallow]), rtol=0, atol=1e-9)
    alike = signals(pad, presses, Contact(fibre_depths_mm=(4.0, 4.0)))
    np.testing.assert_allclose(alike, np.column_stack([deep, deep]), rtol=0, atol=1e-9)


def half_width_and_elongation_mm(pitch_mm, contact):
    """Distance at which a straight fibre far from every border signals half of what it does right below the press.

    And what it signals there.
    """
    pad = Morphology.straight((60, 1) if pitch_mm < 10 else (20, 1), pitch_mm)
    x, y = (extent / 2 for extent in pad.layout.extent)
    away = np.linspace(0, 12, 121)
    presses = np.column_stack([x + away / pitch_mm, np.full_like(away, y)])
    response = signals(pad, presses, contact)[:, -1]
    return float(np.interp(0.5, response[::-1] / response[0], away[::-1])), response[0] * pitch_mm


@pytest.mark.parametrize("model", ["layer", "profile"])
def test_a_press_is_as_wide_in_mm_at_every_pitch(model):
    pitches = (5.0, 11.25, 20.0)
    widths, elongations = np.transpose([half_width_and_elongation_mm(pitch, Contact(model=model)) for pitch in pitches])
    assert widths == pytest.approx([widths[1]] * 3, rel=1e-3)
    assert elongations == pytest.approx([elongations[1]] * 3, rel=1e-3)


def test_half_the_tool_at_half_the_size_is_half_as_wide():
    whole = Contact(tool_radius_mm=16.0, depth_mm=8.0, thickness_mm=12.0, fibre_depths_mm=(4.0, 3.0))
    half = Contact(tool_radius_mm=8.0, depth_mm=4.0, thickness_mm=6.0, fibre_depths_mm=(2.0, 1.5))
    assert half_width_mm(half) == pytest.approx(half_width_mm(whole) / 2, rel=5e-3)
    (wide, long), (narrow, short) = half_width_and_elongation_mm(20.0, whole), half_width_and_elongation_mm(10.0, half)
    assert narrow == pytest.approx(wide / 2, rel=5e-3)
    assert short == pytest.approx(long / 2, rel=5e-3)
