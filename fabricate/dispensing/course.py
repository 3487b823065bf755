"""The way of a needle that lays the fibres: along which places, how deep, and how fast.

The needle is narrower than a track and goes down into it; the fibre runs through it and leaves it at its mouth, one
diameter above the bottom of the track, so that it comes to lie there. A needle is round: nothing has to turn with the
course. Tracks are open upwards and at the pad's sides, so the needle goes in at one side at the depth of the level and
out at the other, in one plane, and meets no silicone; whether it is narrow enough is for `clearance` to say.

The frame is that of the casting turned over, left to right: from the pad's middle, mm, x to the right (against that of
the plan), y away from whoever lays it, z up from the upper face, in which the tracks are.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from padforge.design.morphology import Array
from padforge.fabricate.mould.plan import Plan
from padforge.fabricate.report.fibre_layers import Layer, layers
from padforge.fabricate.settings import DispenserSettings

TOLERANCE_MM = 0.005
"""How far the straight pieces of a course may lie from the curve: a tenth of what a fine gantry repeats."""
_FLAT_SHARE, _THINNED_SHARE = 0.2, 0.8
"""How the tolerance is shared: most thins out the points."""
_TURN = 0.02
"""Between two points at which the heading is known a curve turns by no more, radians."""
_STRAIGHT = 1e-6
"""What turns less is straight, radians."""
_MOST_STATIONS = 100_000
"""At no more places of a fibre its bend is looked at."""
_FEED_STEPS = 10
"""Feeds are whole tenths of the greatest, rounded down: a program that can be read."""


@dataclass(frozen=True)
class Stroke:
    """One fibre as the needle lays it, from the end of its first lead to the end of its other.

    Attributes:
        fibre: its number among all, 0..F-1.
        places_mm: (n, 2) corners of the way, in the frame of the pad turned over.
        z_mm: height of the needle's mouth, negative within the track.
        feeds_mm_s: (n - 1,) speed from each corner to the next.
    """

    fibre: int
    places_mm: Array
    z_mm: float
    feeds_mm_s: Array

    @cached_property
    def steps_mm(self) -> Array:
        """(n - 1,) distance from each corner to the next."""
        return np.hypot(*np.diff(self.places_mm, axis=0).T)


@dataclass(frozen=True)
class Step:
    """The fibres of one depth in the order they are laid; they are sealed before the next step."""

    layer: Layer
    strokes: tuple[Stroke, ...]


def laying_steps(plan: Plan, diameter_mm: float, largest_stretch: float = math.inf) -> list[Step]:
    """The way of the needle, in the order of the laying page: the deepest step first.

    Args:
        plan: of the mould, with the leads and the dispenser of its settings.
        diameter_mm: of the fibre.
        largest_stretch: elongation that the fibre bears, 1 for twice its length; inf where nobody knows.
    """
    courses = plan.courses(_FLAT_SHARE * TOLERANCE_MM, plan.settings.mould.lead_mm)
    bends = _Bends(plan, diameter_mm)
    steps = []
    for layer in layers(plan):
        strokes = []
        for fibre in layer.fibres:
            whole = shapely.LineString(courses[fibre])
            thinned = whole.simplify(_THINNED_SHARE * TOLERANCE_MM, preserve_topology=False)
            places, corner = _with_ends(shapely.get_coordinates(thinned), diameter_mm)
            radii = bends.least_radii(fibre, places)
            feeds = _feeds(plan.settings.dispenser, radii, diameter_mm, largest_stretch)
            kept = corner | np.concatenate([[True], np.diff(feeds) != 0, [True]])
            z = round(diameter_mm - layer.depth_mm, 9)
            strokes.append(Stroke(fibre, turned_over(places[kept]), z, feeds[kept[:-1]]))
        steps.append(Step(layer, tuple(strokes)))
    return steps


def turned_over(places_mm: Array) -> Array:
    """Places (..., 2) of the plan as they lie on the pad turned over, and the other way round; no -0."""
    return places_mm * (-1, 1) + 0.0


def _with_ends(places: Array, end_mm: float) -> tuple[Array, NDArray[np.bool_]]:
    """The corners (n, 2) of a course, with ends of long pieces split off, and which of all are corners.

    So a long piece is slow only at the end next to a bend.
    """
    steps = np.diff(places, axis=0)
    length = np.hypot(*steps.T)
    long = np.flatnonzero(length > 4 * end_mm)
    ends = end_mm * steps[long] / length[long, None]
    split = np.stack([places[long] + ends, places[long + 1] - ends], axis=1).reshape(-1, 2)
    at = np.repeat(long + 1, 2)
    return np.insert(places, at, split, axis=0), np.insert(np.ones(len(places), bool), at, False)


@dataclass(frozen=True)
class _Bends:
    """How the fibres of a plan bend."""

    plan: Plan
    diameter_mm: float

    @cached_property
    def traced(self) -> list[tuple[Array, Array]]:
        """Of every fibre and its leads points (n, 2), mm, and the heading at each, radians."""
        return self.plan.traced(_TURN, self.plan.settings.mould.lead_mm)

    def least_radii(self, fibre: int, places: Array) -> Array:
        """(n - 1,) least bend radius, mm, between each two of n places (n, 2) along a fibre and its leads.

        A fibre bends over no less than its own diameter: a radius is that length by the angle it turns there. A PCHIP
        curve is only C1, and the slope of its ends is not that of the leads: pointwise curvature says nothing.
        """
        points, headings = self.traced[fibre]
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(headings)))])
        corners = np.asarray(shapely.line_locate_point(shapely.LineString(points), shapely.points(places)))
        half = max(self.diameter_mm / 2, arc[-1] / _MOST_STATIONS)
        station = half * np.arange(math.ceil(arc[-1] / half) + 2)
        turns = np.interp(station + half, arc, turned) - np.interp(station - half, arc, turned)
        first = np.floor(corners[:-1] / half).astype(int)
        last = np.ceil(corners[1:] / half).astype(int)
        most = np.maximum.reduceat(turns, np.column_stack([first, last + 1]).ravel())[::2]
        return np.divide(2 * half, most, out=np.full(len(most), np.inf), where=most > _STRAIGHT)


def _feeds(dispenser: DispenserSettings, radii_mm: Array, diameter_mm: float, largest_stretch: float) -> Array:
    """(n,) speed in bends of radii (n,), mm/s: what the machine and what the fibre can follow, the slower of both.

    In a bend of radius r the machine needs v^2 / r of acceleration; and the outside of a fibre is stretched by
    d / 2r, so that less of what it bears is left for the pull of the feed, which grows with the speed.
    """
    most = dispenser.feed_mm_s
    of_machine = np.sqrt(dispenser.acceleration_mm_s2 * radii_mm)
    of_fibre = most * (1 - diameter_mm / (2 * radii_mm * largest_stretch))
    tenths = np.floor(np.minimum(of_machine, of_fibre) / most * _FEED_STEPS + 1e-6)
    return most * np.clip(tenths, 1, _FEED_STEPS) / _FEED_STEPS
