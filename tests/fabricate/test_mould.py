import math

import numpy as np
import pytest
import shapely
import trimesh
from shapely import affinity

from padforge.design.morphology import Morphology
from padforge.fabricate import Plan
from padforge.fabricate import mould as bodies
from padforge.fabricate.checks.plan_checks import check_plan
from padforge.fabricate.mesh import build_mesh, mesh_arrays
from padforge.fabricate.mould import Body, Prism, conductive_plan, lid_body, mould_body, well_outlines
from tests.fabricate.planted import with_settings


def as_read(body: Body) -> trimesh.Trimesh:
    """The mesh as whoever reads its STL finds it: single precision, equal vertices joined."""
    return trimesh.Trimesh(*mesh_arrays(build_mesh(body)))


def assert_one_closed_body(read: trimesh.Trimesh, genus: int = 0) -> None:
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.body_count == 1
    assert read.euler_number == 2 - 2 * genus


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """z of the products of vectors in a plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def height_at(solid: trimesh.Trimesh, x: float, y: float) -> float:
    """z of the mould's surface seen from above."""
    corners = solid.triangles
    a, b, c = corners[:, 0, :2], corners[:, 1, :2], corners[:, 2, :2]
    area = cross(b - a, c - a)
    up = area > 1e-12
    w = np.stack([cross(c - b, (x, y) - b), cross(a - c, (x, y) - c), cross(b - a, (x, y) - a)])[:, up]
    w = w / area[up]
    inside = (w >= -1e-9).all(axis=0)
    return float((w[:, inside] * corners[up][inside][:, :, 2].T).sum(axis=0).max())


@pytest.mark.parametrize(
    "pad",
    [*((2, 10, 2), (1, 30, 1032)), *(pytest.param(each, marks=pytest.mark.slow) for each in ((4, 30, 1032), "20para"))],
)
def test_random_and_published_moulds_are_closed(request, pad):
    if isinstance(pad, str):
        pad = Morphology.load(request.getfixturevalue("published") / f"{pad}.mat")
    else:
        pad = Morphology.random(*pad)
    assert_one_closed_body(as_read(mould_body(Plan(pad))))


def test_holder_fits_the_pad_with_its_leads():
    plan = Plan(Morphology.random(2, 2, seed=4), with_settings({"border_mm": 1.5, "floor_mm": 1.2}))
    read, frame = as_read(bodies.holder_body(plan)), bodies.bed_frame(plan)
    assert_one_closed_body(read)
    floor, wall, out = plan.settings.mould.floor_mm, frame["walls_mm"], plan.tray.bounds[2]
    assert read.bounds == pytest.approx(np.array([[-out, -out, 0], [out, out, wall]]), abs=1e-4)
    over = affinity.scale(plan.silicone, xfact=-1, origin=(0, 0))  # its rim, the wider side, is below
    rim = shapely.segmentize(over.buffer(plan.flare_mm + 0.1, join_style="mitre").exterior, 1.3)
    leads = [(-end[0], end[1]) for line in plan.lines for end in (line.coords[0], line.coords[-1])]
    beyond = [(x * 50, y) if abs(x) > abs(y) else (x, y * 50) for x, y in leads]
    lines = (shapely.LineString(ends) for ends in zip(leads, beyond, strict=True))
    ways = [line.intersection(plan.tray).coords[-1] for line in lines]
    for x, y in [*rim.coords, *leads, *(0.999 * np.array(ways))]:
        assert height_at(read, x, y) == pytest.approx(floor)
    inside = out - 0.2
    for place in ((inside, inside), (-inside, inside), (-inside, -inside)):
        assert height_at(read, *place) == pytest.approx(wall)
    with pytest.raises(ValueError, match="zero-size array"):
        height_at(read, inside, -inside)  # where fibres 1 and 3 start, as the pad lies


def test_ridges_run_to_the_end_of_their_slots_and_have_their_draft():
    plan = Plan(Morphology.straight(1, pitch_mm=10.0), with_settings({"number_mm": 0.0, "border_mm": 1.0}))
    read = as_read(mould_body(plan))
    edge = 10 + 1.0
    for place, z in (
        ((edge + 1.9, 0.1), 2 + 1.2),  # the ridge, to the end of its slot
        ((edge + 1.9, 1.4), 2.0),  # the floor of the slot beside it
        ((edge + 1.9, 1.8), 8.0),  # the wall beside the slot
        ((edge + 2.4, 0.1), 8.0),  # and behind it
        ((0.1, -edge - 1.9), 2 + 0.4),
    ):
        assert height_at(read, *place) == pytest.approx(z, abs=1e-4), place
    assert {round(2 * side, 6) for side in plan.tray.bounds[2:]} == {round(2 * (edge + 2 + 2 + plan.flare_mm), 6)}
    leaning = {"number_mm": 0.0, "exit_mm": 0.0, "wall_draft_deg": 10.0, "ridge_draft_deg": 10.0}
    plan = Plan(Morphology.straight(1, pitch_mm=20.0), with_settings(leaning))
    read = as_read(mould_body(plan))
    slope = math.tan(math.radians(10))
    for z in (3.0, 5.0, 7.5):  # on a wall clear of ridges
        assert height_at(read, 7.0, 20 + slope * (z - 2)) == pytest.approx(z, abs=1e-3)
    section = read.section(plane_origin=[0, 0, 2.05], plane_normal=[0, 0, 1])
    assert section is not None
    across = np.abs(section.vertices[(np.abs(section.vertices[:, 0]) < 15) & (np.abs(section.vertices[:, 1]) < 2)])
    foot = 0.2 + 1.1 * slope  # the lowest terrace, one layer high, is as wide as the taper at its top
    assert across[:, 1].max() == pytest.approx(foot, abs=0.011)
    assert bodies.sizes(plan)["ridge_foot_mm"] == pytest.approx(0.4 + 2 * 1.2 * slope)


def test_lid_has_holes_for_pins_vents_and_spout():
    plan = Plan(Morphology.straight(2), with_settings({"lid": True, "pins": True}))
    pin = bodies.sizes(plan)["pin_mm"]
    assert pin == 2.0
    assert_one_closed_body(as_read(lid_body(plan)), genus=4 + 3)
    read = as_read(mould_body(plan))
    assert read.bounds[1, 2] == pytest.approx(8 + pin)
    assert_one_closed_body(read)
    holes = [hole.area for hole in lid_body(plan).cuts]
    for peg in bodies.registration_pins(plan):  # a printed hole comes out narrower than drawn
        (around,) = (hole for hole in holes if hole.intersects(peg.area))
        assert around.boundary.distance(peg.area) >= 0.1
    spout = Plan(Morphology.straight(2), with_settings({"lid": True, "spout": True}))
    assert_one_closed_body(as_read(lid_body(spout)), genus=4 + 1)
    lid_body(Plan(Morphology.straight(1, 9.6), with_settings({"lid": True, "spout": True})))  # just room enough


@pytest.mark.parametrize(
    ("tapered", "knots", "layer_mm"), [(17.0, 1, 0.3), pytest.param(5.0, 4, 0.1, marks=pytest.mark.slow)]
)
def test_tapered_moulds_with_wells_are_closed(tapered, knots, layer_mm):
    tapers = with_settings({"ridge_draft_deg": tapered, "pins": True}, printer={"layer_mm": layer_mm})
    plan = Plan(Morphology.random(1, knots, seed=3), tapers)
    wells = conductive_plan(plan)
    for body in (mould_body(plan), mould_body(wells, well_outlines(wells))):
        assert_one_closed_body(as_read(body))


def test_mesh_arrays_separates_coincident_vertices():
    """Two blocks that share one upright line: joined there, the line would have four faces."""
    touching = Body((Prism(shapely.box(0, 0, 1, 1), 0, 1), Prism(shapely.box(1, 1, 2, 2), 0, 1)))
    vertices, triangles = mesh_arrays(build_mesh(touching))
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert trimesh.Trimesh(vertices, triangles).is_watertight
    assert trimesh.Trimesh(vertices, triangles).volume == pytest.approx(2, abs=2e-3)
    blocks = sorted(trimesh.Trimesh(vertices, triangles).split(), key=lambda block: block.bounds[0, 0])
    for low, block in zip((0, 1), blocks, strict=True):  # drawn back, not into each other
        assert (block.bounds[:, :2] >= low).all()
        assert (block.bounds[:, :2] <= low + 1).all()


def test_crossing_gap_is_a_lower_bound():
    """Fibres as cylinders on the floors of their tracks, which are the tops of the ridges, measured on the mesh."""
    plan = Plan(Morphology.random(2, 3, seed=4))
    read, fibre = as_read(mould_body(plan)), plan.settings.fibre.material.diameter_mm
    floors = []
    for line in plan.lines:
        places = shapely.line_interpolate_point(line, np.linspace(3, line.length - 3, 40))
        # Deeper tracks that cross are seen too: the least is the fibre's own.
        floors.append(min(height_at(read, *place) for place in shapely.get_coordinates(places)))
    (stated,) = [f.measured for f in check_plan(plan) if f.name == "crossing_gap"]
    assert isinstance(stated, float)
    for c in plan.crossings:
        assert abs(floors[c.first] - floors[c.second]) - fibre > stated - 1e-4
