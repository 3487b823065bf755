"""Whether a tray holds what is poured into it."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.mould.plan import areas, overlap, without

from .findings import Finding, verdict
from .slices import Slab

WIDEST_MM = 10.0
"""Wider openings in a wall are no leaks but the shape of a part that is no tray."""
_LEAST_MM2 = 0.01
"""Smaller openings are what roundings leave."""
_NEAR_MM = 1e-3
"""Areas this near each other meet, but for the grid they are cut on."""
_BASIN = 0.25
"""Share of a part's outline that a tray's hollow takes up, at least: less is a funnel, or a hole."""
_FLOORLESS = 0.5
"""Where less than this share of what walls surround has a floor, they are no tray's."""


def tight(slices: Sequence[Slab]) -> Finding:
    """Whether no opening in wall or floor lets silicone out of what the walls surround."""
    leaks = [place for slab in slices[1:] for place in _through_walls(slab.cross_section)]
    leaks += _through_floor(slices)
    message = f"silicone runs out at {len(leaks)} places" if leaks else "no opening lets silicone out"
    return verdict("tight", not leaks, len(leaks), 0, message, dict.fromkeys(leaks))


def _through_walls(section: BaseGeometry) -> list[tuple[float, float]]:
    """Where walls that would surround an area, were they closed, let it out."""
    closed = section.buffer(WIDEST_MM / 2, join_style="mitre").buffer(-WIDEST_MM / 2, join_style="mitre")
    basins = [shapely.Polygon(hole) for part in shapely.get_parts(areas(closed)) for hole in part.interiors]
    if not basins:
        return []
    around = shapely.box(*section.bounds).buffer(1.0, join_style="mitre")
    free = shapely.get_parts(without(around, section))
    outside = [part for part in free if part.distance(around.exterior) < _NEAR_MM]
    plugs = shapely.get_parts(overlap(without(closed, section), shapely.union_all(outside)))
    return [
        _rounded(plug)
        for basin in basins
        if any(part.intersects(basin.representative_point()) for part in outside)
        for plug in plugs
        if plug.area > _LEAST_MM2 and plug.distance(basin) < _NEAR_MM and plug.distance(around.exterior) < 1 + _NEAR_MM
    ]


def _through_floor(slices: Sequence[Slab]) -> list[tuple[float, float]]:
    """Where an area that walls surround has nothing beneath it down to the bed."""
    for number, slab in enumerate(slices):
        hollow = shapely.union_all(
            [shapely.Polygon(r) for p in shapely.get_parts(slab.cross_section) for r in p.interiors]
        )
        bare = hollow
        for below in slices[:number]:
            bare = without(bare, below.cross_section)
        if (
            number
            and hollow.area > _BASIN * slices[0].cross_section.envelope.area
            and bare.area < _FLOORLESS * hollow.area
        ):
            return [_rounded(part) for part in shapely.get_parts(bare) if part.area > _LEAST_MM2]
    return []


def _rounded(part: BaseGeometry) -> tuple[float, float]:
    """A place in a part, to the micrometre: slices of one leak above each other give one place."""
    x, y = np.round(part.representative_point().coords[0], 3).tolist()
    return x, y
