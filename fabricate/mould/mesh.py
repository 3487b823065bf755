"""Triangle meshes of bodies, by manifold3d: extruded outlines, joined. Importing this module loads manifold3d."""

from collections.abc import Iterable

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from numpy.typing import NDArray

from .plan import polygon_rings
from .prisms import Body, Prism

APART_MM = 1e-4
"""How far vertices that coincide by chance are moved apart: far below what prints, far above a float's step."""


def mesh(body: Body) -> Manifold:
    """The mesh of a body, mm."""
    solid = _joined(body.base)
    if body.cuts:
        solid -= _joined(body.cuts)
    return Manifold.batch_boolean([solid, *map(_prism, body.adds)], OpType.Add)


def arrays(solid: Manifold) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices (n, 3) mm, in the precision of an STL, and triangles (m, 3) vertex numbers.

    No two vertices are equal. Where the solid touches itself in a point or an upright line, which happens by chance
    among thousands of dense outlines, or in that precision, its corners are drawn back by `APART_MM`: whoever joins
    equal vertices when reading the file still finds two faces at every edge.
    """
    parts = solid.to_mesh()
    vertices, triangles = np.array(parts.vert_properties), np.asarray(parts.tri_verts)
    away = APART_MM
    while len(touching := _not_unique(vertices)):
        vertices[touching] -= (away * _normals(vertices, triangles)[touching]).astype(np.float32)
        away *= 1.5
    return vertices, triangles


def _not_unique(vertices: NDArray[np.float32]) -> NDArray[np.intp]:
    """Numbers of the vertices that equal another one."""
    _, which, count = np.unique(vertices, axis=0, return_inverse=True, return_counts=True)
    return np.flatnonzero(count[which.ravel()] > 1)


def _normals(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> NDArray[np.float64]:
    """(n, 3) outward direction at every vertex: the sum of the normals of its triangles."""
    corners = vertices[triangles].astype(np.float64)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), np.finfo(float).tiny)
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    return normals


def _joined(prisms: Iterable[Prism]) -> Manifold:
    return Manifold.batch_boolean([*map(_prism, prisms)], OpType.Add)


def _prism(prism: Prism) -> Manifold:
    rings = [ring for polygon in polygon_rings(prism.area) for ring in polygon]
    height = prism.top_mm - prism.bottom_mm
    if not prism.flare_mm:
        return Manifold.extrude(CrossSection(rings), height).translate((0, 0, prism.bottom_mm))
    low, high = np.reshape(prism.area.bounds, (2, 2))
    middle, grown = (low + high) / 2, 1 + 2 * prism.flare_mm / (high - low)
    rings = [ring - middle for ring in rings]
    solid = Manifold.extrude(CrossSection(rings), height, scale_top=(float(grown[0]), float(grown[1])))
    return solid.translate((float(middle[0]), float(middle[1]), prism.bottom_mm))
