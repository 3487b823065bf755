"""Lids, holders and pins as CAD solids, against volumes that arithmetic gives and against their meshes."""

import math

import numpy as np
import pytest
import shapely
from build123d import GeomType, Solid, Vector

from design.pad.morphology import Morphology
from fabricate.mould.assembly import holder_body, lid_body, pins, sizes
from fabricate.mould.cad.bodies import body_solid, prism_solids
from fabricate.mould.mesh import mesh
from fabricate.mould.plan import Plan
from fabricate.mould.prisms import Body, Prism, cylinder
from tests.fabricate.planted import with_settings


def kinds(solid: Solid) -> dict[str, int]:
    names = [face.geom_type.name for face in solid.faces()]
    return {name: names.count(name) for name in sorted(set(names))}


def test_a_box():
    (solid,) = prism_solids([Prism(shapely.box(0, 0, 1, 2), 1, 4)])
    assert solid.is_valid
    assert solid.volume == pytest.approx(6)
    assert (solid.center() - Vector(0.5, 1, 2.5)).length < 1e-9


def test_what_is_drawn_round_is_round():
    (drum,) = prism_solids([Prism(cylinder(3, 4, 2.0), 0, 5)])
    assert drum.volume == pytest.approx(5 * math.pi, rel=1e-9)
    assert kinds(drum) == {"CYLINDER": 1, "PLANE": 2}
    (cone,) = prism_solids([Prism(cylinder(0, 0, 2.0), 0, 3, flare_mm=1.0)])
    assert cone.volume == pytest.approx(3 * math.pi * (1 + 2 + 4) / 3, rel=1e-9)
    assert kinds(cone) == {"CONE": 1, "PLANE": 2}


def test_a_polygon_of_few_corners_is_meant():
    (solid,) = prism_solids([Prism(cylinder(0, 0, 2.0, sides=8), 0, 1)])
    assert kinds(solid) == {"PLANE": 10}
    assert solid.volume == pytest.approx(4 * math.sin(math.pi / 4), rel=1e-9)


def test_holes_and_separate_areas():
    ring = shapely.box(0, 0, 3, 3) - shapely.box(1, 1, 2, 2)
    solids = prism_solids([Prism(shapely.union_all([ring, shapely.box(9, 0, 10, 1)]), 0, 2)])
    assert sorted(solid.volume for solid in solids) == pytest.approx([2, 16])


def test_walls_that_lean():
    (solid,) = prism_solids([Prism(shapely.box(0, 0, 4, 2), 0, 3, flare_mm=0.5)])
    assert solid.is_valid
    assert solid.volume == pytest.approx(3 * (4 * 2 + 4.5 * 2.5 * 4 + 5 * 3) / 6)


def test_a_union_without_cuts_and_with_adds():
    base = (Prism(shapely.box(0, 0, 4, 4), 0, 2), Prism(shapely.box(3, 0, 6, 4), 0, 2))
    cuts = (Prism(shapely.box(1, 1, 3, 3), 1, 3),)
    adds = (Prism(shapely.box(1.5, 1.5, 2, 2), 0.5, 3),)
    solid = body_solid(Body(base, cuts, adds))
    assert solid.is_valid
    assert solid.volume == pytest.approx(48 - 4 + 0.25 * 2)


def test_a_lid_with_pins_and_spout_has_the_volume_that_arithmetic_gives():
    everything = {"pins": True, "lid": True, "spout": True, "border_mm": 1.0}
    plan = Plan(Morphology.straight(1), with_settings(everything))
    flare = 6 * math.tan(math.radians(30))

    def cone(low, high, height):
        return math.pi * height * (low**2 + low * high + high**2) / 3

    holes = math.pi * (4 * 0.75**2 + 3 * ((sizes(plan)["pin_mm"] + 0.3) / 2) ** 2 + 3.0**2)
    plate = 3 * (sizes(plan)["tray_mm"] ** 2 - holes)
    cup = cone(5 + flare * 0.2 / 6.2, 5 + flare, 6.0)
    solid = body_solid(lid_body(plan))
    assert solid.is_valid
    assert solid.volume == pytest.approx(plate + cup - cone(3.0, 3 + flare, 6.0), rel=1e-7)
    assert solid.volume == pytest.approx(mesh(lid_body(plan)).volume(), rel=3e-4)
    assert kinds(solid) == {"CONE": 2, "CYLINDER": 8, "PLANE": 7}


@pytest.mark.parametrize("mould", [{}, {"exit_mm": 0.0, "border_mm": 1.5}])
def test_a_holder_is_that_of_the_mesh(mould):
    body = holder_body(Plan(Morphology.random(3, 2, seed=4), with_settings(mould)))
    solid, expected = body_solid(body), mesh(body)
    assert solid.is_valid
    assert solid.volume == pytest.approx(expected.volume(), rel=1e-9)
    assert solid.area == pytest.approx(expected.surface_area(), rel=1e-9)
    assert set(kinds(solid)) == {"PLANE"}


def test_pins_are_cylinders_where_the_plan_has_them():
    plan = Plan(Morphology.straight(2), with_settings({"pins": True}))
    solids = prism_solids(pins(plan))
    places = sorted([round(solid.center().X, 6), round(solid.center().Y, 6)] for solid in solids)
    away = plan.tray.bounds[2] - plan.corner_mm / 2
    assert np.array(places) == pytest.approx(np.array([[-away, -away], [-away, away], [away, -away]]))
    for solid in solids:
        (side,) = solid.faces().filter_by(GeomType.CYLINDER)
        assert side.radius == pytest.approx(1.0, abs=1e-9)
