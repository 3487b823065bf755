"""Splines through what is drawn, against the curves that it was drawn from."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from fabricate.mould.cad.outlines.splines import MOST_SPANS, breaks, lengths, spline, stretch
from tests.helpers.effort import few

Array = np.ndarray


def wave(t: Array, waves: float = 2.0, high: float = 1.0) -> Array:
    return np.stack([t, high * np.sin(waves * t)], axis=-1)


def wave_along(t: float, waves: float = 2.0, high: float = 1.0) -> Array:
    along = np.array([1.0, high * waves * np.cos(waves * t)])
    return along / np.linalg.norm(along)


@st.composite
def splines(draw: st.DrawFn) -> BSpline:
    """Any cubic spline of one to eight spans, clamped at its ends."""
    steps = draw(st.lists(st.floats(0.1, 2.0), min_size=1, max_size=8))
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    padded = np.concatenate([[knots[0]] * 3, knots, [knots[-1]] * 3])
    return BSpline(padded, rng.normal(size=(len(knots) + 2, 2)), 3)


def test_lengths_along_a_polyline():
    assert lengths(np.array([[0, 0], [3, 4], [3, 5.5], [1, 5.5]])).tolist() == [0, 5, 6.5, 8.5]


@pytest.mark.parametrize("fit_mm", [2e-3, 1e-4])
@pytest.mark.parametrize("count", [1500, 6000])
def test_a_spline_is_near_what_is_drawn_with_few_spans(fit_mm, count):
    t = np.linspace(0, 6, count)
    points = wave(t)
    curve = spline(points, [wave_along(0), wave_along(6)], fit_mm)
    first, last = curve.t[0], curve.t[-1]
    assert (first, last) == pytest.approx((0, lengths(points)[-1]))
    found = curve(np.linspace(first, last, 5000))
    along = np.stack([np.ones(len(found)), 2 * np.cos(2 * found[:, 0])], axis=1)
    off = np.abs(found[:, 1] - np.sin(2 * found[:, 0])) / np.linalg.norm(along, axis=1)
    sagitta = (t[1] - t[0]) ** 2 * 4 / 8  # the polyline's own distance from the wave, at its crests
    assert off.max() <= fit_mm + sagitta + 1e-7
    assert len(np.unique(curve.t)) - 1 <= (36 if fit_mm > 1e-3 else 60)


@given(st.floats(0.5, 3.0), st.floats(0.1, 2.0), st.integers(3, 400), st.sampled_from([2e-3, 1e-4]))
@few(25)
def test_ends_and_their_directions_are_exact(waves, high, count, fit_mm):
    points = wave(np.linspace(0, 4, count), waves, high)
    tangents = [wave_along(0, waves, high), wave_along(4, waves, high)]
    curve = spline(points, tangents, fit_mm)
    first, last = curve.t[[0, -1]]
    assert curve([first, last]) == pytest.approx(points[[0, -1]], abs=1e-12)
    for s, along in zip((first, last), tangents, strict=True):
        derivative = curve(s, 1)
        assert derivative / np.linalg.norm(derivative) == pytest.approx(along, abs=1e-9)


def test_a_straight_polyline_takes_next_to_no_spans():
    points = np.linspace([0, 0], [3, 4], 50)
    curve = spline(points, [np.array([0.6, 0.8])] * 2, 1e-4)
    assert len(np.unique(curve.t)) <= 4
    assert curve(2.0) == pytest.approx([1.2, 1.6])


def test_a_spline_keeps_to_chords_between_far_vertices():
    """Between two vertices far apart a curve through both might bulge; the polyline says where the outline is."""
    points = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [4, 0.5], [5, 2], [5.2, 3]])
    curve = spline(points, [np.array([1.0, 0.0]), np.array([0.0, 1.0])], 1e-2)
    places = curve(np.linspace(0, lengths(points)[2], 500))
    assert np.abs(places[:, 1]).max() <= 1e-2


@pytest.mark.parametrize("far", [[19, 5], [10, 10, 10], [25]])
def test_a_spline_strays_nowhere_along_far_vertices(far):
    """A bend of 3 mm radius, drawn finely, and a run out of it that hardly bends, of few vertices."""
    angle = np.linspace(0, 0.3, 10)
    bend = 3 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    out, aside = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    run = bend[-1] + np.outer(np.cumsum(far), out) + np.outer([1e-3, 1.5e-3, 0][: len(far)], aside)
    points = np.vstack([bend, run])
    end = (points[-1] - points[-2]) / np.linalg.norm(points[-1] - points[-2])
    curve = spline(points, [np.array([1.0, 0.0]), end], 2e-3)
    places = shapely.points(curve(np.linspace(curve.t[0], curve.t[-1], 5000)))
    assert shapely.distance(places, shapely.LineString(points)).max() <= 2.2e-3


@given(splines())
@few(30)
def test_no_part_between_breaks_has_more_spans_than_allowed(curve):
    knots = np.unique(curve.t)
    cuts = [knots[0], *breaks(curve), knots[-1]]
    assert cuts == sorted(set(cuts))
    assert set(cuts) <= set(knots.tolist())
    spans = [int(((knots >= a) & (knots < b)).sum()) for a, b in pairwise(cuts)]
    assert max(spans) <= MOST_SPANS
    assert len(spans) == -(-(len(knots) - 1) // MOST_SPANS)


@given(splines(), st.floats(0, 1), st.floats(0, 1))
@few(60)
def test_a_stretch_is_the_curve_itself(curve, low, high):
    whole = curve.t[[0, -1]]
    start, end = sorted(whole[0] + np.array([low, high]) * (whole[1] - whole[0]))
    if end - start < 1e-6:
        end = whole[1]
        start = whole[0]
    part = stretch(curve, start, end)
    assert part.t[[0, -1]] == pytest.approx([start, end], abs=1e-9)
    assert (part.t[:4] == part.t[0]).all()
    assert (part.t[-4:] == part.t[-1]).all()
    assert len(part.c) == len(part.t) - 4
    places = np.linspace(part.t[0], part.t[-1], 200)
    for derivative in (0, 1):
        assert part(places, derivative) == pytest.approx(curve(places, derivative), abs=1e-7)
    assert part.c[[0, -1]] == pytest.approx(curve(part.t[[0, -1]]), abs=1e-9)


@given(splines(), st.data())
@few(20)
def test_a_stretch_from_knot_to_knot_adds_none(curve, data):
    knots = np.unique(curve.t)
    first = data.draw(st.integers(0, len(knots) - 2))
    last = data.draw(st.integers(first + 1, len(knots) - 1))
    part = stretch(curve, float(knots[first]) + 1e-12, float(knots[last]) - 1e-12)
    assert np.unique(part.t).tolist() == knots[first : last + 1].tolist()
