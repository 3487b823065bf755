"""The ways of fibres from where they end to the edge of the silicone: straight on, or all to one side.

A pad that is wired to one connector has both ends of every fibre on its lower edge. Horizontals turn down beside the
pad, the lowest next to it. The upper ends of verticals turn to the left or the right above it, half of them each, and
go down outside of the horizontals. So they lie nested, and no two cross: a lead is its neighbour moved away from the
pad, along every piece of its way, by the distance between leads or by a pitch, whichever is asked for there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely

from padforge.design.morphology import Array
from padforge.design.paths.curves import cubic
from padforge.design.settings import Layout
from padforge.fabricate.settings import LeadRoom

_EIGHTH = 4 / 3 * np.tan(np.pi / 16)
"""Length of the handles of a cubic for an eighth of a circle of radius 1, which it is within 4.3e-6 of."""


@dataclass(frozen=True, eq=False)
class Lead:
    """The way of a fibre from one of its ends to the edge.

    Attributes:
        end_mm: (2,) the fibre's end. spans: (n, 4, 2) cubic Beziers from there on, mm; none where it goes straight on.
        outward: (2,) unit vector along an axis, in which it goes on from there. run_mm: how far that is to the edge.
    """

    end_mm: Array
    spans: Array
    outward: Array
    run_mm: float

    @property
    def turned_mm(self) -> Array:
        """(2,) from where it is straight."""
        return self.spans[-1, -1] if len(self.spans) else self.end_mm

    @property
    def axis(self) -> int:
        """Of the edge's normal: 0 for x, 1 for y."""
        return int(np.abs(self.outward).argmax())

    def beyond(self, *past_mm: float) -> Array:
        """(2,) so far past the edge, all in all."""
        return self.turned_mm + sum(past_mm, self.run_mm) * self.outward

    def bends(self, tolerance_mm: float) -> Array:
        """(k, 2) corners from the fibre's end, which is left out, to where it is straight, within a tolerance."""
        points = [np.empty((0, 2))]
        for span in self.spans:
            second = np.linalg.norm(np.diff(span, 2, axis=0), axis=1).max()
            steps = max(1, int(np.ceil(np.sqrt(0.75 * second / tolerance_mm))))  # Wang's bound, as of the fibres
            points.append(cubic(span, np.arange(1, steps + 1) / steps))
        return np.vstack(points)

    def trace(self, step: float, past_mm: float) -> tuple[Array, Array]:
        """Points (n, 2) from the fibre's end to so far past the edge, mm, and the exact headings there, radians.

        Args:
            step: greatest turn from one point to the next, radians.
            past_mm: how far past the edge.
        """
        points, directions = [], []
        for span in self.spans:
            sides = np.diff(span, axis=0)
            first, last = (side / np.linalg.norm(side) for side in (sides[0], sides[-1]))
            u = np.linspace(0, 1, 1 + max(1, int(np.ceil(np.arccos(np.clip(first @ last, -1, 1)) / step))))
            points.append(cubic(span, u))
            v = u[:, None]
            directions.append((1 - v) ** 2 * sides[0] + 2 * v * (1 - v) * sides[1] + v**2 * sides[2])
        points.append(np.array([self.turned_mm, self.beyond(past_mm)]))
        directions.append(np.array([self.outward, self.outward]))
        ahead = np.vstack(directions)
        return np.vstack(points), np.arctan2(ahead[:, 1], ahead[:, 0])

    @cached_property
    def length_mm(self) -> float:
        """To the edge."""
        nodes, weights = np.polynomial.legendre.leggauss(8)
        u = ((nodes + 1) / 2)[:, None]
        sides = 3 * np.diff(self.spans, axis=1)[:, :, None]
        speed = sides[:, 0] * (1 - u) ** 2 + 2 * sides[:, 1] * u * (1 - u) + sides[:, 2] * u**2
        return float((np.linalg.norm(speed, axis=-1) @ (weights / 2)).sum()) + self.run_mm

    def scaled(self, by: float) -> "Lead":
        """It so many times as large, about the pad's middle."""
        return replace(self, end_mm=self.end_mm * by, spans=self.spans * by, run_mm=self.run_mm * by)


@dataclass(frozen=True, eq=False)
class Leads:
    """Those of all fibres, and what the silicone fills around them.

    Attributes:
        pairs: of each fibre, of its start and of its other end. bounds_mm: left, low, right and high of the silicone.
    """

    pairs: tuple[tuple[Lead, Lead], ...]
    bounds_mm: tuple[float, float, float, float]

    def edge_mm(self, lead: Lead) -> float:
        """Coordinate, along its axis, of the edge that a lead comes to."""
        return self.bounds_mm[lead.axis + (2 if lead.outward[lead.axis] > 0 else 0)]

    def beside(self, lead: Lead, half_mm: float, from_mm: float, to_mm: float) -> shapely.Polygon:
        """A box so far to either side of a lead, from and to so far outside of the edge that it comes to."""
        corners, out, edge = np.empty((2, 2)), lead.outward[lead.axis], self.edge_mm(lead)
        corners[:, lead.axis] = edge + out * from_mm, edge + out * to_mm
        corners[:, 1 - lead.axis] = lead.turned_mm[1 - lead.axis] + np.array([-half_mm, half_mm])
        return shapely.box(*corners.min(axis=0), *corners.max(axis=0))

    def scaled(self, by: float) -> "Leads":
        """They so many times as large."""
        left, low, right, high = (by * side for side in self.bounds_mm)
        return Leads(tuple((a.scaled(by), b.scaled(by)) for a, b in self.pairs), (left, low, right, high))


def straight_on(ends_mm: Array, layout: Layout, border_mm: float) -> Leads:
    """Leads on the pad's four edges; ends (F, 2, 2) of fibres, mm."""
    none = np.empty((0, 4, 2))
    pairs = []
    for fibre, (start, end) in enumerate(ends_mm):
        along = np.eye(2)[layout.family(fibre)]
        pairs.append((Lead(start, none, -along, border_mm), Lead(end, none, along, border_mm)))
    x, y = (side / 2 + border_mm for side in layout.size_mm)
    return Leads(tuple(pairs), (-x, -y, x, y))


def to_one_side(ends_mm: Array, layout: Layout, room: LeadRoom) -> Leads:
    """Leads that all end on the lower edge; ends (F, 2, 2) of fibres, mm."""
    (half_x, half_y), (horizontals, verticals) = (side / 2 for side in layout.size_mm), layout.counts
    inner = half_x + room.border_mm + room.radius_mm  # of the lowest horizontal, from the middle
    low = -half_y - room.border_mm
    if verticals:
        inner = max(inner, half_x - layout.pitch_x_mm + room.apart_mm)
    if horizontals:
        low = min(low, layout.pitch_y_mm - half_y - room.radius_mm)
    outer = inner + horizontals * room.apart_mm  # of the outermost vertical
    if not horizontals:
        outer = max(half_x + room.border_mm + room.apart_mm, 0.0)
    outer = max(outer, half_x - layout.pitch_x_mm + 2 * room.radius_mm)
    top = half_y + room.border_mm + room.radius_mm
    pairs = []
    for fibre, (start, end) in enumerate(ends_mm):
        if layout.family(fibre):
            number = fibre - horizontals
            left = 2 * number < verticals
            rank = number if left else verticals - 1 - number
            side, away = (-1 if left else 1), rank * room.apart_mm
            corners = [(end[0], top + away), (side * (outer + away), top + away)]
            pairs.append((_down(start, [], low, room.radius_mm), _down(end, corners, low, room.radius_mm)))
        else:
            away = inner + fibre * room.apart_mm
            both = (_down(at, [(x, at[1])], low, room.radius_mm) for at, x in ((start, -away), (end, away)))
            pairs.append((*both,))
    most = (verticals + 1) // 2 - 1
    side = (outer + most * room.apart_mm if verticals else inner + (horizontals - 1) * room.apart_mm) + room.edge_mm
    high = top + most * room.apart_mm + room.edge_mm if verticals else half_y + room.border_mm
    return Leads(tuple(pairs), (-side, low, side, high))


def _down(end_mm: Array, corners: Sequence[tuple[float, float]], low: float, radius: float) -> Lead:
    """From a fibre's end along corners that are rounded, and down from the last of them to the edge at `low`."""
    spans: list[Array] = []
    here = np.array(end_mm, dtype=float)
    stops = [np.array(corner, dtype=float) for corner in corners]
    for corner, after in zip(stops, [*stops[1:], np.array([corners[-1][0], low])] if corners else [], strict=True):
        ahead, onward = (way / np.abs(way).max() for way in (corner - here, after - corner))
        begin = corner - radius * ahead
        if np.abs(begin - here).max() > 0:
            spans.append(here + np.arange(4)[:, None] / 3 * (begin - here))
            spans[-1][-1] = begin
        spans += _quarter(begin, ahead, onward, radius)
        here = spans[-1][-1]
    bent = np.array(spans) if spans else np.empty((0, 4, 2))
    return Lead(np.array(end_mm, dtype=float), bent, np.array([0.0, -1.0]), float(here[1] - low))


def _quarter(begin: Array, ahead: Array, onward: Array, radius: float) -> list[Array]:
    """A quarter of a circle from one direction into another, as two cubics."""
    centre, half = begin + radius * onward, np.sqrt(0.5)
    middle, slanted = centre + radius * half * (ahead - onward), half * (ahead + onward)
    end, reach = centre + radius * ahead, _EIGHTH * radius
    return [
        np.array([begin, begin + reach * ahead, middle - reach * slanted, middle]),
        np.array([middle, middle + reach * slanted, end - reach * onward, end]),
    ]
