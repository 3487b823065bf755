"""The tray's walls, which lean outwards: planes over the plan, and what is open between them at any height."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from padforge.fabricate.mould.plan import Plan, polygon_rings

Array = NDArray[np.float64]

FLOOR, RIM = -1, -2
"""The floor between the walls, and the rim on top of them, among the numbers of the walls' planes."""


@dataclass(frozen=True, eq=False)
class Walls:
    """The tray's floor and its leaning walls, as a height over every place.

    Args:
        hollows: (k, 4) least x and y and greatest x and y, on the floor, of the rectangles the silicone fills.
        floor_mm: height of the floor. depth_mm: of the rim above it. flare_mm: how far walls lean outwards up to there.
    """

    hollows: Array
    floor_mm: float
    depth_mm: float
    flare_mm: float

    def sheets(self, places: Array) -> NDArray[np.intp]:
        """(n,) what lies under places (n, 2): `FLOOR`, `RIM` or the number of a wall's plane."""
        beyond = self._beyond(places)
        hollow = beyond.max(axis=2).argmin(axis=1)
        nearest = beyond[np.arange(len(places)), hollow]
        away = nearest.max(axis=1)
        return np.where(away <= 0, FLOOR, np.where(away >= self.flare_mm, RIM, 4 * hollow + nearest.argmax(axis=1)))

    def heights(self, places: Array) -> Array:
        """(n,) heights of what lies under places (n, 2), mm."""
        away = self._beyond(places).max(axis=2).min(axis=1)
        rise = np.clip(away / self.flare_mm, 0, 1) if self.flare_mm else away > 0
        return self.floor_mm + self.depth_mm * rise

    @property
    def slope(self) -> float:
        """How steeply walls that lean rise, mm for every mm outwards."""
        return self.depth_mm / self.flare_mm

    def plane(self, sheet: int, places: Array) -> Array:
        """(n,) heights of a wall's plane over places (n, 2), mm."""
        hollow, side = divmod(sheet, 4)
        return self.floor_mm + self.slope * self._beyond(places)[:, hollow, side]

    def normal(self, sheet: int) -> tuple[float, float, float]:
        """Upward normal of a wall's plane, not of unit length."""
        side = sheet % 4
        along = self.slope if side < 2 else -self.slope
        return (along, 0.0, 1.0) if side % 2 == 0 else (0.0, along, 1.0)

    def outline(self, z: float) -> shapely.Polygon:
        """What is open at a height, seen from above."""
        ring = self._floor_ring
        return shapely.Polygon(ring + (z - self.floor_mm) / self.depth_mm * self.flare_mm * self._outward)

    def creases(self) -> list[shapely.LineString]:
        """Lines between the planes: the floor's outline and where two walls meet."""
        ring, top = self._floor_ring, self._floor_ring + self.flare_mm * self._outward
        corners = [shapely.LineString(ends) for ends in zip(ring, top, strict=True)] if self.flare_mm else []
        return [self.outline(self.floor_mm).exterior, *corners]

    def _beyond(self, places: Array) -> Array:
        """(n, k, 4) how far places lie beyond every side of every hollow."""
        low, high = self.hollows[:, :2], self.hollows[:, 2:]
        return np.concatenate([low - places[:, None], places[:, None] - high], axis=2)

    @cached_property
    def _floor_ring(self) -> Array:
        union = shapely.union_all(shapely.box(*self.hollows.T)).simplify(0)
        return polygon_rings(union)[0][0]

    @cached_property
    def _outward(self) -> Array:
        """(n, 2) how the corners of the floor's outline move for 1 mm of lean; its edges are upright or level."""
        edges = np.roll(self._floor_ring, -1, axis=0) - self._floor_ring
        away = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
        return away + np.roll(away, 1, axis=0)


def walls_of(plan: Plan) -> Walls:
    """The walls of a plan's tray."""
    hollows = np.array([shapely.bounds(each) for each in (plan.cavity, *plan.exits)])
    return Walls(hollows, plan.settings.mould.floor_mm, plan.silicone_mm, plan.flare_mm)
