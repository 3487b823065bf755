"""Curves through finely drawn outlines, against the shapes that were drawn and the exact offsets of fibres."""

import math

import numpy as np
import pytest
import shapely

from padforge.design.morphology import Morphology
from padforge.design.paths.curves import arc_lengths
from padforge.fabricate.cad.curves import (
    FINE_MM,
    OutlineCurve,
    find_joints,
    fit_spline,
    insert_joints,
    ring_curves,
)
from padforge.fabricate.plan import Plan, polygon_rings
from tests.fabricate.planted import with_settings

Array = np.ndarray


FIT_MM = 2e-3


FINE = 64
"""Segments of a quarter of a circle: the rings are drawn within FINE_MM of circles of a few mm."""


def length(piece: OutlineCurve) -> float:
    """Arc length along the vertices of a piece, up to which its parameter runs."""
    if piece.spline is not None:
        return float(piece.spline.t[-1])
    return float(arc_lengths(piece.points)[-1])


def at(piece: OutlineCurve, s: Array | float) -> Array:
    """Points at arc lengths (...,), shape (..., 2)."""
    share = np.asarray(s)[..., None] / length(piece)
    if piece.spline is not None:
        return piece.spline(s)
    if piece.arc is not None:
        x, y, radius, start, sweep = piece.arc
        angle = start + sweep * share
        return (x, y) + radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
    return (1 - share) * piece.points[0] + share * piece.points[-1]


def tangent(piece: OutlineCurve, s: float) -> Array:
    """Direction at one of the ends, by a difference within the piece."""
    step = 1e-7 * length(piece)
    return (at(piece, s + step) - at(piece, s)) if s == 0 else (at(piece, s) - at(piece, s - step))


def ring(area: shapely.Polygon) -> Array:
    return polygon_rings(area)[0][0]


def turns(pieces: list[OutlineCurve]) -> Array:
    """Degrees that the direction turns by where one piece follows another, all round."""
    ends = np.array([tangent(piece, length(piece)) for piece in pieces])
    starts = np.array([tangent(piece, 0) for piece in [*pieces[1:], pieces[0]]])
    cross = ends[:, 0] * starts[:, 1] - ends[:, 1] * starts[:, 0]
    return np.degrees(np.abs(np.arctan2(cross, (ends * starts).sum(axis=1))))


def gaps(pieces: list[OutlineCurve]) -> Array:
    ends = np.array([at(piece, length(piece)) for piece in pieces])
    return np.linalg.norm(ends - [at(piece, 0) for piece in [*pieces[1:], pieces[0]]], axis=1)


def walls(plan: Plan, fibre: int) -> list[list[OutlineCurve]]:
    """The pieces of every ring of the ridge of a fibre."""
    at = find_joints(plan, fibre, plan.settings.mould.ridge_width_mm / 2)
    outline = insert_joints(plan.outline([fibre], 0.0, FINE_MM), at)
    return [list(ring_curves(each, at, FIT_MM)) for rings in polygon_rings(outline) for each in rings]


@pytest.mark.parametrize("clockwise", [False, True])
def test_ring_curves_of_a_circle_are_two_arcs(clockwise):
    drawn = ring(shapely.Point(3, 4).buffer(2.0, quad_segs=FINE))
    pieces = list(ring_curves(drawn[::-1] if clockwise else drawn, {}, FIT_MM))
    assert len(pieces) == 2
    for piece in pieces:
        assert piece.arc is not None
        assert piece.arc[:3] == pytest.approx((3, 4, 2), abs=1e-9)
    assert sum(piece.arc[4] for piece in pieces if piece.arc) == pytest.approx((-2 if clockwise else 2) * math.pi)
    assert turns(pieces).max() < 1e-4


@pytest.mark.parametrize(("knots", "seed"), [(1, 0), (8, 2), pytest.param(20, 3, marks=pytest.mark.slow)])
def test_track_outlines_close_and_turn_at_corners_only(knots, seed):
    plan = Plan(Morphology.random(1, knots, seed), with_settings({"border_mm": 2.0}))
    for fibre in range(2):
        for pieces in walls(plan, fibre):
            turned = turns(pieces)
            arcs = np.array([piece.arc is not None for piece in pieces])
            assert gaps(pieces)[~(arcs | np.roll(arcs, -1))].max(initial=0) < 1e-9
            assert gaps(pieces).max() < 1e-4  # an arc is through all vertices, about
            assert not ((turned > 0.1) & (turned < 5)).any()
            square = np.abs(turned - 90) < 1e-3
            assert square.sum() in (0, 4)  # none round a hole that folds leave


@pytest.mark.parametrize("far", [[19, 5], [10, 10, 10], [25]])
def test_fit_spline_stays_near_sparse_vertices(far):
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
