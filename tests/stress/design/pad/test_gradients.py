"""Gradients and lengthenings on degenerate geometry, and the roots that they stand on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design import (
    Contact,
    Indenter,
    indented_signals,
)
from design.pad.contact import fibre_axes, press_shape
from design.pad.kernels.exact_gradient import signals_gradient
from design.pad.kernels.pchip import population_slopes
from design.pad.kernels.press import family_strays
from design.pad.kernels.roots import SCRATCH, roots_in_unit
from design.pad.knots import kernel_ends
from design.settings import DEFAULT_PITCH_MM, Layout
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.design.mirrors import transposed
from tests.stress.values import LAX, Array, contacts, pads, presses, seeds


@settings(few(30), suppress_health_check=LAX)
@given(st.data())
def test_gradients_are_finite_and_right_away_from_kinks(data):
    pad = data.draw(pads((1, 2), (1, 5)))
    contact = data.draw(contacts())
    travel, cross = (axis[0].copy() for axis in fibre_axes(pad)[:2])
    ends = fibre_axes(pad)[2]
    slope = population_slopes(travel[None], cross[None])[0]
    places = np.random.default_rng(data.draw(seeds())).uniform(0, pad.grid + 1, (3, 2))
    shape = press_shape(contact, pad.unit_mm)
    upstream = np.ones((len(places), 2 * pad.grid))
    with ends_in_time():
        found = signals_gradient(
            travel, cross, slope, family_strays(cross[None], ends)[0], ends, places, upstream, *shape
        )
    if np.diff(travel).min() > 1e-6:
        assert np.isfinite(found).all()
    if (
        contact.sides is None
        and contact.weight == "uniform"
        and 0.1 <= contact.radius <= 1
        and np.diff(travel).min() > 0.1
    ):
        # whatever the kinks, the mean change over a small step is within the steepest that the rule for grazing allows
        assert np.abs(found).max() < 1e3 * len(places)


@settings(few(20), suppress_health_check=LAX)
@given(seeds(), st.sampled_from(["uniform", "inverse_square"]), st.sampled_from(["manhattan", "euclidean"]))
def test_gradients_are_finite_differences(seed, weight, length):
    rng = np.random.default_rng(seed)
    level = np.array([[1.0], [1.0]])
    travel = np.broadcast_to(np.linspace(0, 2, 5), (2, 5)).copy()
    cross = np.concatenate([level, level + np.cumsum(rng.uniform(0.05, 0.15, (2, 3)), axis=1), level + 0.5], axis=1)
    contact = Contact(radius=0.6, sides=None, weight=weight, length=length)
    slope, place = population_slopes(travel[None], cross[None])[0], np.array([[1.0, 1.1]])
    shape, strays = press_shape(contact, DEFAULT_PITCH_MM), np.array([2.0, 2.0])
    ends = kernel_ends(Layout.of(1))

    def total(v: Array) -> float:
        from design.pad.kernels.exact_signals import exact_signals

        out, none = np.zeros(2), np.empty(0, np.int64)
        exact_signals(travel[None], v[None], slope[None], strays[None], ends, place, *shape, 0, 1, none, none, out)
        return float(out.sum())

    found = signals_gradient(travel, cross, slope, strays, ends, place, np.ones((1, 2)), *shape)[1]
    step = 1e-6
    for fibre in range(2):
        for knot in range(1, 4):
            ahead, behind = cross.copy(), cross.copy()
            ahead[fibre, knot] += step
            behind[fibre, knot] -= step
            change = (total(ahead) - total(behind)) / (2 * step)
            assert found[fibre, knot] == pytest.approx(change, abs=1e-4)


@settings(few(25), suppress_health_check=LAX)
@given(st.data())
def test_lengthenings_are_finite_and_follow_the_mirror(data):
    pad = data.draw(pads((1, 2), (0, 5)))
    shape = data.draw(st.sampled_from(["sphere", "cone", "flat"]))
    indenter = Indenter(
        shape, data.draw(st.sampled_from([1e-6, 0.7, 1e4])), data.draw(st.sampled_from([0.01, 30.0, 89.9]))
    )
    places = np.asarray(data.draw(presses(pad, 3)), dtype=float).reshape(-1, 2)
    depth = data.draw(st.sampled_from([0.0, 1e-300, 1e-9, 1e-6, 0.3, 1e3])) * (
        indenter.radius if shape == "sphere" else 1
    )
    if shape == "sphere":
        depth = min(depth, indenter.radius)
    with ends_in_time():
        found = indented_signals(pad, places, depth, indenter)
        other = indented_signals(transposed(pad), places[:, ::-1], depth, indenter)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert depth > 0 or not found.any()
    order = np.r_[pad.grid : 2 * pad.grid, : pad.grid]
    np.testing.assert_allclose(other[:, order], found, rtol=1e-3, atol=1e-6 * max(depth, 1e-9))


@settings(few(100), suppress_health_check=LAX)
@given(seeds(), st.integers(1, 6), st.sampled_from([1e-300, 1e-12, 1.0, 1e12, 1e150]), st.booleans())
def test_roots_are_sign_changes_none_missed(seed, degree, scale, doubled):
    rng = np.random.default_rng(seed)
    true = rng.uniform(-0.5, 1.5, degree)
    if doubled:
        true[: degree // 2] = true[degree // 2 : 2 * (degree // 2)]
    p = np.zeros(7)
    p[: degree + 1] = np.polynomial.polynomial.polyfromroots(true) * scale
    out = np.empty(16)
    count = roots_in_unit(p, degree, 0.0, out, 0, np.empty(SCRATCH))
    assert (out[:count] >= 0).all()
    assert (out[:count] <= 1).all()
    if (
        not doubled
        and degree > 0
        and np.diff(np.sort(true)).min(initial=1) > 1e-3
        and np.abs(true * (1 - true)).min() > 1e-6
    ):
        expected = np.sort(true[(true > 0) & (true < 1)])
        np.testing.assert_allclose(out[:count], expected, atol=1e-6)
