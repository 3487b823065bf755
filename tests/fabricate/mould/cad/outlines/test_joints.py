"""Joints lie on the walls of fibres, where these pass knots."""

import numpy as np
import pytest
import shapely
from scipy.interpolate import PchipInterpolator

from design.pad.morphology import Morphology
from fabricate.mould.cad.outlines.joints import joints, with_joints
from fabricate.mould.cad.outlines.pieces import FINE_MM
from fabricate.mould.plan import Plan

PLAN = Plan(Morphology.random(2, 3, seed=5))
HALF_MM = PLAN.settings.mould.ridge_width_mm / 2


def test_two_joints_a_knot_half_a_width_away_across_the_fibre():
    found = joints(PLAN, 0, HALF_MM)
    own = [fibre for fibre, level in enumerate(PLAN.levels) if level == 0]
    knots = PLAN.pad.to_mm(PLAN.pad.knots)[own].reshape(-1, 2)
    assert len(found) == 2 * len(knots)
    for (x, y), along in found.items():
        away = np.array([x, y]) - knots
        nearest = np.abs(np.linalg.norm(away, axis=1) - HALF_MM).argmin()
        assert np.linalg.norm(away[nearest]) == pytest.approx(HALF_MM, abs=1e-12)
        assert away[nearest] @ along == pytest.approx(0, abs=1e-12)
        assert np.linalg.norm(along) == pytest.approx(1)


def test_directions_are_those_of_the_fibres():
    for level in range(len(PLAN.heights_mm)):
        found = joints(PLAN, level, HALF_MM)
        for fibre in (fibre for fibre, own in enumerate(PLAN.levels) if own == level):
            travel = PLAN.family(fibre)
            knots = PLAN.pad.to_mm(PLAN.pad.knots[fibre])
            slope = PchipInterpolator(knots[:, travel], knots[:, 1 - travel]).derivative()
            for knot in knots:
                along = np.ones(2)
                along[1 - travel] = slope(knot[travel])
                along /= np.linalg.norm(along)
                place = knot + HALF_MM * np.array([-along[1], along[0]])
                x, y = min(found, key=lambda other: np.hypot(other[0] - place[0], other[1] - place[1]))
                assert (x, y) == pytest.approx(place, abs=1e-9)
                assert abs(found[x, y] @ along) == pytest.approx(1)


def test_an_outline_gets_a_vertex_at_every_joint_on_it_and_keeps_its_shape():
    outline = PLAN.outline(0, 0.0, FINE_MM)
    at = joints(PLAN, 0, HALF_MM)
    joined = with_joints(outline, at)
    vertices = set(map(tuple, shapely.get_coordinates(joined).tolist()))
    on = [place for place in at if shapely.Point(place).distance(outline.boundary) < FINE_MM]
    assert len(on) >= 0.8 * len(at)  # but for those within another track
    assert vertices.issuperset(on)
    assert joined.area == pytest.approx(outline.area, abs=FINE_MM * outline.length)
    assert shapely.hausdorff_distance(joined, outline) < FINE_MM
    assert joined.is_valid


def test_joints_inside_stay_out():
    square = shapely.box(0, 0, 4, 4)
    along = np.array([1.0, 0.0])
    joined = with_joints(square, {(1.0, 4.0): along, (2.0, 3.9): along, (4.0, 4.0): along, (9.0, 9.0): along})
    assert set(map(tuple, shapely.get_coordinates(joined).tolist())) == {(0, 0), (4, 0), (4, 4), (1, 4), (0, 4)}


def test_holes_and_separate_parts_get_theirs():
    ring = shapely.box(0, 0, 9, 9) - shapely.box(3, 3, 6, 6)
    along = np.array([1.0, 0.0])
    joined = with_joints(shapely.union_all([ring, shapely.box(20, 0, 21, 1)]), {(4.0, 3.0): along, (20.5, 0.0): along})
    rings = [shapely.get_coordinates(ring)[:-1].tolist() for ring in shapely.get_rings(shapely.get_parts(joined))]
    assert [4.0, 3.0] in rings[1] or [4.0, 3.0] in rings[2]
    assert sorted(map(len, rings)) == [4, 5, 5]
