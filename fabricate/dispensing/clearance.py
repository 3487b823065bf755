"""Whether the needle can go its way: within the envelope of the machine, and nowhere through silicone."""

from collections.abc import Sequence

import numpy as np
import shapely

from padforge.design.morphology import Array
from padforge.fabricate.checks.findings import Finding, verdict
from padforge.fabricate.mould.plan import Plan, without

from .course import Step, Stroke, turned_over

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
    return verdict("dispenser_box", inside, room, 0.0, message, turned_over(np.reshape(worst, (-1, 2))))


def _corners(stroke: Stroke, height_mm: float) -> Array:
    """(n + 2, 3) corners of the way to a fibre, along it and up again, mm in the frame of the pad turned over."""
    along = np.pad(stroke.places_mm, ((0, 0), (0, 1)), constant_values=stroke.z_mm)
    above = np.pad(stroke.places_mm[[0, -1]], ((0, 0), (0, 1)), constant_values=height_mm)
    return np.vstack([above[:1], along, above[1:]])


def _tip(plan: Plan, steps: Sequence[Step]) -> Finding:
    """Where it is below the surface the needle must have room between the walls of the track, at its narrowest."""
    tip = plan.settings.dispenser.tip_mm
    rooms, places = [], []
    for step in steps:
        walls = without(plan.silicone, plan.ridges[step.layer.level])
        shapely.prepare(walls)
        for stroke in (each for each in step.strokes if each.z_mm < 0):
            line = shapely.LineString(turned_over(stroke.places_mm))
            rooms.append(2 * float(shapely.distance(line, walls)))
            if rooms[-1] < tip:
                places.append(shapely.get_coordinates(shapely.shortest_line(line, walls))[0])
    room = min(rooms, default=plan.settings.mould.ridge_width_mm)
    message = f"the needle is {tip:g} mm wide, the narrowest track {room:.3g} mm"
    return verdict("dispenser_tip", not places, tip, round(room, 6), message, places)
