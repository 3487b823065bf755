"""Checks of meshes, on sound trays and blocks and on ones with a known fault."""

import math

import numpy as np
import pytest
import shapely
import trimesh
from manifold3d import CrossSection, Manifold, OpType

from padforge.design.morphology import Morphology
from padforge.fabricate.checks import Finding
from padforge.fabricate.checks.mesh_checks import SOLID_CHECKS, check_solid, check_triangles
from padforge.fabricate.checks.surface import TriangleMesh
from padforge.fabricate.mesh import build_mesh, mesh_arrays
from padforge.fabricate.mould import mould_body
from padforge.fabricate.plan import Plan
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
    together,
    tray,
)


def check_solidity(vertices: np.ndarray, triangles: np.ndarray, genus: int | None = None) -> dict[str, Finding]:
    return {f.name: f for f in check_solid(TriangleMesh.weld(vertices, triangles), genus)}


class TestSolid:
    box = block(10, 20, 5)

    def test_open_and_flipped_and_fourfold_edges_are_not_watertight(self):
        findings = check_body(trimesh.Trimesh(self.box.vertices, self.box.faces[1:]))
        assert findings["manifold"].status == findings["watertight"].status == "fail"
        assert findings["watertight"].measured == len(findings["watertight"].positions_mm) == 3
        assert "ridge_width" not in findings
        faces = np.array(self.box.faces)
        faces[0] = faces[0][::-1]
        flipped = check_body(trimesh.Trimesh(self.box.vertices, faces))["watertight"]
        assert (flipped.status, flipped.measured) == ("fail", 3)
        x, y, _ = self.box.triangles_center[0]
        assert has_position_near(flipped, x, y, 8.0)
        fourfold = check_solidity(*together(self.box, block(10, 20, 5, at=(10, 20, 0))))["watertight"]
        assert (fourfold.status, fourfold.measured) == ("fail", 1)
        assert has_position_near(fourfold, 5, 10, 1e-6)

    def test_inverted_box_has_no_volume_and_empty_mesh_no_body(self):
        assert failures(check_body(_turned(self.box))) == {"volume": "fail"}
        findings = check_triangles(np.empty((0, 3)), np.empty((0, 3), dtype=int))
        assert {f.name for f in findings if f.status == "fail"} >= {"bodies", "volume"}

    def test_check_solid_merges_equal_vertices(self):
        mesh = tray(*CROSS).to_mesh()
        corners = np.asarray(mesh.vert_properties)[np.asarray(mesh.tri_verts)][::-1].reshape(-1, 3)
        findings = check_solidity(corners, np.arange(len(corners)).reshape(-1, 3), genus=0)
        assert list(findings) == list(SOLID_CHECKS)
        assert not failures(findings)

    def test_measured_values_of_a_box(self):
        findings = check_body(self.box, genus=0)
        assert findings["volume"].measured == pytest.approx(1000)
        assert findings["bed"].measured == pytest.approx([10, 20, 5])
        assert findings["bed"].message == "10 x 20 x 5 mm, the bed is 220 x 220 x 250 mm"
        assert findings["genus"].measured == 0
        assert check_body(block(10.002, 20.01, 5))["bed"].message.startswith("10.01 x 20.01 x 5 mm")  # never less

    @pytest.mark.parametrize("genus", [0, 2])
    def test_genus_counts_through_holes(self, genus):
        plate = prism(shapely.box(-12, -5, 12, 5), 0, 3)
        for x in (-6, 6)[:genus]:
            plate -= Manifold.cylinder(9, 2.0, 2.0, 24).translate((x, 0, -1))
        mesh = plate.to_mesh()
        for expected in (0, 1, 2):
            finding = check_solidity(mesh.vert_properties, mesh.tri_verts, genus=expected)["genus"]
            assert (finding.measured, finding.limit) == (genus, expected)
            assert finding.status == ("pass" if genus == expected else "fail")


def _turned(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    turned = solid.copy()
    turned.invert()
    return turned


def _hollows(count: int) -> list[trimesh.Trimesh]:
    """A long box and hollows in a row within it."""
    return [block(120, 2, 2), *(_turned(block(0.5, 0.5, 0.5, at=(n - count / 2, 0, 0))) for n in range(count))]


@pytest.mark.parametrize(
    ("meshes", "status", "count", "position"),
    [
        ([TestSolid.box, block(2, 2, 2, at=(30, 7, 0))], "fail", 2, (30, 7)),
        ([TestSolid.box, _turned(block(2, 2, 2, at=(30, 7, 0)))], "fail", 2, (30, 7)),
        ([TestSolid.box, block(2, 2, 2)], "fail", 2, (0, 0)),  # one within the other
        ([TestSolid.box, _turned(block(2, 2, 2))], "warn", 1, (0, 0)),  # a hollow
        (_hollows(99), "warn", 1, None),
        (_hollows(100), "fail", 101, None),  # of more than a hundred shells all are bodies
    ],
)
def test_bodies_distinguishes_bodies_and_hollows(meshes, status, count, position):
    findings = check_solidity(*together(*meshes))
    assert (findings["bodies"].status, findings["bodies"].measured) == (status, count)
    assert position is None or has_position_near(findings["bodies"], *position, within=1.5)
    assert set(failures(findings)) == {"bodies"}


def _star() -> trimesh.Trimesh:
    """A prism over a pentagram, one shell that winds twice around its middle."""
    turns, n = 4 * np.pi * np.arange(5) / 5, np.arange(5)
    ring = 5 * np.column_stack([np.cos(turns), np.sin(turns)])
    layers = [np.column_stack([np.vstack([ring, [[0, 0]]]), np.full(6, z)]) for z in (0, 4)]
    after = np.roll(n, -1)
    sides = [np.column_stack(columns) for columns in ((n, after, after + 6), (n, after + 6, n + 6))]
    caps = [np.column_stack([after, n, 0 * n + 5]), np.column_stack([n + 6, after + 6, 0 * n + 11])]
    return trimesh.Trimesh(np.vstack(layers), np.vstack([*sides, *caps]), process=False)


@pytest.mark.parametrize(
    ("mesh", "status", "position"),
    [
        ([block(10, 10, 10), block(10, 10, 10, at=(9, 1, 2))], "fail", (4.5, 0.5)),
        ([block(10, 10, 10), block(10, 10, 10, at=(5, 0, 0))], "fail", (2.5, 0)),  # their sides coincide
        ([block(10, 10, 10), block(10, 10, 10, at=(20, 0, 0))], "pass", None),
        (_hollows(2), "pass", None),
        ([block(10, 10, 10), _turned(block(2, 2, 2, at=(30, 7, 0)))], "fail", (30, 7)),
        ([_star()], "fail", (0, 0)),
        ([trimesh.creation.torus(3, 2)], "pass", None),
    ],
)
def test_self_intersection_of_bodies_and_shells(mesh, status, position):
    vertices, triangles = together(*mesh)
    finding = {f.name: f for f in check_triangles(vertices.astype(np.float32), triangles)}["self_intersection"]
    assert finding.status == status
    assert position is None or has_position_near(finding, *position, within=5)
    assert finding.measured == len(finding.positions_mm)


@pytest.fixture(scope="module")
def mould() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of the mould of a straight pad."""
    return mesh_arrays(build_mesh(mould_body(Plan(Morphology.straight(2)))))


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (1 / 25.4, "inches")])
def test_mesh_in_another_unit_has_one_finding_that_says_so(mould, scale, unit):
    [finding] = check_triangles(scale * mould[0], mould[1])
    assert (finding.name, finding.status) == ("unit", "fail")
    assert f"in {unit} it would be 42.2 mm" in finding.message


@pytest.mark.parametrize(
    ("axes", "signs", "side"),
    [
        ((0, 1, 2), (1, -1, -1), "down"),
        ((2, 1, 0), (-1, 1, 1), "to the left"),
        ((2, 1, 0), (1, 1, -1), "to the right"),
        ((0, 2, 1), (1, -1, 1), "to the near side"),
        ((0, 2, 1), (1, 1, -1), "to the far side"),
    ],
)
def test_mould_that_is_turned_fails_and_is_judged_no_further(mould, axes, signs, side):
    findings = {finding.name: finding for finding in check_triangles(mould[0][:, axes] * signs, mould[1])}
    assert findings["pose"].status == "fail"
    assert findings["pose"].message == f"it lies with its open side {side}: turn it up"
    assert not findings.keys() & {"wall_thickness", "silicone_wall", "tight"}


def _leak(width: float, end: float = 14) -> Manifold:
    return prism(line((9, 2), (end, 2), width=width), 2.0, 9.0)


def _hole(side: float, x: float = 0, y: float = 0) -> Manifold:
    return Manifold.cube((side, side, 5), True).translate((x, y, 0))


def _bore() -> Manifold:
    return Manifold.cylinder(8, 0.6).rotate((0, 90, 0)).translate((8, 0, 5))


def _pot(outer: float) -> Manifold:
    plate = Manifold.cube((outer, outer, 2.0), True).translate((0, 0, 1))
    return Manifold.batch_boolean([tray(draft_deg=0), plate], OpType.Add) - _hole(2, 3, 3)


def _slot_of_a_foot(low: float, high: float) -> Manifold:
    foot = prism(shapely.box(-9, -9, 9, 9).difference(shapely.box(-7, -7, 7, 7)), -0.5, 0.1)
    slot = prism(line((6, 2), (14, 2), width=3.0), low, high)
    return Manifold.batch_boolean([tray(draft_deg=0), foot], OpType.Add) - slot


def _on_a_foot(foot: float) -> Manifold:
    """A block whose foot is set back by a millimetre."""
    low = Manifold.cube((8, 8, foot + 0.5), True).translate((0, 0, (foot + 0.5) / 2))
    return Manifold.batch_boolean([Manifold.cube((10, 10, 4), True).translate((0, 0, 2 + foot)), low], OpType.Add)


def _narrow(height: float) -> Manifold:
    """A tray with a ridge of half the width of a line, and as high as so many layers of 0.2 mm."""
    return tray(ridge(spanning(0.0, width=0.5 * PrinterSettings().line_mm), height * 0.2))


STATUSES = [
    *(
        ("bed", lambda: TestSolid.box, {"bed_mm": bed}, status, None)
        for bed, status in (
            ([20.0, 10.0, 5.0], "pass"),
            ([20.0, 10.0, 4.99], "fail"),
            ([30.0, 10.0, 5.0], "pass"),
            ([30.0, 8.0, 20.0], "fail"),  # it would have to stand on its side
        )
    ),
    ("ridge_width", lambda: tray(*CROSS), {"nozzle_mm": 0.25, "resin": True}, "fail", None),
    ("ridge_width", lambda: tray(*CROSS), {"nozzle_mm": 0.25}, "pass", None),
    ("ridge_width", lambda: _narrow(0.4), {"layer_mm": 0.2}, "pass", None),  # too low to be printed
    ("ridge_width", lambda: _narrow(0.6), {"layer_mm": 0.2}, "fail", None),
    ("silicone_wall", lambda: tray(*CROSS, ridge(spanning(3.7), 0.55)), {}, "pass", None),  # of a similar height
    ("silicone_wall", lambda: tray(*CROSS, ridge(spanning(3.7), 0.65)), {}, "warn", None),
    ("overhang", lambda: _on_a_foot(0.05), {"layer_mm": 0.1}, "pass", None),  # half of the first layer
    ("overhang", lambda: _on_a_foot(0.2), {"layer_mm": 0.1}, "fail", None),
    ("tight", lambda: tray(*CROSS) - _leak(1.0), {}, "fail", (11, 2)),
    ("tight", lambda: tray() - _leak(10.5), {}, "pass", None),  # wider than a centimetre, it is the shape of the part
    ("tight", lambda: tray(*CROSS) - _bore(), {}, "fail", None),
    ("tight", lambda: tray() - _hole(0.12, -6, 6), {}, "fail", (-6, 6)),
    ("tight", lambda: tray(draft_deg=0) - _hole(14.8), {}, "pass", None),  # less than half a floor of 20 mm is no tray
    ("tight", lambda: _pot(38.0), {}, "fail", (3, 3)),
    ("tight", lambda: _pot(42.0), {}, "pass", None),  # a hollow of less than a quarter of the outline is a hole
    ("tight", lambda: tray(*CROSS) - _leak(3.0, end=11), {}, "pass", None),  # leads nowhere
    # what the lowest slab surrounds is below the floor; the same slot in the wall above it is a leak
    ("tight", lambda: _slot_of_a_foot(-1.0, 0.0), {}, "pass", None),
    ("tight", lambda: _slot_of_a_foot(FLOOR, FLOOR + 0.5), {}, "fail", None),
]


@pytest.mark.parametrize(("name", "make", "printer", "status", "position"), STATUSES)
def test_status_of_solids_and_printers(name, make, printer, status, position):
    finding = check_body(make(), printer=PrinterSettings.model_validate(printer))[name]
    assert finding.status == status
    assert position is None or has_position_near(finding, *position, within=2.5)


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
