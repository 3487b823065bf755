"""Triangles of a mesh that cut through one another.

Two triangles penetrate as far as one of them must be moved to set them apart. For triangles in different planes that
is the least overlap of their shadows on eleven axes: both normals and the cross products of their edges; for triangles
in one plane, on the normals of their edges within it. Neighbours that share a corner or an edge and do not fold back
have an axis on which they only touch, so they need no rule of their own.

Candidates come from a sweep: triangles are sorted by where they begin along one axis, and each is compared with those
that begin before it ends. A mould's upright faces and level slivers rarely share more than a side of their boxes,
which leaves few pairs to look at closely: 20 ms for 16 000 triangles, 60 ms for 38 000.
"""

from typing import Any

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray

from padforge.design.morphology import Array
from padforge.fabricate.mould.plan import SNAP_MM

PENETRATION_MM = 1e-3
"""Triangles that reach less far into each other only touch: a thousand times what writing an STL moves a corner."""
_PLANE_ULPS = 4
"""Corners this many float32 steps off a plane lie in it: an STL can say no better."""
_NEEDLE_MM = 1e-6
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


def penetrating(corners: Array, most: int = 1000) -> NDArray[np.int64]:
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
    kept = np.flatnonzero(doubled > _NEEDLE_MM * longest)
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


def places(corners: Array, pairs: NDArray[np.int64]) -> Array:
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
