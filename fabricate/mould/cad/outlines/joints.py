"""Where a fibre passes a knot its curvature jumps, and so does that of its track's walls: they are joined there."""

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from padforge.design.paths.curves import slopes
from padforge.fabricate.mould.plan import Plan, polygon_rings

Array = NDArray[np.float64]
Joints = dict[tuple[float, float], Array]
"""Of every joint, x and y, mm, the direction (2,) of its fibre."""

_NEAR_MM = 1e-3
"""A joint further from an outline is inside it: there the walls of two fibres, or of one that folds, run into one."""


def joints(plan: Plan, level: int, half_mm: float) -> Joints:
    """The joints of the walls, `half_mm` from their fibres, of all fibres of a level."""
    found: Joints = {}
    for fibre, (knots, slope) in enumerate(zip(plan.pad.to_mm(plan.pad.knots), slopes(plan.pad), strict=True)):
        if plan.levels[fibre] == level:
            along = np.stack([np.ones_like(slope), slope], axis=1)[:, :: -1 if plan.family(fibre) else 1]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            beside = half_mm * np.stack([-along[:, 1], along[:, 0]], axis=1)
            for places in (knots + beside, knots - beside):
                found |= zip(map(tuple, places.tolist()), along, strict=True)
    return found


def with_joints(area: BaseGeometry, places: Joints) -> BaseGeometry:
    """The area with a vertex at every joint on its outline."""
    points = np.array(list(places))
    polygons = [
        shapely.Polygon(*_split([_with_vertices(ring, points) for ring in rings])) for rings in polygon_rings(area)
    ]
    return shapely.MultiPolygon(polygons)


def _split(rings: list[Array]) -> tuple[Array, list[Array]]:
    return rings[0], rings[1:]


def _with_vertices(ring: Array, points: Array) -> Array:
    line = shapely.LinearRing(ring)
    near = points[shapely.dwithin(line, shapely.points(points), _NEAR_MM)]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    at = np.concatenate([along, shapely.line_locate_point(line, shapely.points(near))])
    order = np.argsort(at, kind="stable")
    vertices = np.vstack([ring, near])[order]
    return vertices[np.linalg.norm(vertices - np.roll(vertices, 1, axis=0), axis=1) > 1e-9]
