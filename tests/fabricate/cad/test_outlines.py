"""Curves through finely drawn outlines, against the shapes that were drawn and the exact offsets of fibres."""

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline, PchipInterpolator
from scipy.spatial import KDTree

from padforge.design.morphology import Morphology
from padforge.fabricate.cad.curves import (
    FINE_MM,
    MAX_SPANS,
    OutlineCurve,
    arc_lengths,
    find_joints,
    fit_arc,
    fit_spline,
    insert_joints,
    ring_curves,
    split_parameters,
    trim_spline,
)
from padforge.fabricate.plan import Plan, polygon_rings
from tests.fabricate.planted import exact_fibre, with_settings

Array = np.ndarray


FIT_MM = 2e-3


FINE = 64
"""Segments of a quarter of a circle: the rings are drawn within FINE_MM of circles of a few mm."""


def values(piece: OutlineCurve, s: Array | float) -> Array:
    """Points and derivatives at arc lengths (...,), shape (..., 4)."""
    return np.array([piece.evaluate(float(each)) for each in np.ravel(s)]).reshape(*np.shape(s), 4)


def at(piece: OutlineCurve, s: Array | float) -> Array:
    return values(piece, s)[..., :2]


def tangent(piece: OutlineCurve, s: Array | float) -> Array:
    return values(piece, s)[..., 2:]


def ring(area: shapely.Polygon) -> Array:
    return polygon_rings(area)[0][0]


def turns(pieces: list[OutlineCurve]) -> Array:
    """Degrees that the direction turns by where one piece follows another, all round."""
    ends = np.array([tangent(piece, piece.length) for piece in pieces])
    starts = np.array([tangent(piece, 0) for piece in [*pieces[1:], pieces[0]]])
    cross = ends[:, 0] * starts[:, 1] - ends[:, 1] * starts[:, 0]
    return np.degrees(np.abs(np.arctan2(cross, (ends * starts).sum(axis=1))))


def gaps(pieces: list[OutlineCurve]) -> Array:
    ends = np.array([at(piece, piece.length) for piece in pieces])
    return np.linalg.norm(ends - [at(piece, 0) for piece in [*pieces[1:], pieces[0]]], axis=1)


def walls(plan: Plan, level: int, fit_mm: float = FIT_MM) -> list[list[OutlineCurve]]:
    """The pieces of every ring of the tracks of a level."""
    at = find_joints(plan, level, plan.settings.mould.ridge_width_mm / 2)
    outline = insert_joints(plan.outline(level, 0.0, FINE_MM), at)
    return [list(ring_curves(each, at, fit_mm)) for rings in polygon_rings(outline) for each in rings]


def deviation(plan: Plan, level: int, fit_mm: float = FIT_MM) -> tuple[float, int]:
    """How far walls stray from half a width beside the nearest fibre, mm, and at how many places that was looked at."""
    sampled = [at(piece, np.linspace(0, piece.length, 400)) for own in walls(plan, level, fit_mm) for piece in own]
    points = np.concatenate(sampled)
    clear = plan.cavity.bounds[2] - 1.0  # near the walls ends of tracks are square
    points = points[np.abs(points).max(axis=1) < clear]
    exact = [exact_fibre(plan.pad, fibre) for fibre, own in enumerate(plan.layer_indices) if own == level]
    distance, _ = KDTree(np.concatenate(exact)).query(points)
    return float(np.abs(distance - plan.settings.mould.ridge_width_mm / 2).max()), len(points)


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_circle_is_two_arcs(clockwise):
    drawn = ring(shapely.Point(3, 4).buffer(2.0, quad_segs=FINE))
    pieces = list(ring_curves(drawn[::-1] if clockwise else drawn, {}, FIT_MM))
    assert len(pieces) == 2
    for piece in pieces:
        assert piece.arc is not None
        assert piece.arc[:3] == pytest.approx((3, 4, 2), abs=1e-9)
    assert sum(piece.arc[4] for piece in pieces if piece.arc) == pytest.approx((-2 if clockwise else 2) * math.pi)
    assert turns(pieces).max() < 1e-6


@pytest.mark.parametrize("corners", [3, 4, 5, 12])
def test_a_polygon_is_its_edges(corners):
    polygon = shapely.Point(0, 0).buffer(5.0).boundary.interpolate(np.arange(corners) / corners, normalized=True)
    drawn = shapely.Polygon(polygon.tolist())
    pieces = list(ring_curves(ring(drawn), {}, FIT_MM))
    assert len(pieces) == corners
    assert all(piece.arc is None and piece.spline is None for piece in pieces)
    assert sum(piece.length for piece in pieces) == pytest.approx(drawn.length)
    assert sorted(turns(pieces)) == pytest.approx([360 / corners] * corners, abs=0.5)


def test_a_smooth_ring_that_is_no_circle_is_splines_that_close():
    t = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    drawn = np.stack([8 * np.cos(t), 3 * np.sin(t)], axis=1)
    pieces = list(ring_curves(drawn, {}, FIT_MM))
    assert all(piece.spline for piece in pieces)
    for piece in pieces:
        x, y = at(piece, np.linspace(0, piece.length, 500)).T
        slope = np.hypot(x / 64, y / 9)
        assert np.abs((x**2 / 64 + y**2 / 9 - 1) / 2 / slope).max() < FIT_MM + FINE_MM
    assert gaps(pieces).max() < 1e-9
    assert turns(pieces).max() < 0.1


@pytest.mark.parametrize("clockwise", [False, True])
def test_at_and_tangent_belong_together(clockwise):
    way = -1 if clockwise else 1
    area = shapely.LineString([(0, 0), (9, 0)]).buffer(1.5, quad_segs=FINE)
    t = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    ellipse = np.stack([8 * np.cos(t), 3 * np.sin(t)], axis=1)
    for piece in [*ring_curves(ring(area)[::way], {}, FIT_MM), *ring_curves(ellipse[::way], {}, FIT_MM)]:
        s = np.linspace(0, piece.length, 50)[1:-1]
        assert (at(piece, s + 1e-6) - at(piece, s - 1e-6)) / 2e-6 == pytest.approx(tangent(piece, s), abs=1e-5)
        assert at(piece, np.array([0, piece.length])) == pytest.approx(piece.points[[0, -1]], abs=FIT_MM)
        assert at(piece, 0).shape == tangent(piece, 0).shape == (2,)


@given(st.floats(-50, 50), st.floats(0.2, 80), st.floats(0.2, 6), st.integers(6, 300), st.booleans())
@settings(max_examples=30)
def test_an_arc_is_found_from_its_vertices(x, radius, sweep, count, clockwise):
    angles = 1 + (-sweep if clockwise else sweep) * np.linspace(0, 1, count)
    found = fit_arc(np.stack([x + radius * np.cos(angles), 2 + radius * np.sin(angles)], axis=1))
    assert found is not None
    assert found[:3] == pytest.approx((x, 2, radius), rel=1e-6, abs=1e-6)
    if sweep < 5 * (count - 1) / 2:  # less than half a turn an edge
        assert found[4] == pytest.approx(-sweep if clockwise else sweep, abs=1e-6)


def test_what_is_no_arc_or_too_few_vertices_to_tell():
    x = np.linspace(-1, 1, 50)
    assert fit_arc(np.stack([x, x**2], axis=1)) is None
    angles = np.linspace(0, 1, 4)
    assert fit_arc(np.stack([np.cos(angles), np.sin(angles)], axis=1)) is None


@pytest.mark.parametrize(("knots", "seed"), [(1, 0), (8, 2), pytest.param(20, 3, marks=pytest.mark.slow)])
def test_walls_close_and_turn_at_real_corners_only(knots, seed):
    plan = Plan(Morphology.random(1, knots, seed), with_settings({"border_mm": 2.0}))
    for level in range(2):
        for pieces in walls(plan, level):
            turned = turns(pieces)
            arcs = np.array([piece.arc is not None for piece in pieces])
            assert gaps(pieces)[~(arcs | np.roll(arcs, -1))].max(initial=0) < 1e-9
            assert gaps(pieces).max() < 1e-4  # an arc is through all vertices, about
            assert not ((turned > 0.1) & (turned < 5)).any()
            square = np.abs(turned - 90) < 1e-6
            assert square.sum() in (0, 4)  # none round a hole that folds leave


@pytest.mark.parametrize(
    ("grid", "knots", "seed", "mould"),
    [
        (1, 1, 0, {}),
        pytest.param(2, 5, 1, {}, marks=pytest.mark.slow),
        (2, 3, 3, {"ridge_width_mm": 1.5}),
        pytest.param(1, 20, 4, {}, marks=pytest.mark.slow),
        (1, 8, 5, {"tolerance_mm": 0.05}),
    ],
)
def test_walls_are_half_a_width_from_the_exact_fibres(grid, knots, seed, mould):
    plan = Plan(Morphology.random(grid, knots, seed), with_settings(mould))
    for level in range(len(plan.heights_mm)):
        off, count = deviation(plan, level)
        assert off < 3e-3
        assert count > 500


def test_finer_walls_are_nearer():
    plan = Plan(Morphology.random(1, 3, seed=6))
    assert deviation(plan, 0, fit_mm=1e-4)[0] < 5e-4


PLAN = Plan(Morphology.random(2, 3, seed=5))
HALF_MM = PLAN.settings.mould.ridge_width_mm / 2


def test_two_joints_a_knot_half_a_width_away_across_the_fibre():
    for level in range(len(PLAN.heights_mm)):
        found, fibres = (
            find_joints(PLAN, level, HALF_MM),
            [f for f, own in enumerate(PLAN.layer_indices) if own == level],
        )
        assert len(found) == 2 * PLAN.pad.knots.shape[1] * len(fibres)
        for fibre in fibres:
            travel, knots = PLAN.family(fibre), PLAN.pad.to_mm(PLAN.pad.knots[fibre])
            slope = PchipInterpolator(knots[:, travel], knots[:, 1 - travel]).derivative()
            for knot in knots:
                along = np.ones(2)
                along[1 - travel] = slope(knot[travel])
                along /= np.linalg.norm(along)
                for side in (1, -1):
                    place = knot + side * HALF_MM * np.array([-along[1], along[0]])
                    x, y = min(found, key=lambda other: np.hypot(other[0] - place[0], other[1] - place[1]))
                    assert (x, y) == pytest.approx(place, abs=1e-9)
                    assert np.linalg.norm(found[x, y]) == pytest.approx(1)
                    assert abs(found[x, y] @ along) == pytest.approx(1)


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


@pytest.mark.parametrize("fit_mm", [2e-3, 1e-4])
@pytest.mark.parametrize("count", [1500, 6000])
def test_a_spline_is_near_what_is_drawn_with_few_spans(fit_mm, count):
    t = np.linspace(0, 6, count)
    points = wave(t)
    curve = fit_spline(points, [wave_along(0), wave_along(6)], fit_mm)
    first, last = curve.t[0], curve.t[-1]
    assert (first, last) == pytest.approx((0, arc_lengths(points)[-1]))
    found = curve(np.linspace(first, last, 5000))
    along = np.stack([np.ones(len(found)), 2 * np.cos(2 * found[:, 0])], axis=1)
    off = np.abs(found[:, 1] - np.sin(2 * found[:, 0])) / np.linalg.norm(along, axis=1)
    sagitta = (t[1] - t[0]) ** 2 * 4 / 8  # the polyline's own distance from the wave, at its crests
    assert off.max() <= fit_mm + sagitta + 1e-7
    assert len(np.unique(curve.t)) - 1 <= (36 if fit_mm > 1e-3 else 60)


@given(st.floats(0.5, 3.0), st.floats(0.1, 2.0), st.integers(3, 400), st.sampled_from([2e-3, 1e-4]))
@settings(max_examples=20)
def test_ends_and_their_directions_are_exact(waves, high, count, fit_mm):
    points = wave(np.linspace(0, 4, count), waves, high)
    tangents = [wave_along(0, waves, high), wave_along(4, waves, high)]
    curve = fit_spline(points, tangents, fit_mm)
    first, last = curve.t[[0, -1]]
    assert curve([first, last]) == pytest.approx(points[[0, -1]], abs=1e-12)
    for s, along in zip((first, last), tangents, strict=True):
        derivative = curve(s, 1)
        assert derivative / np.linalg.norm(derivative) == pytest.approx(along, abs=1e-9)


@pytest.mark.parametrize("far", [[19, 5], [10, 10, 10], [25]])
def test_a_spline_strays_nowhere_along_far_vertices(far):
    """A bend of 3 mm radius, drawn finely, and a run out of it that hardly bends, of few vertices."""
    angle = np.linspace(0, 0.3, 10)
    bend = 3 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    out, aside = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    run = bend[-1] + np.outer(np.cumsum(far), out) + np.outer([1e-3, 1.5e-3, 0][: len(far)], aside)
    points = np.vstack([bend, run])
    end = (points[-1] - points[-2]) / np.linalg.norm(points[-1] - points[-2])
    curve = fit_spline(points, [np.array([1.0, 0.0]), end], 2e-3)
    places = shapely.points(curve(np.linspace(curve.t[0], curve.t[-1], 5000)))
    assert shapely.distance(places, shapely.LineString(points)).max() <= 2.2e-3


@given(splines())
@settings(max_examples=20)
def test_no_part_between_breaks_has_more_spans_than_allowed(curve):
    knots = np.unique(curve.t)
    cuts = [knots[0], *split_parameters(curve), knots[-1]]
    assert cuts == sorted(set(cuts))
    assert set(cuts) <= set(knots.tolist())
    spans = [int(((knots >= a) & (knots < b)).sum()) for a, b in pairwise(cuts)]
    assert max(spans) <= MAX_SPANS
    assert len(spans) == -(-(len(knots) - 1) // MAX_SPANS)


@given(splines(), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=40)
def test_a_stretch_is_the_curve_itself(curve, low, high):
    whole = curve.t[[0, -1]]
    start, end = sorted(whole[0] + np.array([low, high]) * (whole[1] - whole[0]))
    if end - start < 1e-6:
        start, end = whole
    part = trim_spline(curve, start, end)
    assert part.t[[0, -1]] == pytest.approx([start, end], abs=1e-9)
    assert (part.t[:4] == part.t[0]).all()
    assert (part.t[-4:] == part.t[-1]).all()
    inner = curve.t[(curve.t > start + 1e-6) & (curve.t < end - 1e-6)]
    assert part.t[4:-4] == pytest.approx(inner, abs=1e-9)  # knots of its own only
    assert len(part.c) == len(part.t) - 4
    places = np.linspace(part.t[0], part.t[-1], 200)
    for derivative in (0, 1):
        assert part(places, derivative) == pytest.approx(curve(places, derivative), abs=1e-7)
    assert part.c[[0, -1]] == pytest.approx(curve(part.t[[0, -1]]), abs=1e-9)
