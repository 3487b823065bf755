"""Whether a solid, and the casting in it, are thick enough everywhere: ridges, walls, floor and silicone.

Widths are those of slices, thickness is that along upright lines. Lengths are mm.
"""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.mould.plan import without
from padforge.fabricate.settings import PrinterSettings

from .findings import Finding, Place, Status, verdict
from .slices import Slab, least_width, section, spare_width, tested_width, too_narrow
from .surface import Surface, spread

LEAST_FLOOR_MM = 0.4
"""Thinner floors bend when the casting is pulled out."""
LEAST_SILICONE_MM = 0.1
"""Silicone thinner than this does not come out of the mould in one piece."""
_WALL_LINES = 2
"""Lines side by side that make a wall hold."""
_FLOOR_LAYERS = 2
"""Layers that make a floor tight."""
_APART = 1.5
"""Ridges whose tops differ by this many least silicone walls leave tracks at two depths, which may come close."""
_STEEPEST_WALL = math.tan(math.radians(10))
"""How much a wall leans outwards per mm of height, at most; what leans more is not known for a wall."""
_RIDGE_SLOPE = math.tan(math.radians(20))
"""How much a ridge widens on either side per mm downwards, at most."""
_LEVEL = math.cos(math.radians(10))
"""Least cosine of the slope of a face that a floor may have."""
_NEAR_CORNER = 0.98
"""Share of the way from a triangle's middle to its corners where its thickness is measured too."""


def ridge_width(slices: Sequence[Slab], printer: PrinterSettings) -> Finding:
    """Whether everything that stands in a layer is as wide as what the printer draws."""
    limit, name = printer.line_mm, "two pixels" if printer.resin else "the nozzle"
    sections = [slab.cross_section for slab in slices]
    least, places = _narrowest(sections, [None] * len(sections), limit)
    if not places:
        return Finding("ridge_width", "pass", limit, limit, f"nothing is narrower than {name}, {limit:g} mm")
    message = f"the narrowest part is {least:.2f} mm wide, {name} {limit:g} mm"
    return Finding("ridge_width", "fail", least, limit, message, places)


def silicone_wall(slices: Sequence[Slab], limit: float, size: float) -> Finding:
    """Whether the silicone between tracks of one depth, and between tracks and walls, is as thick as `limit`.

    Args:
        slices: of the whole solid.
        limit: least thickness, mm.
        size: what stands for the thickness where there is nothing to cast.
    """
    cast = [slab for slab in slices if slab.void.area]
    if not cast:
        return Finding("silicone_wall", "pass", size, limit, "nothing is cast in it")
    least, places = _narrowest([_level_void(slab, slices, limit) for slab in cast], [s.void for s in cast], limit)
    if not places:
        message = f"no silicone between tracks of one depth is thinner than {limit:g} mm"
        return Finding("silicone_wall", "pass", limit, limit, message)
    status: Status = "warn" if least >= LEAST_SILICONE_MM else "fail"
    message = f"the thinnest silicone between tracks of one depth is {least:.2f} mm"
    return Finding("silicone_wall", status, least, limit, message, places)


def _level_void(slab: Slab, slices: Sequence[Slab], limit: float) -> BaseGeometry:
    """The void of a slab, together with the ridges that rise far above it; those near the walls stay solid."""
    taller = [other for other in slices if other.top_mm > slab.top_mm + _APART * limit and other.void.area]
    if not taller:
        return slab.void
    top, rim = taller[0], taller[-1]
    wall = rim.cross_section.buffer(_STEEPEST_WALL * (rim.middle_mm - slab.middle_mm), join_style="mitre")
    ridges = without(top.cross_section, wall)
    if not ridges.area:
        return slab.void
    foot = _RIDGE_SLOPE * (top.middle_mm - slab.middle_mm)
    return without(slab.frame, without(slab.cross_section, ridges.buffer(foot, join_style="mitre")))


def _narrowest(
    areas: Sequence[BaseGeometry], within: Sequence[BaseGeometry | None], limit: float
) -> tuple[float, tuple[Place, ...]]:
    """The least width in any of the areas, if less than `limit`, and the places of all that is too narrow."""
    found = [(area, too_narrow(area, limit, inside)) for area, inside in zip(areas, within, strict=True)]
    widths = [least_width(area, patches, limit) for area, patches in found if len(patches)]
    patches = shapely.union_all(np.concatenate([patches for _, patches in found]))  # some lie in several slices
    return min(widths, default=limit), spread(_points_on(shapely.get_parts(patches)))


def _points_on(patches: NDArray[np.object_]) -> NDArray[np.float64]:
    return shapely.get_coordinates(shapely.point_on_surface(patches))


def wall_thickness(slices: Sequence[Slab], printer: PrinterSettings, size: float) -> Finding:
    """Whether the walls around the casting are two lines thick where they are thinnest, just below their rim."""
    line = printer.line_mm
    limit = _WALL_LINES * printer.nozzle_mm
    cast = [slab for slab in slices if slab.void.area]
    if not cast:
        return Finding("wall_thickness", "pass", size, limit, "it has no walls around a casting")
    rim = cast[-1]
    area = section(rim.solid, rim.top_mm - min(printer.layer_mm, rim.top_mm - rim.bottom_mm) / 2)
    patches = too_narrow(area, limit)
    least = least_width(area, patches, limit) if len(patches) else spare_width(area, limit)
    status: Status = "pass" if not len(patches) else "warn" if least > tested_width(line) else "fail"
    message = f"the walls are {least:.2f} mm thick at the rim, {_WALL_LINES} lines of the printer {limit:g} mm"
    return Finding("wall_thickness", status, least, limit, message, spread(_points_on(patches)))


def floor_thickness(surface: Surface, printer: PrinterSettings) -> Finding:
    """Whether level faces have as much solid beneath them as a tight floor needs.

    Measured upright between level faces, at their middles and near their corners; towards a sharp edge between a
    level and a leaning face the thickness goes to nothing, and that is no floor.
    """
    limit = max(LEAST_FLOOR_MM, _FLOOR_LAYERS * printer.layer_mm)
    up, down = surface.rise > _LEVEL, surface.rise < -_LEVEL
    gaps, points = zip(_solid_from(surface, up, down), _solid_from(surface, down, up), strict=True)
    thick, places = np.concatenate(gaps), np.concatenate(points)
    least = float(thick.min(initial=surface.bottom_top[1, 2] - surface.bottom_top[0, 2]))
    passed = least >= tested_width(limit)
    message = f"the thinnest floor is {least:.2f} mm"
    return verdict("floor_thickness", passed, least, limit, message, spread(places[thick < tested_width(limit)]))


def _solid_from(
    surface: Surface, start: NDArray[np.bool_], end: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far solid reaches from the triangles `start` (m,) straight to those of `end`: (k,) mm, and places (k, 2)."""
    corners, middles = surface.corners[start], surface.middles[start][:, None]
    points = np.concatenate([middles, middles + _NEAR_CORNER * (corners - middles)], axis=1).reshape(-1, 3)
    inward = np.repeat(-np.sign(surface.rise[start]), len(points) // max(len(corners), 1))
    targets = np.flatnonzero(end)
    tree = shapely.STRtree(np.asarray(shapely.polygons(surface.corners[targets, :, :2])))
    point, target = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    a, b, c = np.moveaxis(surface.corners[targets[target]], 1, 0)
    normals = np.cross(b - a, c - a)
    gaps = ((a - points[point]) * normals).sum(axis=1) / normals[:, 2] * inward[point]
    return gaps[gaps > 0], points[point[gaps > 0], :2]
