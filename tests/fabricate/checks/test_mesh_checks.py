"""Solid checks and leaks on meshes with a known fault, and widths of areas."""

import numpy as np
import pytest
import shapely
import trimesh
from manifold3d import Manifold, OpType

from padforge.design.morphology import Morphology
from padforge.fabricate.checks import Finding
from padforge.fabricate.checks.mesh_checks import SOLID_CHECKS, check_solid, check_triangles
from padforge.fabricate.checks.surface import TriangleMesh
from padforge.fabricate.mesh import build_mesh, mesh_arrays
from padforge.fabricate.mould import mould_body
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import PrinterSettings
from tests.fabricate.checks.trays import CROSS, FLOOR, block, check_body, failures, has_position_near, line, prism, tray


def check_solidity(vertices: np.ndarray, triangles: np.ndarray, genus: int | None = None) -> dict[str, Finding]:
    return {f.name: f for f in check_solid(TriangleMesh.weld(vertices, triangles), genus)}


class TestSolid:
    box = block(10, 20, 5)

    def test_missing_triangle_is_not_watertight(self):
        findings = check_body(trimesh.Trimesh(self.box.vertices, self.box.faces[1:]))
        assert findings["manifold"].status == findings["watertight"].status == "fail"
        assert findings["watertight"].measured == len(findings["watertight"].positions_mm) == 3
        assert "ridge_width" not in findings

    def test_edge_of_four_faces_is_not_watertight(self):
        watertight = check_solidity(*_together(self.box, block(10, 20, 5, at=(10, 20, 0))))["watertight"]
        assert (watertight.status, watertight.measured) == ("fail", 1)
        assert has_position_near(watertight, 5, 10, 1e-6)

    def test_flipped_triangle_is_not_watertight(self):
        faces = np.array(self.box.faces)
        faces[0] = faces[0][::-1]
        watertight = check_body(trimesh.Trimesh(self.box.vertices, faces))["watertight"]
        assert (watertight.status, watertight.measured) == ("fail", 3)
        middle = self.box.triangles_center[0]
        assert has_position_near(watertight, middle[0], middle[1], 8.0)

    def test_inverted_box_has_no_volume(self):
        mesh = self.box.copy()
        mesh.invert()
        assert failures(check_body(mesh)) == {"volume": "fail"}

    def test_empty_mesh_fails(self):
        findings = check_triangles(np.empty((0, 3)), np.empty((0, 3), dtype=int))
        assert {f.name for f in findings if f.status == "fail"} >= {"bodies", "volume"}

    def test_check_solid_merges_equal_vertices(self):
        mesh = tray(*CROSS).to_mesh()
        corners = np.asarray(mesh.vert_properties)[np.asarray(mesh.tri_verts)][::-1].reshape(-1, 3)
        findings = check_solidity(corners, np.arange(len(corners)).reshape(-1, 3), genus=0)
        assert list(findings) == list(SOLID_CHECKS)
        assert not failures(findings)

    @pytest.mark.parametrize(
        ("bed", "status"),
        [
            ([20.0, 10.0, 5.0], "pass"),
            ([20.0, 10.0, 4.99], "fail"),
            ([30.0, 10.0, 5.0], "pass"),
            ([30.0, 8.0, 20.0], "fail"),  # it would have to stand on its side
        ],
    )
    def test_bed(self, bed, status):
        assert check_body(self.box, printer=PrinterSettings(bed_mm=bed))["bed"].status == status

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


def _together(*meshes: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    corners = np.concatenate([mesh.triangles for mesh in meshes]).reshape(-1, 3)
    return corners, np.arange(len(corners)).reshape(-1, 3)


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
    findings = check_solidity(*_together(*meshes))
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
    vertices, triangles = _together(*mesh)
    finding = {f.name: f for f in check_triangles(vertices.astype(np.float32), triangles)}["self_intersection"]
    assert finding.status == status
    assert position is None or has_position_near(finding, *position, within=5)
    assert finding.measured == len(finding.positions_mm)


def _leak(width: float) -> Manifold:
    return prism(line((9, 2), (14, 2), width=width), 2.0, 9.0)


def _hole(side: float, x: float = 0, y: float = 0) -> Manifold:
    return Manifold.cube((side, side, 5), True).translate((x, y, 0))


def _pot(outer: float) -> Manifold:
    plate = Manifold.cube((outer, outer, 2.0), True).translate((0, 0, 1))
    return Manifold.batch_boolean([tray(draft_deg=0), plate], OpType.Add) - _hole(2, 3, 3)


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (1 / 25.4, "inches")])
def test_mesh_in_another_unit_has_one_finding_that_says_so(scale, unit):
    vertices, triangles = mesh_arrays(build_mesh(mould_body(Plan(Morphology.straight(2)))))
    [finding] = check_triangles(scale * vertices, triangles)
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
def test_mould_that_is_turned_fails_and_is_judged_no_further(axes, signs, side):
    vertices, triangles = mesh_arrays(build_mesh(mould_body(Plan(Morphology.straight(2)))))
    findings = {finding.name: finding for finding in check_triangles(vertices[:, axes] * signs, triangles)}
    assert findings["pose"].status == "fail"
    assert findings["pose"].message == f"it lies with its open side {side}: turn it up"
    assert not findings.keys() & {"wall_thickness", "silicone_wall", "tight"}


class TestLeaks:
    @pytest.mark.parametrize(
        ("solid", "status", "position"),
        [
            (lambda: tray(*CROSS) - _leak(1.0), "fail", (11, 2)),
            (lambda: tray() - _leak(10.5), "pass", None),  # wider than a centimetre, it is the shape of the part
            (lambda: tray(*CROSS) - Manifold.cylinder(8, 0.6).rotate((0, 90, 0)).translate((8, 0, 5)), "fail", None),
            (lambda: tray() - _hole(0.12, -6, 6), "fail", (-6, 6)),
            (lambda: tray(draft_deg=0) - _hole(14.8), "pass", None),  # less than half a floor of 20 mm is no tray
            (lambda: _pot(38.0), "fail", (3, 3)),
            (lambda: _pot(42.0), "pass", None),  # a hollow of less than a quarter of the outline is a hole
            (lambda: tray(*CROSS) - prism(line((9, 2), (11, 2), width=3.0), 2.0, 9.0), "pass", None),  # leads nowhere
        ],
    )
    def test_leaks(self, solid, status, position):
        finding = check_body(solid())["tight"]
        assert finding.status == status
        assert position is None or has_position_near(finding, *position, within=2.5)

    def test_slot_in_the_foot_is_no_leak(self):
        """What the lowest slab surrounds is below the floor; the same slot in the wall above it is a leak."""
        foot = prism(shapely.box(-9, -9, 9, 9).difference(shapely.box(-7, -7, 7, 7)), -0.5, 0.1)
        for low, high, status in ((-1.0, 0.0, "pass"), (FLOOR, FLOOR + 0.5, "fail")):
            slot = prism(line((6, 2), (14, 2), width=3.0), low, high)
            solid = Manifold.batch_boolean([tray(draft_deg=0), foot], OpType.Add) - slot
            assert check_body(solid)["tight"].status == status
