"""Trays and blocks as triangle meshes, built without a plan, and their findings."""

import math
from collections.abc import Iterable

import numpy as np
import shapely
import trimesh
from manifold3d import CrossSection, Manifold, OpType
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.checks import Finding
from padforge.fabricate.checks.mesh_checks import check_triangles
from padforge.fabricate.plan import polygon_rings

FLOOR, DEPTH, WALL, SIZE = 2.0, 6.0, 2.0, 20.0
"""Floor, depth and walls of the trays here, and the width of what they hold, mm."""


def line(*points: tuple[float, float], width: float = 0.4) -> BaseGeometry:
    return shapely.LineString(points).buffer(width / 2, cap_style="flat")


def prism(area: BaseGeometry, bottom: float, top: float) -> Manifold:
    rings = [ring for polygon in polygon_rings(area) for ring in polygon]
    return Manifold.extrude(CrossSection(rings), top - bottom).translate((0, 0, bottom))


def ridge(area: BaseGeometry, height: float = 0.4) -> Manifold:
    return prism(area, FLOOR - 0.2, FLOOR + height)


def tray(*adds: Manifold, draft_deg: float = 2.0, wall: float = WALL, floor: float = FLOOR) -> Manifold:
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


def together(*meshes: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Corners and triangles of several meshes as of one."""
    corners = np.concatenate([mesh.triangles for mesh in meshes]).reshape(-1, 3)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def check_body(solid: Manifold | trimesh.Trimesh, **arguments: object) -> dict[str, Finding]:
    if isinstance(solid, trimesh.Trimesh):
        vertices, triangles = solid.vertices, solid.faces
    else:
        mesh = solid.to_mesh()
        vertices, triangles = mesh.vert_properties, mesh.tri_verts
    return {finding.name: finding for finding in check_triangles(vertices, triangles, **arguments)}  # pyright: ignore


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
