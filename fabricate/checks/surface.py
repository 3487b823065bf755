"""A solid cut into layers, and what is too narrow in an area.

Lengths are mm.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numba import njit
from numpy.typing import ArrayLike, NDArray
from shapely.geometry.base import BaseGeometry

from padforge.design.common.validation import InputError, check_array
from padforge.design.morphology import Array
from padforge.fabricate.checks import Place, as_places
from padforge.fabricate.mesh import MAX_COORDINATE_MM, Numbers
from padforge.fabricate.plan import SNAP_MM, areas, overlap, without

_APART_MM = 1.0
"""Places less far apart than about this are one, for whoever looks for them."""
_NEEDLE_MM = 1e-3
"""Lower triangles have a normal that rounding turns: their neighbours speak for them."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, mm; what is derived from them is computed when first asked for.

    Attributes:
        vertices: (n, 3), all different.
        triangles: (m, 3) vertex numbers, three different ones each.
    """

    vertices: Array
    triangles: Numbers

    @classmethod
    def joined(cls, vertices: ArrayLike, triangles: ArrayLike) -> "Surface":
        """The surface of triangles (m, 3) over vertices (n, 3) mm that may repeat.

        Raises:
            InputError: vertices beyond LARGEST_MM, or numbers of ones that are not there.
        """
        places = check_array("vertices", vertices, MAX_COORDINATE_MM) + 0.0  # turns -0 into 0
        if places.ndim != 2 or places.shape[1] != 3:
            raise InputError(f"vertices have shape {places.shape}, expected (n, 3)")
        order = np.lexsort(places.T)
        new = np.ones(len(places), dtype=bool)
        new[1:] = (places[order[1:]] != places[order[:-1]]).any(axis=1)
        number = np.empty(len(places), dtype=np.int64)
        number[order] = np.cumsum(new) - 1
        corners = number[_numbers(triangles, len(places))]
        return cls(places[order[new]], corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)])

    @cached_property
    def corners(self) -> Array:
        """(m, 3, 3) mm."""
        return self.vertices[self.triangles]

    @cached_property
    def middles(self) -> Array:
        """(m, 3) mm."""
        return self.corners.mean(axis=1)

    @cached_property
    def _crosses(self) -> Array:
        return np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])

    @cached_property
    def areas(self) -> Array:
        """(m,) mm²."""
        return np.linalg.norm(self._crosses, axis=1) / 2

    @cached_property
    def rise(self) -> Array:
        """(m,) z of the unit normals: 1 faces up, -1 down; 0 for needles, whose normals mean nothing."""
        longest = np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
        real = 2 * self.areas > _NEEDLE_MM * longest
        return np.divide(self._crosses[:, 2], 2 * self.areas, out=np.zeros(len(real)), where=real)

    @cached_property
    def volumes(self) -> Array:
        """(m,) signed volume between each triangle and one point, mm³; summed over a closed shell, what it holds."""
        middle = (self.bottom_top.sum(axis=0)) / 2
        return ((self.corners[:, 0] - middle) * self._crosses).sum(axis=1) / 6

    @cached_property
    def bottom_top(self) -> Array:
        """(2, 3) lowest and highest coordinates of what the triangles use; zeros without triangles."""
        if not len(self.triangles):
            return np.zeros((2, 3))
        used = self.corners.reshape(-1, 3)
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @cached_property
    def sides(self) -> Numbers:
        """(3m, 2) vertex numbers, in the order in which triangles pass them; side k is of triangle k // 3."""
        return np.stack([self.triangles, np.roll(self.triangles, -1, axis=1)], axis=2).reshape(-1, 2)

    @cached_property
    def edges(self) -> tuple[Numbers, Numbers]:
        """One side of each edge, (e,), and the edge that each side lies on, (3m,)."""
        keys = self.sides.min(axis=1) * len(self.vertices) + self.sides.max(axis=1)
        _, first, edge = np.unique(keys, return_index=True, return_inverse=True)
        return first, edge

    @cached_property
    def solid(self) -> Any:
        """The mesh as a manifold3d `Manifold`, whatever its status."""
        from manifold3d import Manifold, Mesh64

        return Manifold(Mesh64(np.ascontiguousarray(self.vertices), self.triangles.astype(np.uint64)))

    @cached_property
    def shells(self) -> tuple[int, Numbers]:
        """How many shells the surface has, and the number of each triangle's, (m,)."""
        return self.patches(np.ones(len(self.triangles), dtype=bool))

    def patches(self, which: NDArray[np.bool_]) -> tuple[int, Numbers]:
        """How many patches the triangles `which` (m,) make up, joined at edges, and the patch number of each, (k,)."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        kept = np.flatnonzero(which)
        edges = self.edges[1].reshape(-1, 3)[kept].ravel()
        order = np.argsort(edges, kind="stable")
        same = np.flatnonzero(edges[order[1:]] == edges[order[:-1]])
        pairs = order[same] // 3, order[same + 1] // 3
        links = coo_array((np.ones(len(same), dtype=np.int8), pairs), shape=(len(kept), len(kept)))
        count, labels = connected_components(links, directed=False)
        return int(count), labels.astype(np.int64)

    def patch_places(self, which: NDArray[np.bool_]) -> tuple[Place, ...]:
        """One place for each patch of the triangles `which` (m,): the middle of its largest triangle."""
        kept = np.flatnonzero(which)
        _, labels = self.patches(which)
        order = np.lexsort((-self.areas[kept], labels))
        _, first = np.unique(labels[order], return_index=True)
        return spread(self.middles[kept[order[first]], :2])


def _numbers(triangles: ArrayLike, vertices: int) -> Numbers:
    """Triangles as (m, 3) numbers of so many vertices."""
    found = check_array("triangles", triangles)
    if found.ndim != 2 or found.shape[1] != 3:
        raise InputError(f"triangles have shape {found.shape}, expected (m, 3)")
    if found.size and not (found.min() >= 0 and found.max() < vertices and (found == np.trunc(found)).all()):
        raise InputError(
            f"triangles hold {found.min():g} to {found.max():g}, allowed are numbers of {vertices} vertices"
        )
    return found.astype(np.int64)


def spread(places: ArrayLike) -> tuple[Place, ...]:
    """The first of the places (k, 2) mm in every square millimetre."""
    points = np.asarray(places, dtype=np.float64).reshape(-1, 2)
    _, first = np.unique(np.round(points / _APART_MM), axis=0, return_index=True)
    return as_places(points[np.sort(first)])


PENETRATION_MM = 1e-3
"""Triangles that reach less far into each other only touch: a thousand times what writing an STL moves a corner."""
_PLANE_ULPS = 4
"""Corners this many float32 steps off a plane lie in it: an STL can say no better."""
_DEGENERATE_MM = 1e-6
"""Triangles less high than this have no plane to speak of, and no area to cut through."""
_PARALLEL = 1e-16
"""Edges whose squared sine is less have no cross product worth the name; other axes stand in for it."""
_APART, _ACROSS, _LEVEL = 0, 1, 2


@njit(cache=True, error_model="numpy")
def _overlap(corners: Any, a: int, b: int, x: float, y: float, z: float) -> float:
    """How far triangle b must be moved along (x, y, z) to clear a, times the length of that axis."""
    low_a = low_b = np.inf
    high_a = high_b = -np.inf
    for k in range(3):
        at_a = corners[a, k, 0] * x + corners[a, k, 1] * y + corners[a, k, 2] * z
        at_b = corners[b, k, 0] * x + corners[b, k, 1] * y + corners[b, k, 2] * z
        low_a, high_a = min(low_a, at_a), max(high_a, at_a)
        low_b, high_b = min(low_b, at_b), max(high_b, at_b)
    return min(high_a - low_b, high_b - low_a)


@njit(cache=True, error_model="numpy")
def _side(corners: Any, normals: Any, a: int, b: int, depth: float, level: float) -> int:
    """Whether triangle b lies across the plane of a, in it or to one side."""
    low, high = np.inf, -np.inf
    for k in range(3):
        at = 0.0
        for i in range(3):
            at += normals[a, i] * (corners[b, k, i] - corners[a, 0, i])
        low, high = min(low, at), max(high, at)
    if low >= -level and high <= level:
        return _LEVEL
    return _ACROSS if low < -depth and high > depth else _APART


@njit(cache=True, error_model="numpy")
def _penetrate(corners: Any, normals: Any, a: int, b: int, depth: float, level: float) -> bool:
    """Whether two triangles reach more than `depth` into each other."""
    first = _side(corners, normals, a, b, depth, level)
    second = _side(corners, normals, b, a, depth, level)
    if first == _LEVEL or second == _LEVEL:
        nx, ny, nz = normals[a] if first == _LEVEL else normals[b]
        for t in (a, b):
            for k in range(3):
                x, y, z = corners[t, (k + 1) % 3] - corners[t, k]
                x, y, z = ny * z - nz * y, nz * x - nx * z, nx * y - ny * x
                if _overlap(corners, a, b, x, y, z) <= depth * np.sqrt(x * x + y * y + z * z):
                    return False
        return True
    if first == _APART or second == _APART:
        return False
    for k in range(3):
        ax, ay, az = corners[a, (k + 1) % 3] - corners[a, k]
        for m in range(3):
            bx, by, bz = corners[b, (m + 1) % 3] - corners[b, m]
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            square = x * x + y * y + z * z
            if square <= _PARALLEL * (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz):
                continue
            if _overlap(corners, a, b, x, y, z) <= depth * np.sqrt(square):
                return False
    return True


@njit(cache=True, error_model="numpy")
def _boxes_penetrate(low: Any, high: Any, a: int, b: int, depth: float, level: float) -> bool:
    """Whether the boxes of two triangles leave it open that they penetrate: boxes that only touch must both be flat."""
    for i in range(3):
        reach = min(high[a, i] - low[b, i], high[b, i] - low[a, i])
        thick = max(high[a, i] - low[a, i], high[b, i] - low[b, i])
        if reach < -level or (reach <= depth and thick > depth):
            return False
    return True


@njit(cache=True, error_model="numpy")
def _sweep(corners: Any, normals: Any, low: Any, high: Any, depth: float, level: float, pairs: Any) -> int:
    """Count the pairs that penetrate, into `pairs` until that is full; triangles sorted by `low[:, 0]`."""
    count = 0
    for a in range(len(corners)):
        for b in range(a + 1, len(corners)):
            if low[b, 0] > high[a, 0] + level:
                break
            if low[b, 1] > high[a, 1] + level or high[b, 1] < low[a, 1] - level:
                continue
            if _boxes_penetrate(low, high, a, b, depth, level) and _penetrate(corners, normals, a, b, depth, level):
                pairs[count, 0], pairs[count, 1] = a, b
                count += 1
                if count == len(pairs):
                    return count
    return count


def find_self_intersections(corners: Array, most: int = 1000) -> NDArray[np.int64]:
    """Pairs of triangles that reach more than `PENETRATION_MM` into each other; duplicates and folds in a plane too.

    Args:
        corners: (m, 3, 3) mm.
        most: pairs that are looked for: in a heap of triangles there may be as many as can be.

    Returns:
        Up to `most` pairs as numbers of triangles, (k, 2).
    """
    corners = np.asarray(corners, dtype=np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    kept = np.flatnonzero(doubled > _DEGENERATE_MM * longest)
    if not len(kept):
        return np.empty((0, 2), dtype=np.int64)
    low, high = _boxes(corners)
    axes = _sweep_axes(low[kept], high[kept])
    kept = kept[np.argsort(low[kept, axes[0]], kind="stable")]
    turned = np.ascontiguousarray(corners[kept][:, :, axes])
    units = np.ascontiguousarray((normals[kept] / doubled[kept, None])[:, axes])
    pairs = np.empty((most, 2), dtype=np.int64)
    level = _PLANE_ULPS * float(np.finfo(np.float32).eps) * float(np.abs(turned).max())
    count = _sweep(turned, units, *_boxes(turned), PENETRATION_MM, level, pairs)
    return kept[pairs[:count]]


def _boxes(corners: Array) -> tuple[Array, Array]:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _sweep_axes(low: Array, high: Array) -> list[int]:
    """The axes, that first along which the fewest pairs of boxes lie side by side; right-handed."""
    beside = [np.searchsorted(np.sort(low[:, i]), high[:, i], side="right").sum() for i in range(3)]
    first = int(np.argmin(beside))
    return [first, (first + 1) % 3, (first + 2) % 3]


def intersection_points(corners: Array, pairs: NDArray[np.int64]) -> Array:
    """Where the two triangles of each pair meet, seen from above: (k, 2) mm.

    The mean of the points where the edges of either pierce the other, or the middle of the area that they share in
    one plane.
    """
    first, second = corners[pairs[:, 0]], corners[pairs[:, 1]]
    points = np.concatenate([_pierced(first, second), _pierced(second, first)], axis=1)
    inside = ~np.isnan(points[:, :, :1])
    count = inside.sum(axis=1)
    middles = np.where(inside, points, 0.0).sum(axis=1) / np.maximum(count, 1)
    level = np.flatnonzero(count[:, 0] == 0)
    middles[level] = _shared(first[level], second[level])
    return middles[:, :2]


def _pierced(triangles: Array, others: Array) -> Array:
    """The points (k, 3, 3) where the edges of `triangles` (k, 3, 3) go through `others`, NaN where they do not."""
    ends = np.roll(triangles, -1, axis=1)
    normals = np.cross(others[:, 1] - others[:, 0], others[:, 2] - others[:, 0])[:, None]
    before, after = (((place - others[:, :1]) * normals).sum(axis=2) for place in (triangles, ends))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(before * after < 0, before / (before - after), np.nan)
    points = triangles + share[:, :, None] * (ends - triangles)
    within = np.ones(share.shape, dtype=bool)
    for k in range(3):
        edges = others[:, (k + 1) % 3] - others[:, k]
        within &= (np.cross(edges[:, None], points - others[:, k, None]) * normals).sum(axis=2) >= 0
    return np.where(within[:, :, None], points, np.nan)


def _shared(triangles: Array, others: Array) -> Array:
    """The middles (k, 3) of the areas that `triangles` (k, 3, 3) share with `others` in their planes."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    dropped = np.abs(normals).argmax(axis=1)
    axes = np.sort((dropped[:, None] + [1, 2]) % 3, axis=1)[:, None, :]
    flat, flat_others = (np.take_along_axis(t, np.repeat(axes, 3, axis=1), axis=2) for t in (triangles, others))
    own = shapely.polygons(flat)
    shared = shapely.intersection(own, shapely.polygons(flat_others), grid_size=SNAP_MM)
    middles = shapely.centroid(
        np.where(shapely.is_empty(shared), np.asarray(own), np.asarray(shared))
    )  # what is thinner than the grid is lost
    away = np.stack([shapely.get_x(middles), shapely.get_y(middles)], axis=1) - flat[:, 0]
    edges = flat[:, 1:] - flat[:, :1]
    shares = np.linalg.solve(edges.transpose(0, 2, 1), away[:, :, None])
    return triangles[:, 0] + (shares * (triangles[:, 1:] - triangles[:, :1])).sum(axis=1)


_SLABS, _MOST_SLABS = 8, 12
"""How many slices are looked at, at least and at most: moulds of up to ten levels are seen whole."""
_LEVEL_MM = 1e-3
"""Faces that rise by less are level, and levels that differ by less are one."""
_SLOT_MM = 2.0
"""Narrower gaps in a wall do not make what it surrounds open to the side."""
_SPECK_MM2 = 0.01
"""Smaller areas are corners and the width of a line, not walls."""
_LINE_MM = 0.01
"""Narrower strips are what two outlines of one curve leave between them, not walls."""
_TIP = 2.0
"""What narrows to a point within so many least widths is a corner, as where strips cross at 29 degrees or more."""
_PRECISION = 0.02
"""Share to which least widths are found, or `_LINE_MM` where that is more."""


@dataclass(frozen=True, eq=False)
class Slab:
    """What lies between two levels of a solid, all alike, or nearly so.

    Attributes:
        bottom_mm, top_mm: the levels, z.
        solid: manifold3d solid that is cut.
        base: the solid's section near its underside.
    """

    bottom_mm: float
    top_mm: float
    solid: Any
    base: BaseGeometry

    @property
    def middle_mm(self) -> float:
        """Where it is cut, z."""
        return (self.bottom_mm + self.top_mm) / 2

    @cached_property
    def cross_section(self) -> BaseGeometry:
        """The solid's section half way up."""
        return section(self.solid, self.middle_mm)

    @cached_property
    def frame(self) -> BaseGeometry:
        """What the section's outer edges surround, as far as there is a floor beneath."""
        return overlap(enclosed(self.cross_section), self.base)

    @cached_property
    def void(self) -> BaseGeometry:
        """Where a casting lies: surrounded by solid, with a floor beneath."""
        gaps = shapely.get_parts(without(self.frame, self.cross_section))
        return shapely.MultiPolygon(gaps[shapely.area(gaps) > _LINE_MM * shapely.length(gaps)].tolist())


def slabs(surface: Surface, layer_mm: float) -> list[Slab]:
    """The solid's slabs between the levels of its flat faces, from below; high ones are cut in two as long as few.

    Slabs of less than half a layer are left out, as they are not printed as such, unless that is all there is.
    """
    levels = _levels(surface)
    spans = [(low, high) for low, high in pairwise(levels) if high - low > layer_mm / 2]
    spans = spans or [(levels[0], levels[-1])]
    while len(spans) < _SLABS:
        tallest = max(range(len(spans)), key=lambda i: spans[i][1] - spans[i][0])
        low, high = spans[tallest]
        spans[tallest : tallest + 1] = [(low, (low + high) / 2), ((low + high) / 2, high)]
    base = section(surface.solid, sum(spans[0]) / 2)
    return [Slab(low, high, surface.solid, base) for low, high in spans]


def _levels(surface: Surface) -> list[float]:
    """z of the underside, the top and the largest flat faces between."""
    low, high = surface.bottom_top[:, 2].tolist()
    z = surface.corners[:, :, 2]
    flat = np.ptp(z, axis=1) < _LEVEL_MM
    found, which = np.unique(np.round(z[flat, 0] / _LEVEL_MM), return_inverse=True)
    order = np.argsort(-np.bincount(which, surface.areas[flat], len(found)), kind="stable")
    inner = [float(found[i]) * _LEVEL_MM for i in order]
    inner = [level for level in inner if low + _LEVEL_MM < level < high - _LEVEL_MM]
    return [low, *sorted(inner[: _MOST_SLABS - 1]), high]


def section(solid: Any, z: float) -> BaseGeometry:
    """The area of a manifold3d solid at a height."""
    parts = solid.slice(z).decompose()
    rings = [part.to_polygons() for part in parts if not part.is_empty()]
    return shapely.MultiPolygon([shapely.Polygon(outer, holes) for outer, *holes in rings])


def enclosed(area: BaseGeometry) -> BaseGeometry:
    """What the outer edges of an area surround, over slots in them."""
    grown = _filled(_filled(area).buffer(_SLOT_MM / 2, join_style="mitre"))
    return areas(grown.buffer(-_SLOT_MM / 2, join_style="mitre"))


def _filled(area: BaseGeometry) -> BaseGeometry:
    return shapely.union_all(shapely.polygons(shapely.get_exterior_ring(shapely.get_parts(area))))


def tested_width(limit: float) -> float:
    """The width below which something is too narrow: less than `limit` by what outlines and meshes are rough."""
    return limit - min(max(0.02, 0.05 * limit), limit / 4)


def thin(area: BaseGeometry, width: float, tip: float) -> np.ndarray:
    """Patches of `area` narrower than `width`, as an array of polygons.

    They vanish when it shrinks and grows again by half of `width`, corners kept sharp, and are not the tip of
    something wider: those that touch it along one stretch and lead no farther than `tip` away from there.
    """
    opened = area.buffer(-width / 2, join_style="mitre").buffer(width / 2, join_style="mitre")
    if not opened.is_valid:  # sharp corners that grow past each other
        opened = areas(shapely.make_valid(opened))
    lost = _not_specks(shapely.get_parts(without(area, opened)))
    cores = shapely.get_parts(shapely.buffer(lost, -_LINE_MM, join_style="mitre"))
    lost = _not_specks(np.asarray(shapely.buffer(cores, _LINE_MM, join_style="mitre")))
    return lost[~_tips(lost, opened, tip)] if len(lost) else lost


def _not_specks(patches: np.ndarray) -> np.ndarray:
    return patches[shapely.area(patches) > _SPECK_MM2]


def _tips(patches: np.ndarray, wide: BaseGeometry, tip: float) -> np.ndarray:
    """Which patches touch `wide` along one stretch, and lead no farther than `tip` away from it."""
    found = np.zeros(len(patches), dtype=bool)
    rings = shapely.get_rings(shapely.get_parts(wide))
    ends = [np.stack([xy[:-1], xy[1:]], axis=1) for xy in map(shapely.get_coordinates, rings)]
    if not ends:
        return found
    edges = np.asarray(shapely.linestrings(np.concatenate(ends)))
    around = np.asarray(shapely.buffer(patches, 2 * _LINE_MM))
    patch, edge = shapely.STRtree(edges).query(around, predicate="intersects")
    touching = np.asarray(shapely.intersection(edges[edge], around[patch]))
    for i in np.unique(patch):
        stretches = shapely.union_all(shapely.buffer(touching[patch == i], _LINE_MM))
        if shapely.get_num_geometries(stretches) == 1:
            away = shapely.distance(shapely.points(shapely.get_coordinates(patches[i])), stretches)
            found[i] = away.max() + _LINE_MM <= tip
    return found


def too_narrow(area: BaseGeometry, limit: float, within: BaseGeometry | None = None) -> np.ndarray:
    """Patches of `area` narrower than `limit`, give or take what outlines are rough, and their share of `within`."""
    patches = thin(area, tested_width(limit), _TIP * limit)
    if within is None or not len(patches):
        return patches
    return _not_specks(shapely.get_parts(overlap(shapely.union_all(patches), within)))


def least_width(area: BaseGeometry, patches: np.ndarray, limit: float) -> float:
    """The width of the narrowest of the patches that `too_narrow` found, by bisection."""
    low, high, tip = 0.0, tested_width(limit), _TIP * limit
    while high - low > max(_LINE_MM, _PRECISION * low):
        middle, here = (low + high) / 2, shapely.union_all(patches)
        area = overlap(area, here.buffer(2 * limit))
        found = thin(area, middle, tip)
        found = found[shapely.intersects(found, here)]
        low, high, patches = (low, middle, found) if len(found) else (middle, high, patches)
    return high


def spare_width(area: BaseGeometry, limit: float) -> float:
    """The least width of an area in which nothing is narrower than `limit`, by bisection; at most its size."""
    left, bottom, right, top = area.bounds
    low, high = limit, max(right - left, top - bottom, limit)
    while high - low > max(_LINE_MM, _PRECISION * low):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if len(thin(area, middle, _TIP * limit)) else (middle, high)
    return low
