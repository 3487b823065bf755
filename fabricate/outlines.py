"""The plan of a mould: centre lines, ridge outlines and tray in mm.

The frame is the pad's own, x and y from its centre (`Morphology.to_mm`), as it lies in the tray with its tracks
down. Turned over for laying, the tracks are the mirror image of the plan.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from design.curves import Crossing, crossings, flatten
from design.morphology import Morphology

from .settings import DEFAULTS, Settings

INTO_WALL_MM = 0.5
"""How far ridges run into the walls: the tracks open to the pad's sides, and no two faces of the mould coincide."""

SNAP_MM = 1e-4
"""Grid that areas are snapped to where they are cut and joined, mm.

No edge of the solid is shorter; and without a grid, outlines that almost coincide can defeat the cut."""

_CENTRE_SHARE, _ARC_SHARE, _OUTLINE_SHARE = 0.2, 0.2, 0.6
"""How the tolerance is shared: most thins out the outline, which sets the size of every file."""


@dataclass(frozen=True)
class Plan:
    """A morphology with the settings of its mould; what is derived from them is computed when first asked for.

    Attributes:
        share: of the allowed tolerance, what the outlines use of it.

    Raises:
        InputError: settings that contradict each other or the pitch.
    """

    pad: Morphology
    settings: Settings = DEFAULTS
    share: float = 1.0

    @classmethod
    def tries(cls, pad: Morphology, settings: Settings) -> Iterator["Plan"]:
        """Plans of ever finer outlines, for whoever finds that one makes no closed solid.

        Among thousands of dense outlines two may meet within the precision of a float, by chance; with a few less
        or more points on them they lie clear of each other.
        """
        for share in (1.0, 0.9, 0.8, 0.7):
            yield cls(pad, settings, share)

    def __post_init__(self) -> None:
        self.settings.require_consistent(self.pad.pitch_mm)

    @property
    def tolerance_mm(self) -> float:
        """Greatest deviation of a ridge from its curve in this plan, mm."""
        return self.share * self.settings.mould.tolerance_mm

    @cached_property
    def lines(self) -> list[shapely.LineString]:
        """2M centre lines, mm: each within a fifth of the tolerance, continued straight through border and wall."""
        tolerance = _CENTRE_SHARE * self.tolerance_mm / self.pad.pitch_mm
        reach = self.settings.mould.border_mm + INTO_WALL_MM
        lines = []
        for fibre, points in enumerate(flatten(self.pad, tolerance)):
            places = self.pad.to_mm(points)
            ahead = reach * np.eye(2)[fibre // self.pad.grid]
            lines.append(shapely.LineString(np.vstack([places[0] - ahead, places, places[-1] + ahead])))
        return lines

    @cached_property
    def ridges(self) -> tuple[BaseGeometry, BaseGeometry]:
        """Outlines of the ridges of the horizontal and of the vertical family, mm, ends inside the walls."""
        mould, grid = self.settings.mould, self.pad.grid
        half, spare = mould.ridge_width_mm / 2, _OUTLINE_SHARE * self.tolerance_mm
        chord = 2 * math.acos(1 - _ARC_SHARE * self.tolerance_mm / half)
        bands = shapely.buffer(self.lines, half, quad_segs=math.ceil(math.pi / 2 / chord), cap_style="flat")
        first, second = (shapely.union_all(family).simplify(spare) for family in (bands[:grid], bands[grid:]))
        return first, second

    @cached_property
    def cavity(self) -> shapely.Polygon:
        """What the silicone fills, seen from above, mm."""
        return _square(self.pad.size_mm / 2 + self.settings.mould.border_mm)

    @cached_property
    def tray(self) -> shapely.Polygon:
        """The mould seen from above, walls included, mm."""
        return _square(self.pad.size_mm / 2 + self.settings.mould.border_mm + self.settings.mould.wall_mm)

    @cached_property
    def crossings(self) -> list[Crossing]:
        """Every place where two fibres meet; `place` in grid units."""
        return crossings(self.pad, self.settings.mould.tolerance_mm / self.pad.pitch_mm)

    def same_family(self, crossing: Crossing) -> bool:
        """Whether both fibres of a crossing run at the same depth."""
        return (crossing.first < self.pad.grid) == (crossing.second < self.pad.grid)


def overlap(first: BaseGeometry, second: BaseGeometry) -> BaseGeometry:
    """The area that two areas share."""
    return areas(shapely.intersection(first, second, grid_size=SNAP_MM))


def without(first: BaseGeometry, second: BaseGeometry) -> BaseGeometry:
    """What `second` leaves of the area `first`."""
    return areas(shapely.difference(first, second, grid_size=SNAP_MM))


def areas(shape: BaseGeometry) -> BaseGeometry:
    """The polygons of `shape`; snapping leaves lines and points behind where areas barely touch."""
    parts = shapely.get_parts(shape)
    return shapely.MultiPolygon(parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON].tolist())


def polygon_rings(area: BaseGeometry) -> list[list[np.ndarray]]:
    """Each polygon of `area` as its rings (n, 2) without the repeated last point, outer first.

    Outer rings run counter-clockwise and holes clockwise: the polygon lies to the left of every edge.
    """
    polygons = shapely.orient_polygons(shapely.get_parts(area))
    return [[shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(polygon)] for polygon in polygons]


def _square(half_mm: float) -> shapely.Polygon:
    return shapely.box(-half_mm, -half_mm, half_mm, half_mm)
