"""Bodies of few prisms as CAD solids, by the kernel's Boolean operations; what is round is a cylinder or a cone.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from build123d import Face, Plane, Solid, Vector, Wire
from shapely import affinity

from padforge.fabricate.mould.plan import polygon_rings
from padforge.fabricate.mould.prisms import Body, Prism

from .outlines.pieces import arc_through

_ROUND = 32
"""A polygon of fewer corners is meant as one."""


def body_solid(body: Body) -> Any:
    """A body as a build123d `Solid`, or a `Compound` of several; lengths in mm."""
    solid: Any
    solid, *more = prism_solids(body.base)
    if more:
        solid = solid.fuse(*more)
    if body.cuts:
        solid = solid.cut(*prism_solids(body.cuts))
    return solid.fuse(*prism_solids(body.adds)) if body.adds else solid


def prism_solids(prisms: Iterable[Prism]) -> list[Solid]:
    """One solid for every polygon of every prism."""
    return [solid for prism in prisms for solid in _solids(prism)]


def _solids(prism: Prism) -> list[Solid]:
    polygons = polygon_rings(prism.area)
    if len(polygons) == 1 and len(polygons[0]) == 1 and (circle := _circle(polygons[0][0])):
        return [_round(prism, *circle)]
    if not prism.flare_mm:
        up = Vector(0, 0, prism.top_mm - prism.bottom_mm)
        wires = [[_wire(ring, prism.bottom_mm) for ring in rings] for rings in polygons]
        return [Solid.extrude(Face(outer, holes), up) for outer, *holes in wires]
    low, high = np.reshape(prism.area.bounds, (2, 2))
    x, y = 1 + 2 * prism.flare_mm / (high - low)
    grown = affinity.scale(prism.area, x, y, origin=tuple((low + high) / 2))
    (((bottom,),), ((top,),)) = polygons, polygon_rings(grown)
    return [Solid.make_loft([_wire(bottom, prism.bottom_mm), _wire(top, prism.top_mm)], ruled=True)]


def _circle(ring: np.ndarray) -> tuple[float, float, float] | None:
    """Middle and radius of the circle that a ring of many corners is drawn for."""
    arc = arc_through(ring) if len(ring) >= _ROUND else None
    return arc[:3] if arc else None


def _round(prism: Prism, x: float, y: float, radius: float) -> Solid:
    height, foot = prism.top_mm - prism.bottom_mm, Plane((x, y, prism.bottom_mm))
    if prism.flare_mm:
        return Solid.make_cone(radius, radius + prism.flare_mm, height, foot)
    return Solid.make_cylinder(radius, height, foot)


def _wire(ring: np.ndarray, z: float) -> Wire:
    return Wire.make_polygon([Vector(x, y, z) for x, y in ring.tolist()], close=True)
