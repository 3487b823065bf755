"""What a machine is told, one thing after the other, whatever language it speaks: ways, and pauses for the person."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from padforge.design.morphology import Array
from padforge.fabricate.checks import Finding, check_result
from padforge.fabricate.plan import FibreLayer, Plan, fibre_layers, fibre_name, without
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
        positions_mm: (n, 2) corners of the way, in the frame of the pad turned over.
        z_mm: height of the needle's mouth, negative within the track.
        feeds_mm_s: (n - 1,) speed from each corner to the next.
    """

    fibre: int
    positions_mm: Array
    z_mm: float
    feeds_mm_s: Array

    @cached_property
    def steps_mm(self) -> Array:
        """(n - 1,) distance from each corner to the next."""
        return np.hypot(*np.diff(self.positions_mm, axis=0).T)


@dataclass(frozen=True)
class Step:
    """The fibres of one depth in the order they are laid; they are sealed before the next step."""

    layer: FibreLayer
    strokes: tuple[Stroke, ...]


def laying_steps(plan: Plan, diameter_mm: float, max_strain: float = math.inf) -> list[Step]:
    """The way of the needle, in the order of the laying page: the deepest step first.

    Args:
        plan: of the mould, with the leads and the dispenser of its settings.
        diameter_mm: of the fibre.
        max_strain: elongation that the fibre bears, 1 for twice its length; inf where nobody knows.
    """
    courses = plan.paths(_FLAT_SHARE * TOLERANCE_MM, plan.settings.mould.lead_mm)
    bends = _Bends(plan, diameter_mm)
    steps = []
    for layer in fibre_layers(plan):
        strokes = []
        for fibre in layer.fibres:
            whole = shapely.LineString(courses[fibre])
            thinned = whole.simplify(_THINNED_SHARE * TOLERANCE_MM, preserve_topology=False)
            places, corner = _with_ends(shapely.get_coordinates(thinned), diameter_mm)
            radii = bends.least_radii(fibre, places)
            feeds = _feeds(plan.settings.dispenser, radii, diameter_mm, max_strain)
            kept = corner | np.concatenate([[True], np.diff(feeds) != 0, [True]])
            z = round(diameter_mm - layer.depth_mm, 9)
            strokes.append(Stroke(fibre, turned_over(places[kept]), z, feeds[kept[:-1]]))
        steps.append(Step(layer, tuple(strokes)))
    return steps


def turned_over(positions_mm: Array) -> Array:
    """Places (..., 2) of the plan as they lie on the pad turned over, and the other way round; no -0."""
    return positions_mm * (-1, 1) + 0.0


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
        return self.plan.trace(_TURN, self.plan.settings.mould.lead_mm)

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


def _feeds(dispenser: DispenserSettings, radii_mm: Array, diameter_mm: float, max_strain: float) -> Array:
    """(n,) speed in bends of radii (n,), mm/s: what the machine and what the fibre can follow, the slower of both.

    In a bend of radius r the machine needs v^2 / r of acceleration; and the outside of a fibre is stretched by
    d / 2r, so that less of what it bears is left for the pull of the feed, which grows with the speed.
    """
    most = dispenser.feed_mm_s
    of_machine = np.sqrt(dispenser.acceleration_mm_s2 * radii_mm)
    of_fibre = most * (1 - diameter_mm / (2 * radii_mm * max_strain))
    tenths = np.floor(np.minimum(of_machine, of_fibre) / most * _FEED_STEPS + 1e-6)
    return most * np.clip(tenths, 1, _FEED_STEPS) / _FEED_STEPS


_SLACK_MM = 1e-9
"""Rounding of sums that come out even."""


def check_course(plan: Plan, steps: Sequence[Step]) -> list[Finding]:
    """What could stop the needle, with places in the frame of the plan."""
    return [_box(plan, steps), _tip(plan, steps)]


def _box(plan: Plan, steps: Sequence[Step]) -> Finding:
    """All ways are straight from corner to corner: a box that holds the corners holds them all."""
    dispenser = plan.settings.dispenser
    low, high = np.reshape(dispenser.box_mm, (3, 2)).T
    ways = [_corners(stroke, dispenser.travel_height_mm) for step in steps for stroke in step.strokes]
    origin = (*dispenser.origin_mm, 0)
    rooms = [np.minimum(way + origin - low, high - way - origin).min(axis=1) for way in ways]
    room = float(min(each.min() for each in rooms))
    least, most = np.vstack(ways).min(axis=0) + origin, np.vstack(ways).max(axis=0) + origin
    extent, allowed = (
        ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", *ends, strict=True))
        for ends in ((least, most), (low, high))
    )
    message = f"the needle goes {extent} mm; its box is {allowed} mm"
    inside = room >= -_SLACK_MM
    worst = [way[np.argmin(each), :2] for way, each in zip(ways, rooms, strict=True) if each.min() < -_SLACK_MM]
    return check_result("dispenser_box", inside, room, 0.0, message, turned_over(np.reshape(worst, (-1, 2))))


def _corners(stroke: Stroke, height_mm: float) -> Array:
    """(n + 2, 3) corners of the way to a fibre, along it and up again, mm in the frame of the pad turned over."""
    along = np.pad(stroke.positions_mm, ((0, 0), (0, 1)), constant_values=stroke.z_mm)
    above = np.pad(stroke.positions_mm[[0, -1]], ((0, 0), (0, 1)), constant_values=height_mm)
    return np.vstack([above[:1], along, above[1:]])


def _tip(plan: Plan, steps: Sequence[Step]) -> Finding:
    """Where it is below the surface the needle must have room between the walls of the track, at its narrowest."""
    tip = plan.settings.dispenser.tip_mm
    rooms, places = [], []
    for step in steps:
        walls = without(plan.silicone, plan.ridges[step.layer.index])
        shapely.prepare(walls)
        for stroke in (each for each in step.strokes if each.z_mm < 0):
            line = shapely.LineString(turned_over(stroke.positions_mm))
            rooms.append(2 * float(shapely.distance(line, walls)))
            if rooms[-1] < tip:
                places.append(shapely.get_coordinates(shapely.shortest_line(line, walls))[0])
    room = min(rooms, default=plan.settings.mould.ridge_width_mm)
    message = f"the needle is {tip:g} mm wide, the narrowest track {room:.3g} mm"
    return check_result("dispenser_tip", not places, tip, round(room, 6), message, places)


Place = tuple[float, float, float]
"""(x, y, z) in mm, in the frame of the pad turned over."""


@dataclass(frozen=True)
class Go:
    """Straight to a place with the needle empty, above the pad or beside it."""

    place: Place
    speed_mm_s: float


@dataclass(frozen=True)
class Lay:
    """Along a fibre, from where the stroke begins."""

    stroke: Stroke


@dataclass(frozen=True)
class Pause:
    """Wait until the person has done what the message says."""

    message: str


Instruction = Go | Lay | Pause


def instructions(plan: Plan, steps: Sequence[Step]) -> Iterator[Instruction]:
    """The whole work: every fibre is fastened, laid and cut, every step sealed before the next.

    In a message stand no brackets, and no number after an s or a p: firmwares take the one for the end of a comment,
    the other for a time to wait.
    """
    dispenser = plan.settings.dispenser
    height = dispenser.travel_height_mm
    for number, step in enumerate(steps, 1):
        for stroke in step.strokes:
            name = f"fibre {stroke.fibre + 1}, {fibre_name(plan, stroke.fibre)}"
            (start_x, start_y), (end_x, end_y) = stroke.positions_mm[[0, -1]].tolist()
            yield Go((start_x, start_y, height), dispenser.travel_mm_s)
            yield Go((start_x, start_y, stroke.z_mm), dispenser.feed_mm_s)
            yield Pause(f"{name}: fasten its end under the needle")
            yield Lay(stroke)
            yield Pause(f"{name}: cut it at the needle")
            yield Go((end_x, end_y, height), dispenser.travel_mm_s)
        yield Pause(f"layer {number} of {len(steps)}, {step.layer.depth_mm:.3g} mm deep: seal it and let it cure")


def summary_lines(plan: Plan, steps: Sequence[Step]) -> Iterator[str]:
    """What stands at the head of every program, for whoever starts it."""
    strokes = [stroke for step in steps for stroke in step.strokes]
    length = sum(float(stroke.steps_mm.sum()) for stroke in strokes)
    seconds = sum(float((stroke.steps_mm / stroke.feeds_mm_s).sum()) for stroke in strokes)
    lowest = min(stroke.z_mm for stroke in strokes)
    yield "padforge: the fibres of a pad, laid by a needle"
    yield f"{len(strokes)} fibres in {len(steps)} layers, {length / 1000:.2f} m; {seconds / 60:.1f} minutes of laying"
    yield "the pad lies turned over, left to right, with its tracks up, on a flat plate"
    near = "on the right, nearest"
    if plan.settings.pad.leads == "one side":
        near = "at the near edge"
    elif not plan.pad.layout.horizontals:
        near = "on the right, at the near side"
    yield f"seen from above: x to the right, against the pad's, y away from you; fibre 1 starts {near}"
    yield f"z is 0 where the needle touches the upper face; it goes down to {lowest:.3f} mm"
    yield f"needle of at most {plan.settings.dispenser.tip_mm:g} mm, pad {plan.thickness_mm:.3g} mm thick"
