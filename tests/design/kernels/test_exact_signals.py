"""Exact signals against adaptive quadrature between independently found crossings, closed forms and hard geometry."""

import math
import warnings
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from padforge.design import Contact, Morphology, signals, signals_quantized, signals_sparse
from padforge.design.settings import PUBLISHED_CONTACT, Layout
from tests.design import wild_pads as wild


def root(function, low, high):
    return float(brentq(function, low, high, xtol=1e-15))  # pyright: ignore[reportArgumentType]


def oracle(pad, press, contact, fibre):
    """One signal: crossings by sign changes on a dense sample and bisection, then SciPy's adaptive quadrature."""
    axis = pad.layout.family(fibre)
    knots, radius = pad.knots[fibre], contact.radius
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    sides = contact.sides or 3
    normal = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    directions, apothem = np.column_stack([np.cos(normal), np.sin(normal)]), radius * np.cos(np.pi / sides)

    def away(t):
        v = curve(t)
        x, y = (t, v) if axis == 0 else (v, t)
        return np.stack([x - press[0], y - press[1]], axis=-1)

    def outside(t):
        if contact.sides:
            return (away(t) @ directions.T).max(axis=-1) - apothem
        return np.linalg.norm(away(t), axis=-1) - radius

    def density(t, begin, cubic, square, linear, constant):
        """Of a span by its coefficients, which SciPy has computed, in plain numbers: a call takes a tenth as long."""
        s = t - begin
        v, rise = constant + s * (linear + s * (square + s * cubic)), linear + s * (2 * square + 3 * s * cubic)
        d = math.hypot(t - press[axis], v - press[1 - axis])
        weight = {"uniform": 1, "inverse_square": 1 / (radius + d**2), "inverse": 1 / max(d, radius / 100)}
        run = 1 + abs(rise) if contact.length == "manhattan" else math.hypot(1, rise)
        return weight[contact.weight] * run

    total = 0.0
    for (begin, end), coefficients in zip(pairwise(knots[:, axis].tolist()), curve.c.T.tolist(), strict=True):
        low, high = max(begin, press[axis] - radius), min(end, press[axis] + radius)
        if high <= low:
            continue
        at = np.linspace(low, high, 1500)
        sign = np.sign(outside(at))
        turns = np.flatnonzero(sign[:-1] * sign[1:] < 0)
        for a, b in pairwise([low, *(root(outside, at[i], at[i + 1]) for i in turns), high]):
            if outside((a + b) / 2) > 0:
                continue
            if contact.weight == "uniform" and contact.length == "manhattan":
                total += b - a + abs(curve(b) - curve(a))
            else:
                pieces = pairwise(np.linspace(a, b, 9))
                exactly = {"args": (begin, *coefficients), "epsabs": 1e-13, "epsrel": 1e-12, "limit": 200}
                total += sum(quad(density, *piece, **exactly)[0] for piece in pieces)
    return total


@pytest.mark.parametrize("weight", wild.WEIGHTS)
@pytest.mark.parametrize("length", wild.LENGTHS)
@pytest.mark.parametrize("sides", [None, 3, 30])
def test_exact_signals_equal_the_oracle(weight, length, sides):
    contact = Contact(radius=0.7, sides=sides, weight=weight, length=length)
    plain = weight == "uniform" and length == "manhattan"
    ways = (0, Layout.create(1)), (5, Layout.create((2, 1), (5.0, 30.0))), (20, Layout.create((1, 2), (10.0, 10.0)))
    for knots, layout in ways:
        rng = np.random.default_rng([knots, sides or 0])
        pad = Morphology.random(layout, knots, rng)
        presses = rng.uniform(0.2, np.array(layout.extent) - 0.2, (1, 2))
        found = signals(pad, presses, contact)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = [[oracle(pad, press, contact, fibre) for fibre in range(layout.fibres)] for press in presses]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=4e-12 if plain else 1e-10)


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
def test_signals_do_not_depend_on_batching_or_sparsity(kind, grid, count, population, contact, seed):
    """Presses at once add up; order, other pads beside it, the layout in memory and sparseness change no bit."""
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
        np.testing.assert_array_equal(signals_sparse(pad, presses, contact).toarray(), alone)


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


def test_signals_of_many_presses_are_those_of_each():
    """More than a thread takes at once."""
    pad, presses = Morphology.random(4, 5, seed=2), np.random.default_rng(2).uniform(0.5, 4.5, (4000, 2))
    whole = signals(pad, presses, PUBLISHED_CONTACT)
    for part in (slice(10), slice(1995, 2005)):
        np.testing.assert_array_equal(whole[part], signals(pad, presses[part], PUBLISHED_CONTACT))


def test_signals_of_no_presses_and_of_ones_far_away():
    pad = Morphology.random(2, 3, seed=0)
    for function in (signals, signals_quantized, signals_sparse):
        assert function(pad, []).shape == (0, 4)
        assert not function(pad, [[50, 50], [-9, 1]], PUBLISHED_CONTACT).sum()
    for function in (signals, signals_quantized):
        none = function(pad, np.empty((5, 0, 2)))
        assert (none.shape, none.any()) == ((5, 4), False)


@pytest.mark.parametrize("radius", [1e-9, 0.4])
def test_signals_of_centred_and_tangent_circles(radius):
    """The diameter, and nothing exactly at the radius, where the crossing is a double root."""
    for weight in wild.WEIGHTS:
        contact = Contact(radius=radius, sides=None, weight=weight)
        presses = [[1.5, 1 + radius + nudge] for nudge in (0.0, 1e-15, -1e-15)]
        assert (signals(Morphology.straight(2), presses, contact)[:, 0] <= 1e-6 / radius).all()
    found = signals(Morphology.straight(3), [[2, 2]], Contact(radius=radius, sides=None))
    np.testing.assert_allclose(found[0], 2 * radius * np.array([0, 1, 0, 0, 1, 0]), rtol=1e-12)
