"""The tray's walls as heights over places, against closed forms and shapely's own union of grown rectangles."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from design.pad.morphology import Morphology
from fabricate.mould.cad.walls import FLOOR, RIM, Walls, walls_of
from fabricate.mould.plan import Plan
from tests.fabricate.planted import with_settings
from tests.helpers.effort import few

BOWL = Walls(np.array([[-10.0, -5.0, 10.0, 5.0]]), floor_mm=2.0, depth_mm=6.0, flare_mm=0.5)
CROSS = Walls(np.array([[-10.0, -10.0, 10.0, 10.0], [9.0, -1.0, 12.0, 1.0]]), 2.0, 6.0, 0.5)


def test_heights_of_a_bowl():
    places = np.array([[0, 0], [9.99, 0], [10.25, 0], [10.5, 0], [11, 0], [0, -5.1], [-10.2, 5.3], [10.25, 5.4]])
    assert BOWL.heights(places) == pytest.approx([2, 2, 5, 8, 8, 2 + 0.1 * 12, 2 + 0.3 * 12, 2 + 0.4 * 12])
    sheets = BOWL.sheets(places).tolist()
    assert sheets[:2] == [FLOOR, FLOOR]
    assert sheets[3:5] == [RIM, RIM]
    assert len({sheets[2], sheets[5], sheets[6]}) == 3
    assert sheets[6] == sheets[7]


@given(st.floats(-13, 13), st.floats(-13, 13), st.sampled_from([BOWL, CROSS]))
@few(60)
def test_planes_are_the_heights_over_their_places(x, y, walls):
    place = np.array([[x, y]])
    (sheet,) = walls.sheets(place).tolist()
    expected = walls.floor_mm if sheet == FLOOR else walls.floor_mm + walls.depth_mm
    plane = expected if sheet < 0 else walls.plane(sheet, place)[0]
    assert walls.heights(place)[0] == pytest.approx(plane, abs=1e-9)
    if sheet >= 0:
        beside = walls.plane(sheet, place + np.eye(2)) - plane
        assert walls.normal(sheet) == pytest.approx((-beside[0], -beside[1], 1))


@pytest.mark.parametrize("z", [2.0, 2.4, 5.0, 8.0])
@pytest.mark.parametrize("walls", [BOWL, CROSS])
def test_outlines_are_what_is_open_at_a_height(walls, z):
    grown = (z - 2.0) / 6.0 * 0.5
    boxes = [shapely.box(*low - grown, *high + grown) for low, high in walls.hollows.reshape(-1, 2, 2)]
    outline = walls.outline(z)
    assert outline.symmetric_difference(shapely.union_all(boxes)).area == pytest.approx(0, abs=1e-9)
    on = np.array([point.coords[0] for point in outline.exterior.interpolate(np.linspace(0, 1, 41), normalized=True)])
    assert walls.heights(on) == pytest.approx(np.full(41, z))


def test_creases_are_where_planes_meet():
    floor, *corners = CROSS.creases()
    assert shapely.Polygon(floor).equals(CROSS.outline(2.0))
    assert len(corners) == 8
    for corner in corners:
        assert corner.length == pytest.approx(0.5 * math.sqrt(2))
        middle = np.array(corner.interpolate(0.5, normalized=True).coords)
        assert CROSS.heights(middle) == pytest.approx([5.0])
        beside = CROSS.sheets(middle + 1e-3 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
        assert len(set(beside.tolist())) == 2


def test_upright_walls_have_no_planes():
    upright = Walls(BOWL.hollows, 2.0, 6.0, 0.0)
    places = np.array([[0, 0], [9.9999, 4], [10.0001, 0], [0, -5.1]])
    assert upright.heights(places).tolist() == [2, 2, 8, 8]
    assert upright.sheets(places).tolist() == [FLOOR, FLOOR, RIM, RIM]
    assert len(upright.creases()) == 1
    assert upright.outline(8.0).equals(upright.outline(2.0))


@pytest.mark.parametrize("mould", [{}, {"exit_mm": 0.0}, {"wall_draft_deg": 0.0, "border_mm": 1.5}])
def test_walls_of_a_plan(mould):
    plan = Plan(Morphology.random(2, 2, seed=1), with_settings(mould))
    walls = walls_of(plan)
    assert walls.outline(walls.floor_mm).symmetric_difference(plan.silicone).area == pytest.approx(0, abs=1e-9)
    assert (walls.floor_mm, walls.depth_mm) == (2.0, plan.silicone_mm)
    assert walls.flare_mm == pytest.approx(6 * math.tan(math.radians(plan.settings.mould.wall_draft_deg)))
    assert walls.outline(8.0).bounds[0] == pytest.approx(plan.silicone.bounds[0] - plan.flare_mm)
