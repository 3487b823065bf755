"""What the checks find on sound trays and blocks and on ones with a known fault, by the title of each."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import shapely
import trimesh
from manifold3d import CrossSection, Manifold, OpType
from shapely.geometry.base import BaseGeometry

from padforge.design.morphology import Morphology
from padforge.fabricate import Finding, PrinterSettings
from padforge.fabricate.checks.mesh_checks import check_triangles
from padforge.fabricate.mesh import mesh_arrays, mould_mesh
from padforge.fabricate.plan import Plan, polygon_rings

FLOOR, DEPTH, SIZE = 2.0, 6.0, 20.0
"""Floor and depth of the trays here, and the width of what they hold, mm."""


def line(*points: tuple[float, float], width: float = 0.4) -> BaseGeometry:
    return shapely.LineString(points).buffer(width / 2, cap_style="flat")


def prism(area: BaseGeometry, bottom: float, top: float) -> Manifold:
    rings = [ring for polygon in polygon_rings(area) for ring in polygon]
    return Manifold.extrude(CrossSection(rings), top - bottom).translate((0, 0, bottom))


def ridge(area: BaseGeometry, height: float = 0.4) -> Manifold:
    return prism(area, FLOOR - 0.2, FLOOR + height)


def tray(*adds: Manifold, draft_deg: float = 2.0, wall: float = 2.0, floor: float = FLOOR) -> Manifold:
    """A square tray; its walls lean outwards, or inwards for less than 0, and are as thick as said at the rim."""
    deep = DEPTH + FLOOR - floor
    flare = 1 + 2 * deep * math.tan(math.radians(draft_deg)) / SIZE
    outer = SIZE * max(flare, 1.0) + 2 * wall
    box = Manifold.cube((outer, outer, FLOOR + DEPTH), True).translate((0, 0, (FLOOR + DEPTH) / 2))
    cavity = Manifold.extrude(CrossSection.square((SIZE, SIZE), True), deep, scale_top=(flare, flare))
    above = Manifold.cube((SIZE * flare, SIZE * flare, 1), True).translate((0, 0, FLOOR + DEPTH))
    hollow = Manifold.batch_boolean([cavity.translate((0, 0, floor)), above], OpType.Add)
    return Manifold.batch_boolean([box - hollow, *adds], OpType.Add)


def spanning(y: float, width: float = 0.4) -> BaseGeometry:
    return line((-SIZE / 2 - 0.5, y), (SIZE / 2 + 0.5, y), width=width)


def block(*sizes: float, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(sizes, trimesh.transformations.translation_matrix(at))


def finding_lines(findings: Iterable[Finding], passed: bool = False) -> list[str]:
    """A line for each finding; those that pass only if they are asked for."""
    lines = []
    for finding in findings:
        if passed or finding.status != "pass":
            values = f"{finding.measured} / {finding.limit}"
            places = "".join(f" ({x:z.1f}, {y:z.1f})" for x, y in finding.positions_mm[:4])
            more = f" and {len(finding.positions_mm) - 4} more" if len(finding.positions_mm) > 4 else ""
            lines.append(f"  {finding.status} {finding.name} {values}: {finding.message};{places}{more}")
    return lines


CROSS = [ridge(spanning(3.0), 1.2), ridge(spanning(-3.0), 1.2), ridge(shapely.affinity.rotate(spanning(1), 90, (0, 0)))]


def cube(x: float, y: float, z: float, at: tuple[float, float, float] = (0, 0, 0)) -> Manifold:
    return Manifold.cube((x, y, z), True).translate(at)


def meshes(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    corners = np.concatenate([part.triangles for part in parts]).reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def turned(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    inside_out = solid.copy()
    inside_out.invert()
    return inside_out


def flipped(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    faces = np.array(solid.faces)
    faces[0] = faces[0][::-1]
    return trimesh.Trimesh(solid.vertices, faces, process=False)


def hollows(count: int) -> trimesh.Trimesh:
    inside = [turned(block(0.5, 0.5, 0.5, at=(n - count / 2, 0, 0))) for n in range(count)]
    return meshes(block(120, 2, 2), *inside)


def star() -> trimesh.Trimesh:
    turns, n = 4 * np.pi * np.arange(5) / 5, np.arange(5)
    ring = 5 * np.column_stack([np.cos(turns), np.sin(turns)])
    layers = [np.column_stack([np.vstack([ring, [[0, 0]]]), np.full(6, z)]) for z in (0, 4)]
    after = np.roll(n, -1)
    sides = [np.column_stack(columns) for columns in ((n, after, after + 6), (n, after + 6, n + 6))]
    caps = [np.column_stack([after, n, 0 * n + 5]), np.column_stack([n + 6, after + 6, 0 * n + 11])]
    return trimesh.Trimesh(np.vstack(layers), np.vstack([*sides, *caps]), process=False)


def mould(factor: float = 1.0, axes: tuple[int, ...] = (0, 1, 2), signs: tuple[int, ...] = (1, 1, 1)) -> Any:
    """The mould of a straight pad, enlarged and turned."""
    vertices, triangles = mesh_arrays(mould_mesh(Plan(Morphology.straight(2))))
    return trimesh.Trimesh(factor * vertices[:, axes] * signs, triangles, process=False)


def plate(n_holes: int) -> Manifold:
    holes = [Manifold.cylinder(9, 2.0, 2.0, 24).translate((x, 0, -1)) for x in (-6, 6)[:n_holes]]
    return prism(shapely.box(-12, -5, 12, 5), 0, 3) - Manifold.compose(holes)


def lid() -> Manifold:
    holes = [shapely.Point(x, y).buffer(0.75) for x in (-8, 8) for y in (-8, 8)]
    return prism(shapely.box(-12, -12, 12, 12).difference(shapely.union_all(holes)), 0, 3)


def crossing(angle_deg: float) -> Manifold:
    both = shapely.union(spanning(0.5), shapely.affinity.rotate(spanning(0.5), angle_deg, (0, 0.5)))
    return tray(ridge(both & shapely.box(-10.5, -10.5, 10.5, 10.5)))


def bends() -> Manifold:
    turns = [(6 * math.cos(t), 6 * math.sin(t)) for t in np.linspace(0, 4, 200)]
    eight = [line((-1, -2), (1, -2), (1, 2), (-1, 2), (-1, -2)), line((-1, 0), (1, 0)), line((-1, 1.9), (-1, 2.2))]
    slot = Manifold.cube((2, 1.5, DEPTH + 1)).translate((-1, SIZE / 2 - 0.5, FLOOR))
    return tray(ridge(line(*turns), 1.2), ridge(shapely.union_all(eight)), wall=3.0) - slot


def beside(gap: float) -> Manifold:
    """A tray with two pairs of ridges, of the taller and of the lower height, a gap apart."""
    return tray(*CROSS, ridge(spanning(3.4 + gap), 1.2), ridge(spanning(-7)), ridge(spanning(-6.6 + gap)))


def thin_wall(wall: float) -> Manifold:
    return tray(*CROSS, draft_deg=0) - cube(5, 40, 20, at=(SIZE / 2 + wall + 2.5, 0, 5))


def leaning_wall() -> Manifold:
    """A wall 0.5 mm thick at the rim, and thicker by half a millimetre a millimetre below it."""
    side, top, over = 20.0, FLOOR + DEPTH, 1.0
    flare = 1 + (DEPTH + over) / side
    hollow = Manifold.extrude(CrossSection.square((side, side), True), DEPTH + over, scale_top=(flare, flare))
    outer = side + DEPTH + 2 * 0.5
    return cube(outer, outer, top, at=(0, 0, top / 2)) - hollow.translate((0, 0, FLOOR))


def gable(lean_deg: float) -> Manifold:
    """A groove from below, with a roof that leans to either side and leaves 0.3 mm of floor over its ridge."""
    fall = 3 * math.tan(math.radians(lean_deg))
    roof = shapely.Polygon([(-3, -1), (3, -1), (3, 1.7 - fall), (0, 1.7), (-3, 1.7 - fall)])
    return tray(*CROSS) - prism(roof, -4, 4).rotate((90, 0, 0))


def head() -> Manifold:
    return tray(*CROSS, ridge(line((2, -6), (7, -6)), 1.2), prism(line((2, -6), (7, -6), width=1.5), 2.8, 3.2))


def funnel(lean_deg: float) -> Manifold:
    top = 4 + 4 * math.tan(math.radians(lean_deg))
    cup = Manifold.cylinder(4, 4, top, 64) - Manifold.cylinder(5, 2, 2, 64).translate((0, 0, -0.5))
    return cube(24, 24, 3, at=(0, 0, -1.4)) - Manifold.cylinder(9, 2, 2, 64).translate((0, 0, -5)) + cup


def leak(width: float, end: float = 14) -> Manifold:
    return prism(line((9, 2), (end, 2), width=width), 2.0, 9.0)


def hole(side: float, x: float = 0, y: float = 0) -> Manifold:
    return cube(side, side, 5, at=(x, y, 0))


def pot(outer: float) -> Manifold:
    return tray(draft_deg=0) + cube(outer, outer, 2.0, at=(0, 0, 1)) - hole(2, 3, 3)


def slot_of_a_foot(low: float, high: float) -> Manifold:
    foot = prism(shapely.box(-9, -9, 9, 9).difference(shapely.box(-7, -7, 7, 7)), -0.5, 0.1)
    slot = prism(line((6, 2), (14, 2), width=3.0), low, high)
    return tray(draft_deg=0) + foot - slot


def on_a_foot(foot: float) -> Manifold:
    return cube(10, 10, 4, at=(0, 0, 2 + foot)) + cube(8, 8, foot + 0.5, at=(0, 0, (foot + 0.5) / 2))


def narrow(layers: float) -> Manifold:
    return tray(ridge(spanning(0.0, width=0.2), layers * 0.2))


BOX = block(10, 20, 5)
FINE, RESIN = {"nozzle_mm": 0.25}, {"nozzle_mm": 0.2, "resin": True}
CASES: dict[str, tuple[Callable[[], Any], dict[str, Any]] | Callable[[], Any]] = {
    "tray": (lambda: tray(*CROSS), {"genus": 0}),
    "box, never stated smaller than it is": (lambda: block(10.002, 20.01, 5), {"genus": 0}),
    "open box": (lambda: trimesh.Trimesh(BOX.vertices, BOX.faces[1:]), {"genus": 0}),
    "box with a face turned over": lambda: flipped(BOX),
    "two boxes with a common edge": lambda: meshes(BOX, block(10, 20, 5, at=(10, 20, 0))),
    "box inside out": lambda: turned(BOX),
    "two boxes": lambda: meshes(BOX, block(2, 2, 2, at=(30, 7, 0))),
    "box and a hollow beside it": lambda: meshes(BOX, turned(block(2, 2, 2, at=(30, 7, 0)))),
    "box in a box": lambda: meshes(BOX, block(2, 2, 2)),
    "box with a hollow": lambda: meshes(BOX, turned(block(2, 2, 2))),
    "99 hollows": lambda: hollows(99),
    "100 hollows, with so many shells all are bodies": lambda: hollows(100),
    "boxes that overlap": lambda: meshes(block(10, 10, 10), block(10, 10, 10, at=(9, 1, 2))),
    "boxes that overlap, with sides in common": lambda: meshes(block(10, 10, 10), block(10, 10, 10, at=(5, 0, 0))),
    "star that winds twice around its middle": star,
    "torus, with no flat face": (lambda: trimesh.creation.torus(10, 2), {"genus": 1}),
    "plate with no hole of 1": (lambda: plate(0), {"genus": 1}),
    "plate with 2 holes of 2": (lambda: plate(2), {"genus": 2}),
    "plate with 2 holes of 1": (lambda: plate(2), {"genus": 1}),
    "lid with 4 holes": (lid, {"genus": 4}),
    "box of less than a layer": lambda: block(10, 10, 0.03),
    "large": lambda: block(300, 20, 5),
    "bed of its size, turned": (lambda: BOX, {"printer": {"bed_mm": [20.0, 10.0, 5.0]}}),
    "bed 0.01 mm too low": (lambda: BOX, {"printer": {"bed_mm": [20.0, 10.0, 4.99]}}),
    "bed on which it would have to stand on its side": (lambda: BOX, {"printer": {"bed_mm": [30.0, 8.0, 20.0]}}),
    "small": lambda: block(0.3, 0.2, 0.05),
    "mould in metres": lambda: mould(1e-3),
    "mould in inches": lambda: mould(1 / 25.4),
    "mould turned down": lambda: mould(1, (0, 1, 2), (1, -1, -1)),
    "mould turned to the left": lambda: mould(1, (2, 1, 0), (-1, 1, 1)),
    "mould turned to the right": lambda: mould(1, (2, 1, 0), (1, 1, -1)),
    "mould turned to the near side": lambda: mould(1, (0, 2, 1), (1, -1, 1)),
    "mould turned to the far side": lambda: mould(1, (0, 2, 1), (1, 1, -1)),
    "tray with bends, an 8 and a slot": bends,
    "ridge 0.36 mm wide": lambda: tray(*CROSS, ridge(line((2, -6), (7, -5), width=0.36), 0.8)),
    "ridge 0.39 mm wide": lambda: tray(*CROSS, ridge(line((2, -6), (7, -5), width=0.39), 0.8)),
    "ridges of 0.4 mm, pixels of 0.25 mm": (lambda: tray(*CROSS), {"printer": FINE | {"resin": True}}),
    "ridges of 0.4 mm, a nozzle of 0.25 mm": (lambda: tray(*CROSS), {"printer": FINE}),
    "narrow ridge too low to be printed": (lambda: narrow(0.4), {"printer": {"layer_mm": 0.2}}),
    "narrow ridge that is printed": (lambda: narrow(0.6), {"printer": {"layer_mm": 0.2}}),
    "silicone of 0.09 mm": lambda: beside(0.09),
    "silicone of 0.12 mm": lambda: beside(0.12),
    "silicone of 0.12 mm, of which 0.08 are enough": (lambda: beside(0.12), {"min_silicone_mm": 0.08}),
    "silicone of 0.4 mm": lambda: beside(0.4),
    "silicone of 0.3 mm between ridges of similar height": lambda: tray(*CROSS, ridge(spanning(3.7), 0.65)),
    "silicone of 0.3 mm between ridges of two heights": lambda: tray(*CROSS, ridge(spanning(3.7), 0.55)),
    "crossing of 30 degrees": lambda: crossing(30),
    "crossing of 10 degrees": lambda: crossing(10),
    "wall of 0.3 mm": lambda: thin_wall(0.3),
    "wall of 0.6 mm": lambda: thin_wall(0.6),
    "wall of 0.3 mm, pixels of 0.2 mm": (lambda: thin_wall(0.3), {"printer": RESIN}),
    "wall of 0.6 mm, pixels of 0.2 mm": (lambda: thin_wall(0.6), {"printer": RESIN}),
    "wall of 0.9 mm, pixels of 0.2 mm": (lambda: thin_wall(0.9), {"printer": RESIN}),
    "wall that is 0.6 mm thick below a layer of 0.4 mm": (leaning_wall, {"printer": {"layer_mm": 0.4}}),
    "floor of 0.37 mm": lambda: tray(floor=0.37),
    "floor of 0.55 mm, layers of 0.3 mm": (lambda: tray(floor=0.55), {"printer": {"layer_mm": 0.3}}),
    "floor of 0.59 mm, layers of 0.3 mm": (lambda: tray(floor=0.59), {"printer": {"layer_mm": 0.3}}),
    "floor of 0.3 mm over a gable of 8 degrees": lambda: gable(8),
    "floor over a gable of 12 degrees, which is no floor": lambda: gable(12),
    "ridge with a head": head,
    "walls that lean inwards by 0.05 degrees": lambda: tray(*CROSS, draft_deg=-0.05),
    "walls that lean inwards by 3 degrees": lambda: tray(*CROSS, draft_deg=-3),
    "funnel of 45.8 degrees": lambda: funnel(45.8),
    "funnel of 46.3 degrees": lambda: funnel(46.3),
    "foot of half a layer": lambda: on_a_foot(0.05),
    "foot of two layers": lambda: on_a_foot(0.2),
    "slot in the wall": lambda: tray(*CROSS) - leak(1.0),
    "slot in the wall that leads nowhere": lambda: tray(*CROSS) - leak(3.0, end=11),
    "opening of more than a centimetre, which is a shape": lambda: tray() - leak(10.5),
    "bore in the wall": lambda: tray(*CROSS) - Manifold.cylinder(8, 0.6).rotate((0, 90, 0)).translate((8, 0, 5)),
    "hole in the floor": lambda: tray() - hole(0.12, -6, 6),
    "hole of more than half of the floor, which is no tray": lambda: tray(draft_deg=0) - hole(14.8),
    "pot of more than a quarter of its outline": lambda: pot(38.0),
    "pot of less than a quarter of its outline": lambda: pot(42.0),
    "slot in the foot, below the floor": lambda: slot_of_a_foot(-1.0, 0.0),
    "slot in the wall above the foot": lambda: slot_of_a_foot(FLOOR, FLOOR + 0.5),
}
WITH_PASSED = ("tray", "box, never stated smaller than it is", "lid with 4 holes")
"""Those of which the checks that pass are written, too."""


def test_findings_of_meshes(golden):
    lines = []
    for title, case in CASES.items():
        make, options = case if isinstance(case, tuple) else (case, {})
        printer: Any = PrinterSettings.model_validate(options.get("printer", {}))
        body = make()
        if isinstance(body, Manifold):
            mesh = body.to_mesh()
            body = trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts, process=False)
        findings = check_triangles(body.vertices, body.faces, **options | {"printer": printer})
        lines += [title, *finding_lines(findings, passed=title in WITH_PASSED)]
    golden("fabricate/findings_of_meshes.txt", "\n".join(lines))
