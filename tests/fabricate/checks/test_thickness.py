import math

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from manifold3d import CrossSection, Manifold, Mesh, OpType

from padforge.fabricate.checks.mesh_checks import SOLID_CHECKS
from padforge.fabricate.settings import PrinterSettings
from tests.fabricate.checks.trays import (
    CROSS,
    DEPTH,
    FLOOR,
    SIZE,
    WALL,
    block,
    faults,
    inspected,
    line,
    near,
    prism,
    ridge,
    spanning,
    tray,
)


class TestGood:
    def test_a_tray_with_ridges_passes_every_check(self):
        found = inspected(tray(*CROSS), genus=0)
        assert not faults(found)
        assert set(SOLID_CHECKS) < set(found)
        assert len(found) == 14
        assert found["wall_thickness"].measured == pytest.approx(WALL, rel=0.03)
        assert found["floor_thickness"].measured == pytest.approx(FLOOR)

    @settings(max_examples=6)
    @given(
        st.floats(0, 8),
        st.floats(0.8, 4),
        st.floats(0.4, 1.0),
        st.floats(30, 150),
        st.floats(0.2, 1.0),
        st.floats(0.0, 1.5),
        st.integers(1, 4),
    )
    def test_no_false_alarm(self, draft_deg, wall, width, angle_deg, height, further, count):
        pitch = SIZE / (count + 1)
        rows = [-SIZE / 2 + pitch * (n + 1) for n in range(count)]
        end = 6 * math.sin(math.radians(angle_deg))
        assume(all(abs(abs(end) - abs(y)) > 1.5 for y in rows))  # an end just beside a ridge is thin indeed
        lines = [spanning(y, width) for y in rows]
        across = shapely.affinity.rotate(line((-6, 0), (6, 0), width=width), angle_deg, (0, 0))
        adds = [ridge(outline, height + further) for outline in lines]
        assert not faults(inspected(tray(*adds, ridge(across, height), draft_deg=draft_deg, wall=wall)))

    @pytest.mark.parametrize("angle_deg", [30, 60, 120])
    def test_ridges_of_one_height_that_cross(self, angle_deg):
        crossing = shapely.union(spanning(0.5), shapely.affinity.rotate(spanning(0.5), angle_deg, (0, 0.5)))
        assert not faults(inspected(tray(ridge(crossing & shapely.box(-10.5, -10.5, 10.5, 10.5)))))

    def test_bends_ends_numbers_and_exits(self):
        turns = [(6 * math.cos(t), 6 * math.sin(t)) for t in np.linspace(0, 4, 200)]
        eight = [line((-1, -2), (1, -2), (1, 2), (-1, 2), (-1, -2)), line((-1, 0), (1, 0)), line((-1, 1.9), (-1, 2.2))]
        slot = Manifold.cube((2, 1.5, DEPTH + 1)).translate((-1, SIZE / 2 - 0.5, FLOOR))
        parts = [ridge(line(*turns), 1.2), ridge(shapely.union_all(eight))]
        assert not faults(inspected(tray(*parts, wall=3.0) - slot))

    def test_a_lid_with_holes(self):
        holes = [shapely.Point(x, y).buffer(0.75) for x in (-8, 8) for y in (-8, 8)]
        lid = prism(shapely.box(-12, -12, 12, 12).difference(shapely.union_all(holes)), 0, 3)
        found = inspected(lid, genus=4)
        assert not faults(found)
        assert found["silicone_wall"].measured == found["wall_thickness"].measured == 24
        assert faults(inspected(lid, genus=0)) == {"genus": "fail"}

    def test_bodies_without_levels_and_of_less_than_a_layer(self):
        assert set(faults(inspected(trimesh.creation.torus(10, 2), genus=1))) == {"overhang"}
        assert faults(inspected(block(10, 10, 0.03))) == {"floor_thickness": "fail"}


class TestWidth:
    @pytest.mark.parametrize(("width", "status"), [(0.2, "fail"), (0.36, "fail"), (0.39, "pass")])
    def test_a_narrow_ridge(self, width, status):
        thin = ridge(line((2, -6), (7, -5), width=width), 0.8)
        found = inspected(tray(*CROSS, thin))
        assert found["ridge_width"].status == status
        assert faults(found) == ({"ridge_width": "fail"} if status == "fail" else {})
        if status == "fail":
            assert found["ridge_width"].measured == pytest.approx(width, abs=0.015)
            assert near(found["ridge_width"], 4.5, -5.5, 2.6)
            assert len(found["ridge_width"].positions_mm) == 1

    @pytest.mark.parametrize(
        ("printer", "status"),
        [
            ({"nozzle_mm": 0.6}, "fail"),
            ({"nozzle_mm": 0.05, "resin": True}, "pass"),
            ({"nozzle_mm": 0.25, "resin": True}, "fail"),
            ({"nozzle_mm": 0.25}, "pass"),
        ],
    )
    def test_what_a_printer_draws(self, printer, status):
        assert inspected(tray(*CROSS), printer=PrinterSettings.model_validate(printer))["ridge_width"].status == status

    @pytest.mark.parametrize(
        ("gap", "status"), [(0.05, "fail"), (0.09, "fail"), (0.12, "warn"), (0.35, "warn"), (0.4, "pass")]
    )
    def test_narrow_silicone_between_ridges(self, gap, status):
        found = inspected(
            tray(*CROSS, ridge(spanning(3.4 + gap), 1.2), ridge(spanning(-7)), ridge(spanning(-6.6 + gap)))
        )
        assert faults(found) == ({} if status == "pass" else {"silicone_wall": status})
        if status != "pass":
            assert found["silicone_wall"].measured == pytest.approx(gap, abs=0.015)
            assert {round(y) for _, y in found["silicone_wall"].positions_mm} == {3, -7}
            allowed = tray(*CROSS, ridge(spanning(3.4 + gap), 1.2))
            assert not faults(inspected(allowed, min_silicone_mm=gap - 0.04)) or gap < 0.1

    def test_ridges_of_one_height_that_cross_at_a_flat_angle(self):
        crossing = shapely.union(spanning(0.5), shapely.affinity.rotate(spanning(0.5), 10, (0, 0.5)))
        found = inspected(tray(ridge(crossing & shapely.box(-10.5, -10.5, 10.5, 10.5))))
        assert faults(found) == {"silicone_wall": "warn"}
        assert len(found["silicone_wall"].positions_mm) == 2

    def test_narrow_silicone_before_a_wall(self):
        found = inspected(tray(*CROSS, ridge(spanning(9.5)), draft_deg=0))
        assert faults(found) == {"silicone_wall": "warn"}
        assert found["silicone_wall"].measured == pytest.approx(0.3, abs=0.015)
        assert all(9.6 < y < 10.1 for _, y in found["silicone_wall"].positions_mm)

    def test_a_slot_through_the_wall_does_not_hide_the_casting(self):
        slot = Manifold.cube((10, 1.5, DEPTH + 1)).translate((5, -0.75, FLOOR))
        assert faults(inspected(tray(*CROSS) - slot)) == {"tight": "fail"}
        found = inspected(tray(*CROSS, ridge(spanning(3.7), 1.2)) - slot)
        assert faults(found) == {"silicone_wall": "warn", "tight": "fail"}

    @pytest.mark.parametrize(("height", "status"), [(0.4, "pass"), (0.55, "pass"), (0.65, "warn")])
    def test_tracks_whose_depths_differ_by_less_than_one_and_a_half_walls_are_of_one_depth(self, height, status):
        found = inspected(tray(*CROSS, ridge(spanning(3.7), height)))
        assert found["silicone_wall"].status == status

    @pytest.mark.parametrize(("wall", "status"), [(0.3, "fail"), (0.6, "warn"), (0.85, "pass")])
    def test_a_thin_wall(self, wall, status):
        cut = Manifold.cube((5, 40, 20), True).translate((SIZE / 2 + wall + 2.5, 0, 5))
        found = inspected(tray(*CROSS, draft_deg=0) - cut)
        assert found["wall_thickness"].status == status
        assert found["wall_thickness"].measured == pytest.approx(wall, rel=0.06)
        assert all(SIZE / 2 < x < SIZE / 2 + wall for x, _ in found["wall_thickness"].positions_mm)
        assert bool(found["wall_thickness"].positions_mm) == (status != "pass")

    @pytest.mark.parametrize("layer", [0.1, 0.4])
    def test_a_leaning_wall_is_measured_in_the_middle_of_its_last_layer(self, layer):
        """A wall 0.5 mm thick at the rim, and thicker by half a millimetre a millimetre below it."""
        side, top, over = 20.0, FLOOR + DEPTH, 1.0
        flare = 1 + (DEPTH + over) / side
        hollow = Manifold.extrude(CrossSection.square((side, side), True), DEPTH + over, scale_top=(flare, flare))
        outer = side + DEPTH + 2 * 0.5
        box = Manifold.cube((outer, outer, top), True).translate((0, 0, top / 2))
        found = inspected(box - hollow.translate((0, 0, FLOOR)), printer=PrinterSettings(layer_mm=layer))[
            "wall_thickness"
        ]
        assert found.measured == pytest.approx(0.5 + layer / 2 * 0.5, abs=0.015)

    @pytest.mark.parametrize(
        ("floor", "layer", "status"),
        [(0.2, 0.1, "fail"), (0.37, 0.1, "fail"), (0.39, 0.1, "pass"), (0.55, 0.3, "fail"), (0.59, 0.3, "pass")],
    )
    def test_a_floor_is_two_layers_and_at_least_four_tenths_thick(self, floor, layer, status):
        found = inspected(tray(floor=floor), printer=PrinterSettings(layer_mm=layer))["floor_thickness"]
        assert (found.status, found.limit) == (status, pytest.approx(max(0.4, 2 * layer)))
        assert found.measured == pytest.approx(floor)

    @pytest.mark.parametrize(("lean_deg", "status"), [(0, "fail"), (8, "fail"), (12, "pass")])
    def test_a_floor_is_level_to_ten_degrees(self, lean_deg, status):
        """A groove from below, with a roof that leans to either side and leaves 0.3 mm of floor over its ridge."""
        fall = 3 * math.tan(math.radians(lean_deg))
        gable = shapely.Polygon([(-3, -1), (3, -1), (3, 1.7 - fall), (0, 1.7), (-3, 1.7 - fall)])
        groove = prism(gable, -4, 4).rotate((90, 0, 0))
        floor = inspected(tray(*CROSS) - groove)["floor_thickness"]
        assert floor.status == status
        if status == "fail":
            assert floor.measured == pytest.approx(0.3, abs=0.02)

    def test_a_pit_from_below(self):
        pit = Manifold.cylinder(FLOOR - 0.3, 1.0).translate((4, -5, 0))
        floor = inspected(tray(*CROSS) - pit)["floor_thickness"]
        assert floor.measured == pytest.approx(0.3, abs=1e-5)
        assert near(floor, 4, -5)


class TestLean:
    def test_a_ridge_with_a_head(self):
        head = prism(line((2, -6), (7, -6), width=1.5), FLOOR + 0.8, FLOOR + 1.2)
        found = inspected(tray(*CROSS, ridge(line((2, -6), (7, -6)), 1.2), head))
        assert faults(found) == {"overhang": "fail", "undercut": "fail"}
        for name in ("overhang", "undercut"):
            assert found[name].measured == pytest.approx(90)
            assert near(found[name], 4.5, -6, 2.6)

    @pytest.mark.parametrize(("lean_deg", "status"), [(0.05, "pass"), (0.2, "fail")])
    def test_a_wall_that_is_upright_but_for_rounding(self, lean_deg, status):
        assert inspected(tray(draft_deg=-lean_deg))["undercut"].status == status

    def test_a_slot_through_the_wall_does_not_hide_that_it_leans(self):
        slot = Manifold.cube((10, 1.5, DEPTH + 1)).translate((5, -0.75, FLOOR))
        assert faults(inspected(tray(draft_deg=-3) - slot)) == {"undercut": "fail", "tight": "fail"}

    @pytest.mark.parametrize(("side", "status"), [(0.08, "pass"), (0.13, "fail")])
    def test_specks_need_no_support(self, side, status):
        bracket = Manifold.cube((1.0, 1.0, 4.0)).translate((-9.5, 0, FLOOR - 0.2))
        speck = Manifold.cube((side, side, 0.5)).translate((-8.5, 0.2, FLOOR + 2))
        assert inspected(tray(bracket, speck), printer=PrinterSettings(layer_mm=0.1))["overhang"].status == status

    def test_the_first_layer_lies_on_the_bed(self):
        """A foot that is set back by a millimetre, for half a layer and for two."""
        for foot, status in ((0.05, "pass"), (0.2, "fail")):
            top, low = block(10, 10, 4, at=(0, 0, 2 + foot)), block(8, 8, foot + 0.5, at=(0, 0, (foot + 0.5) / 2))
            solid = Manifold.batch_boolean([_manifold(top), _manifold(low)], OpType.Add)
            assert inspected(solid, printer=PrinterSettings(layer_mm=0.1))["overhang"].status == status

    @pytest.mark.parametrize("lean_deg", [0.5, 3, 10])
    def test_a_wall_that_leans_inwards(self, lean_deg):
        undercut = inspected(tray(*CROSS, draft_deg=-lean_deg))["undercut"]
        assert (undercut.status, undercut.limit) == ("fail", 0)
        assert undercut.measured == pytest.approx(lean_deg, rel=0.01)
        assert undercut.positions_mm
        assert all(max(abs(x), abs(y)) == pytest.approx(SIZE / 2, abs=1) for x, y in undercut.positions_mm)

    @pytest.mark.parametrize(("lean_deg", "status"), [(30, "pass"), (45.8, "pass"), (46.3, "fail")])
    def test_a_funnel_on_a_plate_is_no_cavity(self, lean_deg, status):
        top = 4 + 4 * math.tan(math.radians(lean_deg))
        cup = Manifold.cylinder(4, 4, top, 64) - Manifold.cylinder(5, 2, 2, 64).translate((0, 0, -0.5))
        plate = Manifold.cube((24, 24, 3), True).translate((0, 0, -1.4)) - Manifold.cylinder(9, 2, 2, 64).translate(
            (0, 0, -5)
        )
        found = inspected(plate + cup, genus=1)
        assert faults(found) == ({} if status == "pass" else {"overhang": "fail"})
        assert found["overhang"].measured == pytest.approx(lean_deg, abs=0.1)


def _manifold(mesh: trimesh.Trimesh) -> Manifold:
    return Manifold(Mesh(np.float32(mesh.vertices), np.uint32(mesh.faces)))
