"""Lids, holders and pins as CAD solids, and solids made of meshes: against arithmetic and against each other."""

import math

import numpy as np
import pytest
import shapely
import trimesh
from build123d import GeomType, Solid
from manifold3d import Manifold, Mesh64

from design.pad.morphology import Morphology
from fabricate.mould.assembly import holder_body, lid_body, pins, sizes
from fabricate.mould.cad.bodies import body_solid, prism_solids
from fabricate.mould.cad.facets import faceted_solid
from fabricate.mould.mesh import mesh as body_mesh
from fabricate.mould.plan import Plan
from fabricate.mould.prisms import Body, Prism, cylinder
from tests.fabricate.planted import with_settings


def kinds(solid: Solid) -> dict[str, int]:
    names = [face.geom_type.name for face in solid.faces()]
    return {name: names.count(name) for name in sorted(set(names))}


@pytest.mark.parametrize(
    ("prism", "volume", "faces"),
    [
        (Prism(shapely.box(0, 0, 1, 2), 1, 4), 6, {"PLANE": 6}),
        (Prism(cylinder(3, 4, 2.0), 0, 5), 5 * math.pi, {"CYLINDER": 1, "PLANE": 2}),
        (Prism(cylinder(0, 0, 2.0), 0, 3, flare_mm=1.0), math.pi * (1 + 2 + 4), {"CONE": 1, "PLANE": 2}),
        (Prism(cylinder(0, 0, 2.0, sides=8), 0, 1), 4 * math.sin(math.pi / 4), {"PLANE": 10}),
        (Prism(shapely.box(0, 0, 4, 2), 0, 3, flare_mm=0.5), 3 * (8 + 4.5 * 2.5 * 4 + 15) / 6, None),
        (Prism(shapely.box(0, 0, 3, 3) - shapely.box(1, 1, 2, 2), 0, 2), 16, {"PLANE": 10}),
    ],
)
def test_a_prism_is_a_solid_of_true_faces(prism, volume, faces):
    (solid,) = prism_solids([prism])
    assert solid.is_valid
    assert solid.volume == pytest.approx(volume, rel=1e-9)
    assert faces in (None, kinds(solid))
    assert pytest.approx((prism.bottom_mm, prism.top_mm), abs=1e-6) == (
        solid.bounding_box().min.Z,
        solid.bounding_box().max.Z,
    )


def test_separate_areas_of_a_prism_are_separate_solids():
    solids = prism_solids([Prism(shapely.union_all([shapely.box(0, 0, 3, 3), shapely.box(9, 0, 10, 1)]), 0, 2)])
    assert sorted(solid.volume for solid in solids) == pytest.approx([2, 18])


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
    assert solid.volume == pytest.approx(body_mesh(lid_body(plan)).volume(), rel=3e-4)
    assert kinds(solid) == {"CONE": 2, "CYLINDER": 8, "PLANE": 7}


@pytest.mark.parametrize("mould", [{}, {"exit_mm": 0.0, "border_mm": 1.5}])
def test_a_holder_is_that_of_the_mesh(mould):
    body = holder_body(Plan(Morphology.random(3, 2, seed=4), with_settings(mould)))
    solid, expected = body_solid(body), body_mesh(body)
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


NOTCHED = [(0, 0), (1, 0), (1, 1), (0.5, 1), (0.5, 1 - 1e-7), (0, 1 - 1e-7)]
PLATE, BLOCK = Prism(shapely.box(-1, -1, 3, 3), -1, 0.5), Prism(shapely.box(0, 0, 1, 1), 0, 2)
"""With another block these touch in one upright line."""


@pytest.mark.parametrize(
    ("body", "volume", "faces"),
    [
        (Body((Prism(shapely.box(0, 0, 3, 3) - shapely.box(1, 1, 2, 2), 0, 2),)), 16, 10),
        (Body((Prism(shapely.Polygon(NOTCHED), 0, 1),)), 1, 7),  # edges too short for the kernel
        *((Body((PLATE, BLOCK, Prism(shapely.box(1, 1, 2, 2), 0, z))), 25 + z, None) for z in (2.0, 1.5)),
    ],
)
def test_a_mesh_is_a_solid_of_few_faces(body, volume, faces):
    solid = faceted_solid(body_mesh(body))
    assert solid.is_valid
    assert solid.volume == pytest.approx(volume, rel=1e-6)
    assert faces in (None, len(solid.faces()))


def test_a_face_that_is_divided_from_within_is_one_face():
    fine = trimesh.creation.box((2, 2, 2)).subdivide().subdivide()
    solid = faceted_solid(Manifold(Mesh64(fine.vertices, fine.faces.astype(np.uint64))))
    assert solid.is_valid
    assert len(solid.faces()) == 6
    assert solid.volume == pytest.approx(8)
