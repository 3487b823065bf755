"""Triangle meshes with derived geometry, slabs of a solid, and narrow parts of cross sections; lengths are mm."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry

from padforge.design.morphology import Array
from padforge.fabricate.mesh import Numbers
from padforge.fabricate.plan import SNAP_MM, areas, overlap, without

FaceMask = NDArray[np.bool_]
Shapes = NDArray[np.object_]

_NEEDLE_MM = 1e-3  # the normal of a triangle of less height is unreliable because of rounding


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangle mesh; derived quantities are computed on first use."""

    vertices: Array  # all different; shape (n, 3), mm
    triangles: Numbers  # indices of three different vertices in each row; shape (m, 3)

    @classmethod
    def weld(cls, vertices: ArrayLike, triangles: ArrayLike) -> "TriangleMesh":
        """Build a mesh from vertices (n, 3), mm, and triangles (m, 3) of vertex indices.

        Equal vertices are merged, and triangles with two equal corners dropped.
        """
        points = np.asarray(vertices, np.float64) + 0.0  # turns -0 into 0
        unique, index = np.unique(points[:, ::-1], axis=0, return_inverse=True)  # ordered by z first
        corners = index.ravel()[np.asarray(triangles, np.int64)]
        return cls(unique[:, ::-1], corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)])

    @cached_property
    def corners(self) -> Array:
        """Corners of the triangles, (m, 3, 3) mm."""
        return self.vertices[self.triangles]

    @cached_property
    def centroids(self) -> Array:
        """Centroids of the triangles, (m, 3) mm."""
        return self.corners.mean(axis=1)

    @cached_property
    def _crosses(self) -> Array:
        return np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])

    @cached_property
    def areas(self) -> Array:
        """Areas of the triangles, (m,) mm²."""
        return np.linalg.norm(self._crosses, axis=1) / 2

    @cached_property
    def _longest_sides(self) -> Array:
        return np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)

    @cached_property
    def normal_z(self) -> Array:
        """z of the unit normals, (m,): 1 faces up, -1 down; 0 for needles, whose normals are unreliable."""
        valid = 2 * self.areas > _NEEDLE_MM * self._longest_sides
        return np.divide(self._crosses[:, 2], 2 * self.areas, out=np.zeros(len(valid)), where=valid)

    @cached_property
    def signed_volumes(self) -> Array:
        """Signed volumes (m,), mm³, of the tetrahedra to the centre of the bounds; a closed shell's is their sum."""
        return ((self.corners[:, 0] - self.bounds.sum(axis=0) / 2) * self._crosses).sum(axis=1) / 6

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of the triangles, (2, 3) mm; zeros without triangles."""
        points = self.corners.reshape(-1, 3) if len(self.triangles) else np.zeros((1, 3))
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @cached_property
    def half_edges(self) -> Numbers:
        """Vertex indices of the directed sides of the triangles, (3m, 2); side k belongs to triangle k // 3."""
        return np.stack([self.triangles, np.roll(self.triangles, -1, axis=1)], axis=2).reshape(-1, 2)

    @cached_property
    def edges(self) -> tuple[Numbers, Numbers]:
        """First half-edge of each edge, (e,), and the edge index of each half-edge, (3m,)."""
        keys = self.half_edges.min(axis=1) * len(self.vertices) + self.half_edges.max(axis=1)
        _, first, edge = np.unique(keys, return_index=True, return_inverse=True)
        return first, edge

    @cached_property
    def solid(self) -> Any:
        """The mesh as a manifold3d `Manifold`, which may be invalid (see its status)."""
        from manifold3d import Manifold, Mesh64

        return Manifold(Mesh64(np.ascontiguousarray(self.vertices), self.triangles.astype(np.uint64)))

    @cached_property
    def shells(self) -> Numbers:
        """Index of the shell of each triangle, (m,)."""
        return self.label_patches(np.ones(len(self.triangles), dtype=bool))

    def label_patches(self, mask: FaceMask) -> Numbers:
        """Label the triangles of `mask` (m,) by the patch, connected at edges, that they belong to; (k,), from 0."""
        faces = np.flatnonzero(mask)
        edges = self.edges[1].reshape(-1, 3)[faces].ravel()
        order = np.argsort(edges, kind="stable")
        shared = np.flatnonzero(edges[order[1:]] == edges[order[:-1]])
        pairs = order[shared] // 3, order[shared + 1] // 3
        graph = coo_array((np.ones(len(shared), dtype=np.int8), pairs), shape=(len(faces), len(faces)))
        return connected_components(graph, directed=False)[1].astype(np.int64)

    def patch_positions(self, mask: FaceMask) -> Array:
        """Return the centroid (k, 2), mm, of the largest triangle of each patch of the triangles of `mask` (m,)."""
        faces, labels = np.flatnonzero(mask), self.label_patches(mask)
        order = np.lexsort((-self.areas[faces], labels))
        _, first = np.unique(labels[order], return_index=True)
        return self.centroids[faces[order[first]], :2]

    def cut(self, z: float) -> Array:
        """Cut the triangles at height `z`, mm: directed segments (k, 2, 2), mm, with the solid on their left."""
        above = self.corners[:, :, 2] > z
        next_above, ends = np.roll(above, -1, axis=1), np.roll(self.corners, -1, axis=1)
        points = []
        for edges in (above & ~next_above, ~above & next_above):  # every cut triangle has one of each kind
            start, side = self.corners[edges], ends[edges] - self.corners[edges]
            points.append((start + ((z - start[:, 2]) / side[:, 2])[:, None] * side)[:, :2])
        return np.stack(points, axis=1)


_FLAT_MM = 1e-3  # rise of a face below which it is horizontal, and difference of heights below which they are equal
_SLOT_MM = 2.0  # width of a gap in a wall below which the wall counts as closed
SPECK_MM2 = 0.01  # smaller areas are corners or nearly lines, not walls or faces
_LINE_MM = 0.01  # narrower strips lie between two approximations of a curve, and are not walls
_TIP = 2.0  # maximum length of a corner, which is no wall, in limits: that between strips that cross at 29 degrees
_PRECISION = 0.02  # relative precision of widths, unless `_LINE_MM` is more


@dataclass(frozen=True, eq=False)
class Slab:
    """Part of a solid between two heights, with a nearly constant cross section."""

    bottom_mm: float
    top_mm: float
    solid: Any  # of manifold3d
    base: BaseGeometry  # cross section half way up the lowest slab

    @property
    def middle_mm(self) -> float:
        return (self.bottom_mm + self.top_mm) / 2

    @cached_property
    def cross_section(self) -> BaseGeometry:
        return cut_solid(self.solid, self.middle_mm)

    @cached_property
    def interior(self) -> BaseGeometry:
        """Area inside the outer edges of the cross section that has a floor beneath."""
        return overlap(fill_outline(self.cross_section), self.base)

    @cached_property
    def void(self) -> BaseGeometry:
        """Area of the casting: enclosed by the solid, with a floor beneath."""
        gaps = shapely.get_parts(without(self.interior, self.cross_section))
        return shapely.MultiPolygon(gaps[shapely.area(gaps) > _LINE_MM * shapely.length(gaps)].tolist())


def build_slabs(mesh: TriangleMesh, layer_mm: float) -> list[Slab]:
    """Cut a solid at its largest horizontal faces, halve tall slabs until there are enough, and return them from below.

    Slabs of less than half a printed layer are dropped, if others remain, since they are not printed.
    """
    (*_, low), (*_, high) = mesh.bounds.tolist()
    z = mesh.corners[:, :, 2]
    flat = np.ptp(z, axis=1) < _FLAT_MM
    heights, index = np.unique(np.round(z[flat, 0] / _FLAT_MM), return_inverse=True)
    order = np.argsort(-np.bincount(index, mesh.areas[flat], len(heights)), kind="stable")
    inner = [height for i in order if low + _FLAT_MM < (height := float(heights[i]) * _FLAT_MM) < high - _FLAT_MM]
    cuts = [low, *sorted(inner[:11]), high]  # enough for all horizontal faces of moulds of up to ten layers
    spans = [span for span in pairwise(cuts) if span[1] - span[0] > layer_mm / 2] or [(low, high)]
    while len(spans) < 8:
        tallest = max(range(len(spans)), key=lambda i: spans[i][1] - spans[i][0])
        bottom, top = spans[tallest]
        spans[tallest : tallest + 1] = [(bottom, (bottom + top) / 2), ((bottom + top) / 2, top)]
    base = cut_solid(mesh.solid, sum(spans[0]) / 2)
    return [Slab(bottom, top, mesh.solid, base) for bottom, top in spans]


def cut_solid(solid: Any, z: float) -> BaseGeometry:
    """Compute the cross section of a manifold3d solid at height `z`, mm."""
    parts = solid.slice(z).decompose()
    rings = [part.to_polygons() for part in parts if not part.is_empty()]
    return shapely.MultiPolygon([shapely.Polygon(outer, holes) for outer, *holes in rings])


def find_overlaps(mesh: TriangleMesh, z: float) -> Array:
    """Return a position (k, 2), mm, in each area in which the solid overlaps itself at height `z`, mm.

    The winding number of the outlines, with the solid on their left, is 1 inside the solid and 0 outside; where it is
    any other, the surface intersects itself.
    """
    segments = mesh.cut(z)
    noded = shapely.union_all(shapely.linestrings(segments), grid_size=SNAP_MM)
    faces = _drop_specks(shapely.polygonize(shapely.get_parts(noded)))
    points = shapely.get_coordinates(shapely.point_on_surface(faces))
    start, side = segments[:, 0], segments[:, 1] - segments[:, 0]
    x, y = np.moveaxis(points[:, None] - start, 2, 0)
    is_left = side[:, 0] * y > side[:, 1] * x
    rises, falls = (y >= 0) & (y < side[:, 1]), (y < 0) & (y >= side[:, 1])
    winding_number = (rises & is_left).sum(axis=1) - (falls & ~is_left).sum(axis=1)
    return points[(winding_number != 0) & (winding_number != 1)]


def fill_outline(area: BaseGeometry) -> BaseGeometry:
    """Return the area inside the outer edges of `area`, closing slots of up to `_SLOT_MM`."""

    def fill(shape: BaseGeometry) -> BaseGeometry:
        return shapely.union_all(shapely.polygons(shapely.get_exterior_ring(shapely.get_parts(shape))))

    grown = fill(fill(area).buffer(_SLOT_MM / 2, join_style="mitre"))
    return areas(grown.buffer(-_SLOT_MM / 2, join_style="mitre"))


def _open(area: BaseGeometry, width: float) -> BaseGeometry:
    """Compute the morphological opening of an area: erosion and dilation by half of `width`, with sharp corners."""
    opened = area.buffer(-width / 2, join_style="mitre").buffer(width / 2, join_style="mitre")
    return opened if opened.is_valid else areas(shapely.make_valid(opened))  # sharp corners may overlap


def _drop_specks(area: BaseGeometry | Shapes) -> Shapes:
    patches = shapely.get_parts(area)
    return patches[shapely.area(patches) > SPECK_MM2]


def find_thin_patches(area: BaseGeometry, width: float, within: BaseGeometry) -> Shapes:
    """Return the patches (k,) that an opening of a width, mm, removes from an area, with corners, without specks."""
    return _drop_specks(overlap(without(area, _open(area, width)), within))


def _find_thin_walls(area: BaseGeometry, width: float, tip: float) -> Shapes:
    """Return the patches narrower than `width`, except tips: up to `tip` long, with one contact to the wider area."""
    opened = _open(area, width)
    cores = shapely.get_parts(shapely.buffer(_drop_specks(without(area, opened)), -_LINE_MM, join_style="mitre"))
    patches = _drop_specks(np.asarray(shapely.buffer(cores, _LINE_MM, join_style="mitre")))
    contacts = shapely.buffer(shapely.intersection(opened.boundary, shapely.buffer(patches, 2 * _LINE_MM)), _LINE_MM)
    corners = [shapely.points(shapely.get_coordinates(patch)) for patch in patches]
    reach = [shapely.distance(*pair).max() for pair in zip(corners, contacts, strict=True)]  # NaN without a contact
    tips = (shapely.get_num_geometries(contacts) == 1) & (np.array(reach) + _LINE_MM <= tip)
    return patches[~tips]


def tested_width(limit: float) -> float:
    """Return the width, mm, below which a part fails: `limit` minus the error of outlines and meshes."""
    return limit - min(max(0.02, 0.05 * limit), limit / 4)


def find_narrow_parts(area: BaseGeometry, limit: float, within: BaseGeometry | None = None) -> tuple[Shapes, float]:
    """Find the parts (k,) of an area narrower than `tested_width` of a limit, mm, clipped to another area, if any.

    The width of the narrowest, by bisection, is returned as well; `limit` if there is none.
    """
    low, high, tip = 0.0, tested_width(limit), _TIP * limit
    parts = narrow = _find_thin_walls(area, high, tip)
    if within is not None and len(parts):
        parts = narrow = _drop_specks(overlap(shapely.union_all(parts), within))
    if not len(parts):
        return parts, limit
    while high - low > max(_LINE_MM, _PRECISION * low):
        middle, region = (low + high) / 2, shapely.union_all(narrow)
        area = overlap(area, region.buffer(2 * limit))
        thinner = _find_thin_walls(area, middle, tip)
        thinner = thinner[shapely.intersects(thinner, region)]
        low, high, narrow = (low, middle, thinner) if len(thinner) else (middle, high, narrow)
    return parts, high


def compute_min_width(area: BaseGeometry, limit: float) -> float:
    """Compute the minimum width, mm, of an area without parts narrower than `limit`, by bisection up to its size."""
    x_min, y_min, x_max, y_max = area.bounds
    low, high = limit, max(x_max - x_min, y_max - y_min, limit)
    while high - low > max(_LINE_MM, _PRECISION * low):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if len(_find_thin_walls(area, middle, _TIP * limit)) else (middle, high)
    return low
