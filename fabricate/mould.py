"""The mould as a solid: a tray with ridges on its floor, once as a triangle mesh and once as an exact solid.

z = 0 is the underside of the tray, which lies on the print bed; the floor's top is at `floor_mm` and the walls end
at `floor_mm + silicone_mm`. Lengths are mm. Both ways start from the same `Plan` and share nothing after it, so
that one checks the other.
"""

from typing import TYPE_CHECKING

import numpy as np
import shapely

from design.errors import InputError
from design.morphology import Morphology

from .outlines import SNAP_MM, Plan, overlap, polygon_rings
from .settings import DEFAULTS, Settings

if TYPE_CHECKING:
    from build123d import Solid
    from manifold3d import Manifold
    from shapely.geometry.base import BaseGeometry

INTO_FLOOR_MM = 0.2
"""How far ridges sink into the floor before they are joined to it."""


def build_mould(pad: Morphology, settings: Settings = DEFAULTS) -> "Solid":
    """The mould as a build123d solid, ready for CAD and STEP.

    Args:
        pad: the fibres.
        settings: tray, ridges and fibre.

    Returns:
        One closed solid, mm.

    Raises:
        InputError: settings that contradict each other, or no closed solid comes out.
    """
    reason = InputError()
    for plan in Plan.tries(pad, settings):
        try:
            return plan_solid(plan)
        except InputError as error:
            reason = error
    raise reason


def plan_solid(plan: Plan) -> "Solid":
    """The solid of one plan; raises InputError where outlines touch."""
    from .plateaus import stepped_solid

    return stepped_solid(plateaus(plan), SNAP_MM)


def plan_mesh(plan: Plan) -> "Manifold":
    """The mould as a manifold3d mesh: extruded outlines, joined."""
    from manifold3d import CrossSection, Manifold, OpType

    def prism(area: "BaseGeometry", bottom: float, top: float) -> Manifold:
        rings = [ring for polygon in polygon_rings(area) for ring in polygon]
        return Manifold.extrude(CrossSection(rings), top - bottom).translate((0, 0, bottom))

    floor, top = _floor_and_top(plan.settings)
    tray = prism(plan.tray, 0, top) - prism(plan.cavity, floor, top + 1)
    heights = plan.settings.ridge_heights_mm
    ridges = [prism(r, floor - INTO_FLOOR_MM, floor + h) for r, h in zip(plan.ridges, heights, strict=True)]
    return Manifold.batch_boolean([tray, *ridges], OpType.Add)


def plateaus(plan: Plan) -> list[tuple["BaseGeometry", float]]:
    """The mould as a height map: areas with the z of their top, mm; together they tile the tray.

    Neighbouring areas share every vertex of the border between them, and vertices lie on a grid of `SNAP_MM`.
    """
    floor, top = _floor_and_top(plan.settings)
    levels = sorted(zip(plan.settings.ridge_heights_mm, plan.ridges, strict=True), key=lambda level: level[0])
    outlines = [plan.tray.boundary, plan.cavity.boundary]
    outlines += [overlap(ridge, plan.cavity).boundary for _, ridge in levels]
    cells = shapely.get_parts(shapely.polygonize([shapely.union_all(outlines, grid_size=SNAP_MM)]))
    x, y = shapely.get_coordinates(shapely.point_on_surface(cells)).T
    z = np.full(len(cells), floor)
    for height, ridge in levels:
        shapely.prepare(ridge)
        z[shapely.contains_xy(ridge, x, y)] = floor + height
    z[~shapely.contains_xy(plan.cavity, x, y)] = top
    return [(shapely.coverage_union_all(cells[z == height]), float(height)) for height in np.unique(z)]


def _floor_and_top(settings: Settings) -> tuple[float, float]:
    """z of the tray's floor and of the top of its walls, mm."""
    return settings.mould.floor_mm, settings.mould.floor_mm + settings.mould.silicone_mm
