import math

import numpy as np
import pytest
import shapely
import trimesh
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
    check_body,
    failures,
    has_position_near,
    line,
    prism,
    ridge,
    spanning,
    tray,
)


class TestGoodBodies:
    def test_tray_with_ridges_passes(self):
        findings = check_body(tray(*CROSS), genus=0)
        assert not failures(findings)
        assert set(SOLID_CHECKS) < set(findings)
        assert len(findings) == 14
        assert findings["wall_thickness"].measured == pytest.approx(WALL, rel=0.03)
        assert findings["floor_thickness"].measured == pytest.approx(FLOOR)

    def test_crossing_ridges_of_one_height_pass(self):
        crossing = shapely.union(spanning(0.5), shapely.affinity.rotate(spanning(0.5), 30, (0, 0.5)))
        assert not failures(check_body(tray(ridge(crossing & shapely.box(-10.5, -10.5, 10.5, 10.5)))))

    def test_bends_numbers_and_exits_pass(self):
        turns = [(6 * math.cos(t), 6 * math.sin(t)) for t in np.linspace(0, 4, 200)]
        eight = [line((-1, -2), (1, -2), (1, 2), (-1, 2), (-1, -2)), line((-1, 0), (1, 0)), line((-1, 1.9), (-1, 2.2))]
        slot = Manifold.cube((2, 1.5, DEPTH + 1)).translate((-1, SIZE / 2 - 0.5, FLOOR))
        parts = [ridge(line(*turns), 1.2), ridge(shapely.union_all(eight))]
        assert not failures(check_body(tray(*parts, wall=3.0) - slot))

    def test_lid_with_holes_passes(self):
        holes = [shapely.Point(x, y).buffer(0.75) for x in (-8, 8) for y in (-8, 8)]
        lid = prism(shapely.box(-12, -12, 12, 12).difference(shapely.union_all(holes)), 0, 3)
        findings = check_body(lid, genus=4)
        assert not failures(findings)
        assert findings["silicone_wall"].measured == findings["wall_thickness"].measured == 24
        assert failures(check_body(lid, genus=0)) == {"genus": "fail"}

    def test_bodies_without_flat_faces_and_below_a_layer(self):
        assert set(failures(check_body(trimesh.creation.torus(10, 2), genus=1))) == {"overhang"}
        assert failures(check_body(block(10, 10, 0.03))) == {"floor_thickness": "fail"}


class TestWidth:
    @pytest.mark.parametrize(("width", "status"), [(0.36, "fail"), (0.39, "pass")])
    def test_ridge_width_of_a_narrow_ridge(self, width, status):
        thin = ridge(line((2, -6), (7, -5), width=width), 0.8)
        findings = check_body(tray(*CROSS, thin))
        assert findings["ridge_width"].status == status
        assert failures(findings) == ({"ridge_width": "fail"} if status == "fail" else {})
        if status == "fail":
            assert findings["ridge_width"].measured == pytest.approx(width, abs=0.015)
            assert has_position_near(findings["ridge_width"], 4.5, -5.5, 2.6)
            assert len(findings["ridge_width"].positions_mm) == 1

    @pytest.mark.parametrize(
        ("printer", "status"),
        [
            ({"nozzle_mm": 0.25, "resin": True}, "fail"),
            ({"nozzle_mm": 0.25}, "pass"),
        ],
    )
    def test_ridge_width_by_printer(self, printer, status):
        assert check_body(tray(*CROSS), printer=PrinterSettings.model_validate(printer))["ridge_width"].status == status

    @pytest.mark.parametrize(("gap", "status"), [(0.09, "fail"), (0.12, "warn"), (0.4, "pass")])
    def test_silicone_wall_between_ridges(self, gap, status):
        findings = check_body(
            tray(*CROSS, ridge(spanning(3.4 + gap), 1.2), ridge(spanning(-7)), ridge(spanning(-6.6 + gap)))
        )
        assert failures(findings) == ({} if status == "pass" else {"silicone_wall": status})
        if status != "pass":
            assert findings["silicone_wall"].measured == pytest.approx(gap, abs=0.015)
            assert {round(y) for _, y in findings["silicone_wall"].positions_mm} == {3, -7}
            allowed = tray(*CROSS, ridge(spanning(3.4 + gap), 1.2))
            assert not failures(check_body(allowed, min_silicone_mm=gap - 0.04)) or gap < 0.1

    def test_silicone_wall_at_a_shallow_crossing(self):
        crossing = shapely.union(spanning(0.5), shapely.affinity.rotate(spanning(0.5), 10, (0, 0.5)))
        findings = check_body(tray(ridge(crossing & shapely.box(-10.5, -10.5, 10.5, 10.5))))
        assert failures(findings) == {"silicone_wall": "warn"}
        assert len(findings["silicone_wall"].positions_mm) == 2

    @pytest.mark.parametrize(("height", "status"), [(0.55, "pass"), (0.65, "warn")])
    def test_silicone_wall_between_similar_heights(self, height, status):
        findings = check_body(tray(*CROSS, ridge(spanning(3.7), height)))
        assert findings["silicone_wall"].status == status

    @pytest.mark.parametrize(("wall", "status"), [(0.3, "fail"), (0.6, "warn")])
    def test_wall_thickness_of_a_thin_wall(self, wall, status):
        cut = Manifold.cube((5, 40, 20), True).translate((SIZE / 2 + wall + 2.5, 0, 5))
        findings = check_body(tray(*CROSS, draft_deg=0) - cut)
        assert findings["wall_thickness"].status == status
        assert findings["wall_thickness"].measured == pytest.approx(wall, rel=0.06)
        assert all(SIZE / 2 < x < SIZE / 2 + wall for x, _ in findings["wall_thickness"].positions_mm)
        assert bool(findings["wall_thickness"].positions_mm) == (status != "pass")

    @pytest.mark.parametrize(("wall", "status"), [(0.3, "fail"), (0.6, "warn"), (0.9, "pass")])
    def test_wall_thickness_of_a_resin_printer(self, wall, status):
        """Lines of two pixels of 0.2 mm."""
        cut = Manifold.cube((5, 40, 20), True).translate((SIZE / 2 + wall + 2.5, 0, 5))
        printer = PrinterSettings(nozzle_mm=0.2, resin=True)
        finding = check_body(tray(*CROSS, draft_deg=0) - cut, printer=printer)["wall_thickness"]
        assert (finding.status, finding.limit) == (status, 0.8)

    def test_wall_thickness_of_a_leaning_wall(self):
        """A wall 0.5 mm thick at the rim, and thicker by half a millimetre a millimetre below it."""
        side, top, over = 20.0, FLOOR + DEPTH, 1.0
        flare = 1 + (DEPTH + over) / side
        hollow = Manifold.extrude(CrossSection.square((side, side), True), DEPTH + over, scale_top=(flare, flare))
        outer = side + DEPTH + 2 * 0.5
        box = Manifold.cube((outer, outer, top), True).translate((0, 0, top / 2))
        findings = check_body(box - hollow.translate((0, 0, FLOOR)), printer=PrinterSettings(layer_mm=0.4))[
            "wall_thickness"
        ]
        assert findings.measured == pytest.approx(0.5 + 0.4 / 2 * 0.5, abs=0.015)

    @pytest.mark.parametrize(
        ("floor", "layer", "status"),
        [(0.37, 0.1, "fail"), (0.55, 0.3, "fail"), (0.59, 0.3, "pass")],
    )
    def test_floor_thickness_by_layer(self, floor, layer, status):
        findings = check_body(tray(floor=floor), printer=PrinterSettings(layer_mm=layer))["floor_thickness"]
        assert (findings.status, findings.limit) == (status, pytest.approx(max(0.4, 2 * layer)))
        assert findings.measured == pytest.approx(floor)

    @pytest.mark.parametrize(("lean_deg", "status"), [(8, "fail"), (12, "pass")])
    def test_floor_thickness_over_a_gable(self, lean_deg, status):
        """A groove from below, with a roof that leans to either side and leaves 0.3 mm of floor over its ridge."""
        fall = 3 * math.tan(math.radians(lean_deg))
        gable = shapely.Polygon([(-3, -1), (3, -1), (3, 1.7 - fall), (0, 1.7), (-3, 1.7 - fall)])
        groove = prism(gable, -4, 4).rotate((90, 0, 0))
        floor = check_body(tray(*CROSS) - groove)["floor_thickness"]
        assert floor.status == status
        if status == "fail":
            assert floor.measured == pytest.approx(0.3, abs=0.02)


class TestLean:
    def test_ridge_with_a_head_is_overhang_and_undercut(self):
        head = prism(line((2, -6), (7, -6), width=1.5), FLOOR + 0.8, FLOOR + 1.2)
        findings = check_body(tray(*CROSS, ridge(line((2, -6), (7, -6)), 1.2), head))
        assert failures(findings) == {"overhang": "fail", "undercut": "fail"}
        for name in ("overhang", "undercut"):
            assert findings[name].measured == pytest.approx(90)
            assert has_position_near(findings[name], 4.5, -6, 2.6)

    def test_overhang_ignores_the_first_layer(self):
        """A foot that is set back by a millimetre, for half a layer and for two."""
        for foot, status in ((0.05, "pass"), (0.2, "fail")):
            top, low = block(10, 10, 4, at=(0, 0, 2 + foot)), block(8, 8, foot + 0.5, at=(0, 0, (foot + 0.5) / 2))
            solid = Manifold.batch_boolean([_manifold(top), _manifold(low)], OpType.Add)
            assert check_body(solid, printer=PrinterSettings(layer_mm=0.1))["overhang"].status == status

    @pytest.mark.parametrize("lean_deg", [0.05, 3])
    def test_undercut_of_a_leaning_wall(self, lean_deg):
        undercut = check_body(tray(*CROSS, draft_deg=-lean_deg))["undercut"]
        assert (undercut.status, undercut.limit) == ("pass" if lean_deg < 0.1 else "fail", 0)
        if undercut.status == "pass":
            return
        assert undercut.measured == pytest.approx(lean_deg, rel=0.01)
        assert undercut.positions_mm
        assert all(max(abs(x), abs(y)) == pytest.approx(SIZE / 2, abs=1) for x, y in undercut.positions_mm)

    @pytest.mark.parametrize(("lean_deg", "status"), [(45.8, "pass"), (46.3, "fail")])
    def test_overhang_of_a_funnel(self, lean_deg, status):
        top = 4 + 4 * math.tan(math.radians(lean_deg))
        cup = Manifold.cylinder(4, 4, top, 64) - Manifold.cylinder(5, 2, 2, 64).translate((0, 0, -0.5))
        plate = Manifold.cube((24, 24, 3), True).translate((0, 0, -1.4)) - Manifold.cylinder(9, 2, 2, 64).translate(
            (0, 0, -5)
        )
        findings = check_body(plate + cup, genus=1)
        assert failures(findings) == ({} if status == "pass" else {"overhang": "fail"})
        assert findings["overhang"].measured == pytest.approx(lean_deg, abs=0.1)


def _manifold(mesh: trimesh.Trimesh) -> Manifold:
    return Manifold(Mesh(np.float32(mesh.vertices), np.uint32(mesh.faces)))


@pytest.mark.parametrize(("layers", "status"), [(0.4, "pass"), (0.6, "fail")])
def test_ridges_of_half_a_layer_or_more_are_as_wide_as_the_nozzle(layers: float, status: str) -> None:
    """Lower ones are not printed."""
    printer = PrinterSettings(layer_mm=0.2)
    narrow = ridge(spanning(0.0, width=0.5 * printer.line_mm), layers * printer.layer_mm)
    assert check_body(tray(narrow), printer=printer)["ridge_width"].status == status
