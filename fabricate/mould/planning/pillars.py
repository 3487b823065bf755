"""Keep-outs as pillars of the mould, around which the silicone leaves holes."""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.design.morphology import Array

_AT_WALL_MM = 1e-3
"""What comes so near to a wall reaches it."""


def pillar_outlines(
    polygons_mm: Sequence[Sequence[tuple[float, float]]], cavity: shapely.Polygon, into_mm: float
) -> BaseGeometry:
    """The outlines of pillars, which reach so far into the walls of the rectangle `cavity` where they come to them.

    A wall leans outwards from there: silicone between it and a pillar that ends at its foot would be a mere film.
    """
    keep_outs = shapely.union_all([shapely.Polygon(corners) for corners in polygons_mm])
    outlines = keep_outs.intersection(cavity.buffer(into_mm, join_style="mitre"))
    low, high = np.reshape(cavity.bounds, (2, 2))
    for axis in (0, 1):  # one after the other, so that corners are filled as well
        outlines = shapely.union_all([outlines, *_into_walls(outlines, axis, low, high, into_mm)])
        low[axis], high[axis] = low[axis] - into_mm, high[axis] + into_mm
    return outlines


def _into_walls(outlines: BaseGeometry, axis: int, low: Array, high: Array, into_mm: float) -> Iterator[BaseGeometry]:
    """Boxes on what comes to the walls across an axis, between the corners `low` and `high` (2,)."""
    for edge, out in ((low[axis], -1), (high[axis], 1)):
        strip = np.stack([low, high])
        strip[:, axis] = sorted((edge - out * _AT_WALL_MM, edge))
        for part in shapely.get_parts(outlines.intersection(_box(strip))):
            box = np.reshape(part.bounds, (2, 2))
            box[:, axis] = sorted((edge - out * _AT_WALL_MM, edge + out * into_mm))
            yield _box(box)


def _box(corners: Array) -> shapely.Polygon:
    (left, low), (right, high) = corners.tolist()
    return shapely.box(left, low, right, high)
