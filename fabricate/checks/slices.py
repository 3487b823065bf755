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
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.mould.plan import areas, overlap, without

from .surface import Surface

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
