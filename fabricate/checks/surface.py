"""A triangle mesh as whoever reads its file sees it: equal corners joined, triangles without extent dropped."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.design.common.validation import InputError, check_array
from padforge.fabricate.mesh_files import LARGEST_MM, Array, Numbers

from .findings import Place, as_places

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
        places = check_array("vertices", vertices, LARGEST_MM) + 0.0  # turns -0 into 0
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
