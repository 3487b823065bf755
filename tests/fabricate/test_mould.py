import numpy as np
import pytest
import shapely
import trimesh

from design.errors import InputError
from design.morphology import Morphology
from fabricate.mould import build_mould, plan_mesh, plan_solid, plateaus
from fabricate.outlines import SNAP_MM, Plan
from fabricate.settings import DEFAULTS

from .planted import with_settings


def as_trimesh(plan: Plan) -> trimesh.Trimesh:
    mesh = plan_mesh(plan).to_mesh()
    return trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts)


def assert_one_closed_body_of_the_right_size(plan: Plan) -> None:
    mesh = as_trimesh(plan)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.euler_number == 2
    side = plan.pad.size_mm + 2 * plan.settings.mould.border_mm + 2 * plan.settings.mould.wall_mm
    height = plan.settings.mould.floor_mm + plan.settings.mould.silicone_mm
    assert mesh.extents == pytest.approx([side, side, height], abs=1e-4)
    assert mesh.bounds.mean(axis=0) == pytest.approx([0, 0, height / 2], abs=1e-4)


def assert_solid_and_mesh_agree(plan: Plan) -> None:
    solid = plan_solid(plan)
    assert solid.is_valid
    assert len(solid.shells()) == 1
    assert solid.volume == pytest.approx(plan_mesh(plan).volume(), rel=1e-5)
    assert np.subtract(*np.array([[*solid.bounding_box().max], [*solid.bounding_box().min]])) == pytest.approx(
        as_trimesh(plan).extents, abs=1e-4
    )


def test_straight_pad_has_the_volume_that_arithmetic_gives():
    plan = Plan(Morphology.straight(4))
    inner, ridge = 56.25, 0.4
    ridges = 4 * inner * ridge * (1.2 + 0.4) - 16 * ridge * ridge * 0.4  # the shallow ones end at the deep ones
    expected = 60.25**2 * 8 - inner**2 * 6 + ridges
    assert plan_mesh(plan).volume() == pytest.approx(expected, rel=1e-7)
    assert build_mould(plan.pad).volume == pytest.approx(expected, rel=1e-7)
    assert_one_closed_body_of_the_right_size(plan)
    assert_solid_and_mesh_agree(plan)


@pytest.mark.parametrize("name", ["1para", "5para_dis", "20para"])
def test_published_moulds_are_closed(published, name):
    plan = Plan(Morphology.load(published / f"{name}.mat"))
    assert_one_closed_body_of_the_right_size(plan)
    if name != "20para":  # the CAD kernel's own check takes ten seconds there
        assert_solid_and_mesh_agree(plan)


@pytest.mark.parametrize(("grid", "knots", "seed"), [(1, 1, 0), (2, 3, 1), (4, 10, 2), (4, 30, 3), (9, 4, 4)])
def test_random_moulds_are_closed(grid, knots, seed):
    plan = Plan(Morphology.random(grid, knots, seed))
    assert_one_closed_body_of_the_right_size(plan)
    volumes = [area.area * z for area, z in plateaus(plan)]
    assert sum(volumes) == pytest.approx(plan_mesh(plan).volume(), rel=1e-5)
    if grid < 4:
        assert_solid_and_mesh_agree(plan)


@pytest.mark.parametrize(
    "settings",
    [
        with_settings({"border_mm": 3.0, "wall_mm": 0.8, "ridge_width_mm": 1.5}),
        with_settings({"tolerance_mm": 0.05, "floor_mm": 0.4}, pad={"deep_family": "vertical"}),
    ],
)
def test_other_settings_make_closed_moulds(settings):
    plan = Plan(Morphology.random(4, 5, seed=5), settings)
    assert_one_closed_body_of_the_right_size(plan)
    assert_solid_and_mesh_agree(plan)


@pytest.mark.parametrize(("family", "heights"), [("horizontal", (1.2, 0.4)), ("vertical", (0.4, 1.2))])
def test_each_family_gets_its_height(family, heights):
    plan = Plan(Morphology.straight(2, pitch_mm=10.0), with_settings(pad={"deep_family": family}))
    levels = {round(z, 6): area for area, z in plateaus(plan)}
    assert set(levels) == {2.0, 2.4, 3.2, 8.0}
    on_horizontal, on_vertical, on_crossing = (0.0, -5.0), (-5.0, 0.0), (-5.0, -5.0)
    for place, height in (
        (on_horizontal, heights[0]),
        (on_vertical, heights[1]),
        (on_crossing, 1.2),
        ((0.0, 0.0), 0.0),
        ((15.5, 0.0), 6.0),
    ):
        assert levels[round(2 + height, 6)].covers(shapely.Point(place)), place


def test_outlines_that_touch_by_chance_are_drawn_finer():
    pad = Morphology.random(4, 30, seed=1032)
    assert not as_trimesh(Plan(pad)).is_watertight
    assert any(as_trimesh(plan).is_watertight for plan in Plan.tries(pad, DEFAULTS))


def test_plateaus_tile_the_tray_on_the_grid():
    plan = Plan(Morphology.random(4, 8, seed=6))
    areas = [area for area, _ in plateaus(plan)]
    assert sum(area.area for area in areas) == pytest.approx(plan.tray.area, rel=1e-12)
    assert shapely.coverage_is_valid([part for area in areas for part in shapely.get_parts(area)])
    steps = shapely.get_coordinates(areas) / SNAP_MM
    assert np.abs(steps - np.rint(steps)).max() < 1e-6


class TestSteppedSolid:
    def test_two_steps(self):
        from fabricate.plateaus import stepped_solid

        solid = stepped_solid([(shapely.box(0, 0, 1, 1), 1.0), (shapely.box(1, 0, 2, 1), 2.0)], 1e-3)
        assert solid.is_valid
        assert solid.volume == pytest.approx(3)
        assert len(solid.faces()) == 8 + 2  # the two long sides are divided at the step

    def test_a_hole_through_it(self):
        from fabricate.plateaus import stepped_solid

        ring = shapely.box(0, 0, 3, 3).difference(shapely.box(1, 1, 2, 2))
        solid = stepped_solid([(ring, 2.0)], 1e-3)
        assert solid.is_valid
        assert solid.volume == pytest.approx(16)

    def test_areas_that_touch_in_a_point_are_refused(self):
        from fabricate.plateaus import stepped_solid

        high = shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(1, 1, 2, 2)])
        low = shapely.MultiPolygon([shapely.box(1, 0, 2, 1), shapely.box(0, 1, 1, 2)])
        with pytest.raises(InputError, match=r"no closed solid, outlines touch at \(1.000, 1.000\) mm"):
            stepped_solid([(high, 2.0), (low, 1.0)], 1e-3)


def test_defaults_are_what_no_settings_mean():
    pad = Morphology.straight(1)
    assert build_mould(pad).volume == build_mould(pad, DEFAULTS).volume
