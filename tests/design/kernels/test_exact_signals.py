"""Exact signals against adaptive quadrature between independently found crossings, closed forms and hard geometry."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from padforge.design import Contact, Morphology, signals, signals_quantized
from padforge.design.settings import PUBLISHED_CONTACT, Layout
from tests.design import wild_pads as wild


def oracle(pad, press, contact, fibre, count=300_000):
    """One signal: the sum over the middles of many short pieces of SciPy's curve."""
    axis, knots = pad.layout.family(fibre), pad.knots[fibre]
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    low, high = np.clip([press[axis] - contact.radius, press[axis] + contact.radius], *knots[[0, -1], axis])
    t = low + (high - low) * (np.arange(count) + 0.5) / count
    away = np.stack([t, curve(t)][:: 1 - 2 * axis], axis=-1) - press
    rise, distance = curve.derivative()(t), np.linalg.norm(away, axis=-1)
    inside = distance <= contact.radius
    if contact.sides:
        normal = (np.arange(contact.sides) + 0.5) * 2 * np.pi / contact.sides
        across = away @ np.stack([np.cos(normal), np.sin(normal)])
        inside = across.max(axis=-1) <= contact.radius * np.cos(np.pi / contact.sides)
    weight = {
        "uniform": np.ones(count),
        "inverse_square": 1 / (contact.radius + distance**2),
        "inverse": 1 / np.maximum(distance, contact.radius / 100),
    }[contact.weight]
    run = 1 + np.abs(rise) if contact.length == "manhattan" else np.hypot(1, rise)
    return (weight * run)[inside].sum() * (high - low) / count


@pytest.mark.parametrize("weight", wild.WEIGHTS)
@pytest.mark.parametrize("length", wild.LENGTHS)
@pytest.mark.parametrize("sides", [None, 3, 30])
def test_exact_signals_equal_the_oracle(weight, length, sides):
    contact = Contact(radius=0.7, sides=sides, weight=weight, length=length)
    ways = (0, Layout.create(1)), (5, Layout.create((2, 1), (5.0, 30.0))), (9, Layout.create((1, 2), (10.0, 10.0)))
    for knots, layout in ways:
        rng = np.random.default_rng([knots, sides or 0])
        pad = Morphology.random(layout, knots, rng)
        presses = rng.uniform(0.2, np.array(layout.extent) - 0.2, (1, 2))
        expected = [[oracle(pad, press, contact, fibre) for fibre in range(layout.fibres)] for press in presses]
        np.testing.assert_allclose(signals(pad, presses, contact), expected, rtol=2e-4, atol=2e-4)
        sampled = signals_quantized(pad, presses, contact, 50_001)
        np.testing.assert_allclose(sampled, expected, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_weighted_signals_of_a_straight_fibre_have_closed_forms(offset):
    radius, half = 0.7, np.sqrt(0.7**2 - offset**2)
    root = np.sqrt(radius + offset**2)
    near = np.sqrt(max((radius / 100) ** 2 - offset**2, 0))  # where the weight is that of a hundredth of the radius
    inverse = np.arcsinh(half / offset) if offset else np.log(half / near) + 1
    for weight, integral in zip(wild.WEIGHTS, (half, np.arctan(half / root) / root, inverse), strict=True):
        contact = Contact(radius=radius, sides=None, weight=weight, length="euclidean")
        found = signals(Morphology.straight(2), [[1.5, 1 + offset]], contact)[0, 0]
        assert found == pytest.approx(2 * integral, rel=1e-10)


@given(wild.wild_pads((1, 4), (0, 10)), wild.wild_contacts, wild.SEEDS)
@settings(max_examples=30)
def test_signals_on_wild_pads_are_within_0_and_the_fibre_length(pad, contact, seed):
    found = signals(pad, wild.wild_presses(pad, seed), contact)
    weights = {"uniform": 1.0, "inverse_square": 1 / contact.radius, "inverse": 100 / contact.radius}
    assert (found >= 0).all()
    most = wild.longest_signals(pad, contact.length)
    assert (found <= most * weights[contact.weight] * (1 + 1e-9)).all()
    whole = signals(pad, [[1, 1]], contact.model_copy(update={"radius": 1e3}))[0]
    assert (whole > 0).all()
    if (contact.weight, contact.length) == ("uniform", "manhattan"):
        np.testing.assert_allclose(whole, most, rtol=1e-7)


@given(
    st.sampled_from(wild.KINDS), st.integers(1, 3), st.integers(0, 6), st.integers(0, 2), wild.wild_contacts, wild.SEEDS
)
@settings(max_examples=25)
def test_signals_do_not_depend_on_batching(kind, grid, count, population, contact, seed):
    """Presses at once add up; order, other pads beside it, and the layout in memory change no bit."""
    rng = np.random.default_rng(seed)
    pads = [Morphology(wild.wild_knots(kind, grid, count, rng)) for _ in range(population)]
    knots = np.array([pad.knots for pad in pads]).reshape(-1, 2 * grid, count + 2, 2)
    presses = rng.uniform(0, grid + 1, (6, 2))
    found = signals(knots, presses, contact)
    assert found.shape == (population, 6, 2 * grid)
    np.testing.assert_array_equal(signals(np.asfortranarray(knots), presses, contact), found)
    np.testing.assert_array_equal(signals(knots[:, ::-1][:, ::-1], presses[::-1], contact), found[:, ::-1])
    together = signals(knots, presses.reshape(3, 2, 2), contact)
    np.testing.assert_allclose(together, found[:, ::2] + found[:, 1::2], rtol=1e-12)
    for pad, alone in zip(pads, found, strict=True):
        np.testing.assert_array_equal(signals(pad, presses, contact), alone)


@pytest.mark.parametrize(
    ("sides", "press", "fibre", "expected"),
    [
        (4, (1.6, 1.0), 0, 1.2),  # along a diagonal
        (4, (1.0, 1.6), 0, 0.0),  # a corner touches
        (4, (1.0, 1.6 + 1e-9), 0, 0.0),
        (None, (1.0, 1.6 + 1e-9), 0, 0.0),
        (3, (1.3, 1.0), 2, 0.6 * np.sqrt(3)),  # the upright edge of a triangle
        (3, (1.3 - 1e-9, 1.0), 2, 0.6 * np.sqrt(3)),
        (3, (1.3 + 1e-9, 1.0), 2, 0.0),
    ],
)
def test_signals_at_corners_and_along_edges(sides, press, fibre, expected):
    found = signals(Morphology.straight(2), [press], Contact(radius=0.6, sides=sides))[0, fibre]
    assert found == pytest.approx(expected, abs=1e-6)


def test_signals_of_no_presses_and_of_ones_far_away():
    pad = Morphology.random(2, 3, seed=0)
    for function in (signals, signals_quantized):
        assert function(pad, []).shape == (0, 4)
        assert not function(pad, [[50, 50], [-9, 1]], PUBLISHED_CONTACT).sum()
        none = function(pad, np.empty((5, 0, 2)))
        assert (none.shape, none.any()) == ((5, 4), False)
