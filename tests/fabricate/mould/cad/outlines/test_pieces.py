"""Pieces of finely drawn rings, against the shapes that were drawn and the exact offsets of fibres."""

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator
from scipy.spatial import KDTree

from design.pad.morphology import Morphology
from fabricate.mould.cad.outlines.joints import joints, with_joints
from fabricate.mould.cad.outlines.pieces import (
    FINE_MM,
    Piece,
    arc_through,
    outline_pieces,
    ring_pieces,
    straight_pieces,
)
from fabricate.mould.plan import Plan, polygon_rings
from tests.fabricate.planted import with_settings
from tests.helpers.effort import few

Array = np.ndarray
FIT_MM = 2e-3
FINE = 64
"""Segments of a quarter of a circle: the rings are drawn within FINE_MM of circles of a few mm."""


def ring(area: shapely.Polygon) -> Array:
    return polygon_rings(area)[0][0]


def pieces_of(area: shapely.Polygon) -> list[Piece]:
    return list(ring_pieces(ring(area), {}, FIT_MM))


def turns(pieces: list[Piece]) -> Array:
    """Degrees that the direction turns by where one piece follows another, all round."""
    ends = np.array([piece.tangent(piece.length) for piece in pieces])
    starts = np.array([piece.tangent(0) for piece in [*pieces[1:], pieces[0]]])
    cross = ends[:, 0] * starts[:, 1] - ends[:, 1] * starts[:, 0]
    return np.degrees(np.abs(np.arctan2(cross, (ends * starts).sum(axis=1))))


def gaps(pieces: list[Piece]) -> Array:
    ends = np.array([piece.at(piece.length) for piece in pieces])
    return np.linalg.norm(ends - [piece.at(0) for piece in [*pieces[1:], pieces[0]]], axis=1)


def walls(plan: Plan, level: int, fit_mm: float = FIT_MM) -> list[list[Piece]]:
    """The pieces of every ring of the tracks of a level."""
    at = joints(plan, level, plan.settings.mould.ridge_width_mm / 2)
    outline = with_joints(plan.outline(level, 0.0, FINE_MM), at)
    return [list(ring_pieces(each, at, fit_mm)) for rings in polygon_rings(outline) for each in rings]


def exact(plan: Plan, level: int) -> Array:
    """Places every 5 µm along the exact fibres of a level, by scipy's own PCHIP."""
    places = []
    for fibre in (fibre for fibre, own in enumerate(plan.levels) if own == level):
        travel = plan.family(fibre)
        knots = plan.pad.to_mm(plan.pad.knots[fibre])
        curve = PchipInterpolator(knots[:, travel], knots[:, 1 - travel])
        t = np.unique(np.concatenate([np.linspace(a, b, 3000) for a, b in pairwise(knots[:, travel])]))
        along = np.concatenate([[0], np.cumsum(np.hypot(np.diff(t), np.diff(curve(t))))])
        t = np.interp(np.arange(0, along[-1], 5e-3), along, t)
        places.append(np.stack([t, curve(t)], axis=1)[:, :: -1 if travel else 1])
    return np.concatenate(places)


def deviation(plan: Plan, level: int, fit_mm: float = FIT_MM) -> tuple[float, int]:
    """How far walls stray from half a width beside the nearest fibre, mm, and at how many places that was looked at."""
    sampled = [piece.at(np.linspace(0, piece.length, 400)) for own in walls(plan, level, fit_mm) for piece in own]
    points = np.concatenate(sampled)
    clear = plan.cavity.bounds[2] - 1.0  # near the walls ends of tracks are square
    points = points[np.abs(points).max(axis=1) < clear]
    distance, _ = KDTree(exact(plan, level)).query(points)
    return float(np.abs(distance - plan.settings.mould.ridge_width_mm / 2).max()), len(points)


def test_a_circle_is_two_arcs():
    pieces = pieces_of(shapely.Point(3, 4).buffer(2.0, quad_segs=FINE))
    assert len(pieces) == 2
    for piece in pieces:
        assert piece.arc is not None
        assert piece.arc[:3] == pytest.approx((3, 4, 2), abs=1e-9)
    assert sum(piece.arc[4] for piece in pieces if piece.arc) == pytest.approx(2 * math.pi)
    assert turns(pieces).max() < 1e-6


def test_a_round_hole_is_two_arcs_the_other_way():
    (_, hole), *_ = polygon_rings(shapely.box(-5, -5, 5, 5) - shapely.Point(1, 0).buffer(2.0, quad_segs=FINE))
    pieces = list(ring_pieces(hole, {}, FIT_MM))
    assert sum(piece.arc[4] for piece in pieces if piece.arc) == pytest.approx(-2 * math.pi)


@pytest.mark.parametrize("corners", [3, 4, 5, 12])
def test_a_polygon_is_its_edges(corners):
    polygon = shapely.Point(0, 0).buffer(5.0).boundary.interpolate(np.arange(corners) / corners, normalized=True)
    drawn = shapely.Polygon(polygon.tolist())
    pieces = pieces_of(drawn)
    assert len(pieces) == corners
    assert all(piece.arc is None and piece.curve is None for piece in pieces)
    assert sum(piece.length for piece in pieces) == pytest.approx(drawn.length)
    assert sorted(turns(pieces)) == pytest.approx([360 / corners] * corners, abs=0.5)


def test_a_stadium_is_two_lines_and_two_arcs():
    pieces = pieces_of(shapely.LineString([(0, 0), (9, 0)]).buffer(1.5, quad_segs=FINE))
    assert sorted("arc" if piece.arc else "line" for piece in pieces) == ["arc", "arc", "line", "line"]
    assert [piece.arc[4] for piece in pieces if piece.arc] == pytest.approx([math.pi] * 2)
    assert sum(abs(piece.arc[2] * piece.arc[4]) if piece.arc else piece.length for piece in pieces) == pytest.approx(
        18 + 3 * math.pi
    )
    assert turns(pieces).max() < 0.01
    assert gaps(pieces).max() < 1e-9


def test_a_smooth_ring_that_is_no_circle_is_splines_that_close():
    t = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    drawn = np.stack([8 * np.cos(t), 3 * np.sin(t)], axis=1)
    pieces = list(ring_pieces(drawn, {}, FIT_MM))
    assert all(piece.curve for piece in pieces)
    for piece in pieces:
        x, y = piece.at(np.linspace(0, piece.length, 500)).T
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
    for piece in [*ring_pieces(ring(area)[::way], {}, FIT_MM), *ring_pieces(ellipse[::way], {}, FIT_MM)]:
        s = np.linspace(0, piece.length, 50)[1:-1]
        assert (piece.at(s + 1e-6) - piece.at(s - 1e-6)) / 2e-6 == pytest.approx(piece.tangent(s), abs=1e-5)
        assert piece.at(np.array([0, piece.length])) == pytest.approx(piece.points[[0, -1]], abs=FIT_MM)
        assert piece.at(0).shape == piece.tangent(0).shape == (2,)


@given(st.floats(-50, 50), st.floats(0.2, 80), st.floats(0.2, 6), st.integers(6, 300), st.booleans())
@few(40)
def test_an_arc_is_found_from_its_vertices(x, radius, sweep, count, clockwise):
    angles = 1 + (-sweep if clockwise else sweep) * np.linspace(0, 1, count)
    found = arc_through(np.stack([x + radius * np.cos(angles), 2 + radius * np.sin(angles)], axis=1))
    assert found is not None
    assert found[:3] == pytest.approx((x, 2, radius), rel=1e-6, abs=1e-6)
    if sweep < 5 * (count - 1) / 2:  # less than half a turn an edge
        assert found[4] == pytest.approx(-sweep if clockwise else sweep, abs=1e-6)


def test_what_is_no_arc_or_too_few_vertices_to_tell():
    x = np.linspace(-1, 1, 50)
    assert arc_through(np.stack([x, x**2], axis=1)) is None
    angles = np.linspace(0, 1, 4)
    assert arc_through(np.stack([np.cos(angles), np.sin(angles)], axis=1)) is None


@pytest.mark.parametrize(("knots", "seed"), [(1, 0), (3, 1), (8, 2), (20, 3)])
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
        (2, 5, 1, {}),
        (2, 3, 3, {"ridge_width_mm": 1.5}),
        (1, 20, 4, {}),
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


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
@few(6)
def test_the_walls_of_any_fibre_are_half_a_width_away(seed, knots):
    plan = Plan(Morphology.random(1, knots, seed))
    assert deviation(plan, 0)[0] < 3e-3


def test_the_area_within_pieces_is_that_of_the_outline():
    """Green's theorem on the curves, against the area of what was drawn."""
    plan = Plan(Morphology.random(2, 4, seed=8))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for level in range(len(plan.heights_mm)):
        area = 0.0
        for piece in (piece for pieces in walls(plan, level) for piece in pieces):
            knots = np.unique(piece.curve.t) if piece.curve else np.linspace(0, piece.length, 9)
            for a, b in pairwise(knots):
                s = (a + b) / 2 + (b - a) / 2 * nodes
                (x, y), (dx, dy) = piece.at(s).T, piece.tangent(s).T
                area += (b - a) / 4 * weights @ (x * dy - y * dx)
        outline = plan.outline(level, 0.0, FINE_MM)
        assert area == pytest.approx(outline.area, abs=FIT_MM / 2 * outline.length)


def test_outline_pieces_know_how_high_they_rise():
    pieces = outline_pieces(shapely.box(0, 0, 2, 1) - shapely.box(0.5, 0.2, 1, 0.6), {}, (2.0, 3.2), FIT_MM)
    assert len(pieces) == 8
    assert {piece.rise for piece in pieces} == {(2.0, 3.2)}


def test_straight_pieces_are_every_edge_of_lines_and_rings():
    lines = shapely.union_all([shapely.box(0, 0, 2, 1).exterior, shapely.LineString([(5, 5), (6, 7), (9, 7)])])
    pieces = straight_pieces(lines)
    assert sorted(piece.length for piece in pieces) == pytest.approx([1, 1, 2, 2, math.sqrt(5), 3])
    assert pieces[0].at(pieces[0].length / 2) == pytest.approx(pieces[0].points.mean(axis=0))
