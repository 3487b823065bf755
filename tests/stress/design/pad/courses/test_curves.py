"""Curves through any knots, their crossings, bends and folds."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from design import (
    Morphology,
    crossings,
    flatten,
)
from design.criteria.rules import check_rules
from design.pad.courses.bending import bend_radius, fold_gap, traced_curve
from design.pad.courses.curves import beziers, crossing_angles, lengths, slope_beziers, slopes
from design.pad.knots import assemble
from design.settings import PUBLISHED_CONTACT, RulesSettings
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.design.mirrors import transposed, whole_lengths
from tests.stress.design.pad.test_signals import KINDS
from tests.stress.values import LAX, pads, seeds, wild_knots


@settings(few(30), suppress_health_check=LAX)
@given(st.data())
def test_curves_keep_to_their_knots(data):
    pad = data.draw(pads((1, 3), (0, 12)))
    d, spans, bends = slopes(pad), beziers(pad), slope_beziers(pad)
    assert np.isfinite(d).all()
    assert np.isfinite(spans).all()
    assert np.isfinite(bends).all()
    for fibre, knots in enumerate(pad.knots):
        axis = 0 if fibre < pad.grid else 1
        rise = np.diff(knots[:, 1 - axis]) / np.diff(knots[:, axis])
        assert (d[fibre, :-1] * rise >= 0).all()  # monotone between knots
        assert (np.abs(d[fibre, :-1]) <= 3 * np.abs(rise) * (1 + 1e-9) + 1e-300).all()
        if np.diff(knots[:, axis]).min() > 1e-4:
            t = np.linspace(0, pad.grid + 1, 301)
            expected = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])(t)
            line = flatten(pad, 1e-7)[fibre]
            np.testing.assert_allclose(
                np.interp(t, line[:, axis], line[:, 1 - axis]), expected, atol=1e-4 + 1e-6 * np.abs(rise).max()
            )
    long = lengths(pad)
    assert (long >= (pad.grid + 1) * (1 - 1e-9)).all()
    assert (long <= whole_lengths(pad, PUBLISHED_CONTACT) * (1 + 1e-4)).all()


@settings(few(20), suppress_health_check=LAX)
@given(st.data())
def test_every_horizontal_crosses_every_vertical_somewhere(data):
    pad = data.draw(pads((1, 3), (0, 8)))
    with ends_in_time():
        found = crossings(pad)
        angles = crossing_angles(pad, [c for c in found if c.first < pad.grid <= c.second])
    assert {(c.first, c.second) for c in found} >= {
        (h, v) for h in range(pad.grid) for v in range(pad.grid, 2 * pad.grid)
    }
    places = np.array([c.place for c in found])
    assert ((places >= -1e-9) & (places <= pad.grid + 1 + 1e-9)).all()
    assert ((angles >= 0) & (angles <= 90)).all()


@settings(few(20), suppress_health_check=LAX)
@given(st.data())
def test_bends_and_folds_of_any_curve(data):
    pad = data.draw(pads((1, 2), (0, 8)))
    limit, gap = data.draw(st.sampled_from([1e-9, 0.05, 1.0, 100.0])), data.draw(st.sampled_from([1e-6, 0.1, 3.0]))
    with ends_in_time():
        for fibre in range(2 * pad.grid):
            points, headings = traced_curve(beziers(pad)[fibre], slope_beziers(pad)[fibre], 0.01)
            assert np.isfinite(points).all()
            assert (np.abs(headings) <= math.pi / 2).all()
            radius, place = bend_radius(points, headings, limit)
            assert radius > 0
            assert np.isfinite(place).all()
            fold = fold_gap(flatten(pad, 1e-3)[fibre], gap)
            assert fold is None or 0 <= fold[0] < gap
    found = check_rules(pad, RulesSettings())
    order = [2 * f - (pad.grid if f > pad.grid else -pad.grid) - f for v in found for f in v.fibres]
    other = check_rules(transposed(pad), RulesSettings())
    assert len(order) == sum(len(v.fibres) for v in other)
    assert sorted(v.rule for v in found) == sorted(v.rule for v in other)


@settings(few(40), suppress_health_check=LAX)
@given(seeds(), st.sampled_from(KINDS), st.integers(1, 4), st.integers(0, 20))
def test_assembled_knots_are_a_pad(seed, kind, grid, count):
    knots = wild_knots(kind, grid, count, np.random.default_rng(seed))
    pad = Morphology(knots)
    again = Morphology(assemble(pad.knots[:, 1:-1]))
    np.testing.assert_allclose(again.knots, pad.knots, atol=1e-12)
