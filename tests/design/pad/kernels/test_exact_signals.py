"""Exact signals against adaptive quadrature between independently found crossings, closed forms and hard geometry."""

import warnings
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from design import Contact, InputError, Morphology, signals, signals_quantized, signals_sparse
from design.pad.contact import signals_and_spans
from design.pad.knots import assemble
from design.settings import PUBLISHED_CONTACT
from tests.helpers.effort import few

WEIGHTS: tuple[Literal["uniform", "inverse_square", "inverse"], ...] = ("uniform", "inverse_square", "inverse")
LENGTHS: tuple[Literal["manhattan", "euclidean"], ...] = ("manhattan", "euclidean")


def root(function, low, high):
    found = brentq(function, low, high, xtol=1e-15)
    assert isinstance(found, float)
    return found


def oracle(pad, press, contact, fibre):
    """One signal: crossings by sign changes on a dense sample and bisection, then SciPy's adaptive quadrature."""
    axis = 0 if fibre < pad.grid else 1
    knots, radius = pad.knots[fibre], contact.radius
    curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
    slope = curve.derivative()
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

    def density(t):
        d = np.linalg.norm(away(t))
        weight = {"uniform": 1, "inverse_square": 1 / (radius + d**2), "inverse": 1 / max(d, radius / 100)}
        run = 1 + abs(slope(t)) if contact.length == "manhattan" else np.hypot(1, slope(t))
        return weight[contact.weight] * run

    total = 0.0
    for begin, end in pairwise(knots[:, axis]):
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
                total += sum(quad(density, *piece, epsabs=1e-13, epsrel=1e-12, limit=200)[0] for piece in pieces)
    return total


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("sides", [None, 3, 30, *(pytest.param(sides, marks=pytest.mark.slow) for sides in (4, 7, 64))])
def test_exact_signals_equal_the_oracle(weight, length, sides):
    contact = Contact(radius=0.7, sides=sides, weight=weight, length=length)
    plain = weight == "uniform" and length == "manhattan"
    for knots in (0, 5, 20):
        rng = np.random.default_rng([knots, sides or 0])
        pad = Morphology.random(2, knots, rng)
        presses = rng.uniform(0, 3, (2, 2))
        found = signals(pad, presses, contact)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = [[oracle(pad, press, contact, fibre) for fibre in range(4)] for press in presses]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=4e-12 if plain else 1e-10)


def test_exact_signals_of_published_pads_are_the_limit_of_the_sampled_ones(published):
    presses = np.random.default_rng(0).uniform(0.5, 4.5, (10, 2))
    for name in ("1para", "5para_dis", "20para"):
        pad = Morphology.load(published / f"{name}.mat")
        true = signals(pad, presses, PUBLISHED_CONTACT)
        errors = [np.abs(signals_quantized(pad, presses, samples=n) - true).max() for n in (2_000, 200_000)]
        assert errors[1] < errors[0] / 20


contacts = st.builds(
    Contact,
    radius=st.floats(0.05, 3),
    sides=st.one_of(st.none(), st.integers(3, 64)),
    weight=st.sampled_from(WEIGHTS),
    length=st.sampled_from(LENGTHS),
)


@given(contacts, st.integers(1, 2), st.integers(0, 10), st.integers(0, 2**32 - 1))
@few(20)
def test_finer_sampling_comes_closer(contact, grid, knots, seed):
    rng = np.random.default_rng(seed)
    pad = Morphology.random(grid, knots, rng)
    presses = rng.uniform(-1, grid + 2, (4, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = signals(pad, presses, contact)
    sampled = signals_quantized(pad, presses, contact, samples=200_001)
    # secants; a PCHIP curve is up to three times as steep, and a sample more or less there counts as much
    slopes = np.abs(np.diff(pad.knots, axis=1)).max() / np.diff(pad.knots, axis=1).max(axis=2).min()
    heaviest = {"uniform": 1, "inverse_square": 1 / contact.radius, "inverse": 100 / contact.radius}[contact.weight]
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    np.testing.assert_allclose(found, sampled, atol=(1e-3 + 3e-4 * slopes) * heaviest, rtol=1e-2)


@pytest.mark.parametrize("radius", [1e-9, 1e-6, 1e-3, 0.4])
@pytest.mark.parametrize("sides", [None, 4, 30])
def test_a_press_centred_on_a_straight_fibre_signals_its_diameter_at_every_size(radius, sides):
    """A 30-gon has vertices left and right, but edges at top and bottom."""
    found = signals(Morphology.straight(3), [[2, 2]], Contact(radius=radius, sides=sides))
    upright = np.cos(np.pi / 30) if sides == 30 else 1
    np.testing.assert_allclose(found[0, [1, 4]], [2 * radius, 2 * radius * upright], rtol=1e-12)
    assert not found[0, [0, 2, 3, 5]].any()


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("length", LENGTHS)
def test_a_press_larger_than_the_pad_takes_whole_fibres(weight, length):
    pad = Morphology.random(3, 4, seed=5)
    found = signals(pad, [[2, 2]], Contact(radius=1e3, weight=weight, length=length))
    wide = signals(pad, [[2, 2]], Contact(radius=1e3, sides=None, weight=weight, length=length))
    assert (found > 0).all()
    np.testing.assert_allclose(found, wide, rtol=1e-9)
    if (weight, length) == ("uniform", "manhattan"):
        expected = [4 + np.abs(np.diff(knots[:, 1 - f // 3])).sum() for f, knots in enumerate(pad.knots)]
        np.testing.assert_allclose(found[0], expected, rtol=1e-12)


def test_inverse_weights_on_a_straight_fibre_have_closed_forms():
    """Centre on the fibre, circle of radius K: 2 + 2 ln 100 for 1/d cut off at K/100, arctan for 1/(K + d^2)."""
    pad, radius = Morphology.straight(1), 0.5
    near = signals(pad, [[1, 1]], Contact(radius=radius, sides=None, weight="inverse"))
    np.testing.assert_allclose(near, 2 + 2 * np.log(100), rtol=1e-12)
    square = signals(pad, [[1, 1]], Contact(radius=radius, sides=None, weight="inverse_square"))
    np.testing.assert_allclose(square, 2 / np.sqrt(radius) * np.arctan(radius / np.sqrt(radius)), rtol=1e-12)


def test_a_fibre_along_an_edge_counts_whole_as_the_boundary_belongs_to_the_press():
    """A triangle has an upright edge at x = -K/2; put it on the vertical fibre."""
    contact = Contact(radius=0.5, sides=3)
    found = signals(Morphology.straight(1), [[1.25, 1]], contact)
    assert found[0, 1] == pytest.approx(np.sqrt(3) * 0.5)
    for nudge in (1e-9, -1e-9):
        beside = signals(Morphology.straight(1), [[1.25 + nudge, 1]], contact)[0, 1]
        assert beside == pytest.approx(np.sqrt(3) * 0.5 if nudge < 0 else 0)


def test_a_vertex_that_touches_a_fibre_adds_nothing():
    found = signals(Morphology.straight(1), [[1, 0.5]], Contact(radius=0.5, sides=4))
    assert found[0, 0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("gap", [1e-12, 1e-9, 1e-6])
def test_knots_that_nearly_coincide_make_a_step_and_nothing_else(gap):
    """A rise of 1 within `gap`, slope up to 1e12: the Manhattan signal is run plus rise."""
    inner = np.array([[[1.0, 0.5], [1.0 + gap, 1.5]], [[1.0, 0.5], [1.0, 1.5]]])
    pad = Morphology(assemble(inner))
    for press in ([1.0, 1.0], [1.0 + gap, 1.5], [1.0, 0.5]):
        for length in LENGTHS:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found = signals(pad, [press], Contact(radius=5, sides=None, length=length))
            assert np.isfinite(found).all()
        manhattan = signals(pad, [press], Contact(radius=5, sides=None))[0, 0]
        assert manhattan == pytest.approx(2 + 0.5 + 1 + 0.5, rel=1e-9)


def test_simultaneous_presses_add_up():
    pad = Morphology.random(3, 4, seed=1)
    places = np.random.default_rng(0).uniform(1, 3, (6, 2, 2))
    together = signals(pad, places)
    np.testing.assert_allclose(together, signals(pad, places[:, 0]) + signals(pad, places[:, 1]), rtol=1e-13)


def test_populations_sparse_and_dense_agree():
    pads = [Morphology.random(3, 3, seed) for seed in range(3)]
    presses = np.random.default_rng(1).uniform(0, 4, (30, 2))
    batch = signals(np.stack([pad.knots for pad in pads]), presses)
    for pad, expected in zip(pads, batch, strict=True):
        np.testing.assert_array_equal(signals(pad, presses), expected)
        np.testing.assert_array_equal(signals_sparse(pad, presses).toarray(), expected)


def test_many_presses_give_the_same_on_many_threads():
    pad = Morphology.random(4, 5, seed=2)
    presses = np.random.default_rng(2).uniform(0.5, 4.5, (10_000, 2))
    whole = signals(pad, presses)
    np.testing.assert_array_equal(whole[5000:5010], signals(pad, presses[5000:5010]))


def test_work_follows_what_is_touched():
    """Counters, not clocks: spans looked at per press do not grow with the pad, and shrink with the press."""
    rng = np.random.default_rng(0)
    counts = {}
    for grid in (4, 128):
        presses = rng.uniform(1, grid, (400, 2))
        counts[grid] = signals_and_spans(Morphology.straight(grid), presses, PUBLISHED_CONTACT)[1]
    assert counts[128] <= 1.2 * counts[4]
    pad, presses = Morphology.random(4, 20, seed=0), rng.uniform(1, 4, (100, 2))
    small, large = (signals_and_spans(pad, presses, Contact(radius=radius))[1] for radius in (0.1, 1.0))
    assert small < large < 100 * 8 * 21


def test_odd_but_fair_input_is_taken_as_it_is():
    pad = Morphology.random(2, 3, seed=0)
    presses = np.array([[1, 2], [2, 1]])
    expected = signals(pad, presses.astype(float))
    np.testing.assert_array_equal(signals(pad, presses), expected)
    np.testing.assert_array_equal(signals(pad, presses.astype(np.float32)), expected)
    np.testing.assert_array_equal(signals(pad, presses.tolist()), expected)
    np.testing.assert_array_equal(signals(pad, torch.tensor(presses).numpy()), expected)
    assert signals(pad, []).shape == (0, 4)
    assert signals_sparse(pad, []).shape == (0, 4)
    with pytest.raises(InputError, match="presses"):
        signals(pad, [[np.nan, 1]])


@pytest.mark.parametrize("radius", [1e-9, 0.25, 0.4, 1.0])
@pytest.mark.parametrize("weight", WEIGHTS)
def test_a_circle_that_only_touches_a_fibre_adds_nothing(radius, weight):
    """From both sides, and exactly at the radius, where the crossing is a double root."""
    for nudge in (0.0, 1e-15, -1e-15):
        found = signals(
            Morphology.straight(2), [[1.5, 1 + radius + nudge]], Contact(radius=radius, sides=None, weight=weight)
        )
        assert found[0, 0] <= 1e-6 / radius


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 8, 12, 30])
def test_a_fibre_on_an_edge_counts_whole_whichever_way_rounding_goes(sides):
    rng = np.random.default_rng(sides)
    normal = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    for radius in rng.uniform(0.1, 1, 50):
        apothem, edge = radius * np.cos(np.pi / sides), 2 * radius * np.sin(np.pi / sides)
        for nx, ny in zip(np.cos(normal), np.sin(normal), strict=True):
            if abs(nx) < 1e-9:
                found = signals(Morphology.straight(3), [[2.5, 2 - apothem * ny]], Contact(radius=radius, sides=sides))
                assert found[0, 1] == pytest.approx(edge, rel=1e-6)
            if abs(ny) < 1e-9:
                found = signals(Morphology.straight(3), [[2 - apothem * nx, 2.5]], Contact(radius=radius, sides=sides))
                assert found[0, 4] == pytest.approx(edge, rel=1e-6)


@pytest.mark.parametrize(
    "knots", [np.zeros((3, 2, 2)), np.zeros((2, 2)), np.full((4, 2, 2), np.nan), np.zeros((4, 3, 2)), "x"]
)
def test_knots_that_are_no_pad_are_refused(knots):
    with pytest.raises(InputError, match="knots"):
        signals(knots, [[1, 1]])


def test_no_contact_at_all_is_a_row_of_zeros():
    assert not signals(Morphology.straight(2), np.empty((5, 0, 2))).any()
    assert signals(Morphology.straight(2), np.empty((5, 0, 2))).shape == (5, 4)
