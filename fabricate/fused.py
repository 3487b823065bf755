"""The plain way to a CAD solid: every prism a build123d extrusion, joined and cut by the CAD kernel.

It shares nothing with the mesh but the description of the body, so it is the oracle for both quick ways, and what the
bench sets beside them. Dense fibres take it many seconds.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from build123d import Face, Solid, Vector, Wire
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from .bodies import Body, Prism
from .outlines import polygon_rings


def fused_solid(body: Body) -> Any:
    """A body as a build123d `Solid`, or a `Compound` of several, by Boolean operations; lengths in mm."""
    solid: Any
    solid, *more = _prisms(body.base)
    if more:
        solid = solid.fuse(*more)
    if body.cuts:
        solid = solid.cut(*_prisms(body.cuts))
    return solid.fuse(*_prisms(body.adds)) if body.adds else solid


def _prisms(prisms: Iterable[Prism]) -> list[Solid]:
    return [solid for prism in prisms for solid in _solids(prism)]


def _solids(prism: Prism) -> list[Solid]:
    """One solid for every polygon of a prism's area."""
    polygons = polygon_rings(prism.area)
    if not prism.flare_mm:
        up = Vector(0, 0, prism.top_mm - prism.bottom_mm)
        faces = [Face(*_wires(rings, prism.bottom_mm)) for rings in polygons]
        return [Solid.extrude(face, up) for face in faces]
    ((outer,),) = polygons
    ((grown,),) = polygon_rings(_grown(prism.area, prism.flare_mm))
    ends = [_wire(outer, prism.bottom_mm), _wire(grown, prism.top_mm)]
    return [Solid.make_loft(ends, ruled=True)]


def _grown(area: BaseGeometry, by_mm: float) -> BaseGeometry:
    low, high = np.reshape(area.bounds, (2, 2))
    x, y = 1 + 2 * by_mm / (high - low)
    return affinity.scale(area, x, y, origin=tuple((low + high) / 2))


def _wires(rings: Sequence[np.ndarray], z: float) -> tuple[Wire, list[Wire]]:
    outer, *holes = (_wire(ring, z) for ring in rings)
    return outer, holes


def _wire(ring: np.ndarray, z: float) -> Wire:
    return Wire.make_polygon([Vector(x, y, z) for x, y in ring.tolist()], close=True)
