"""Toolpaths of a needle that places the fibres of a pad, their checks, and their G-code."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from padforge.design.morphology import Array
from padforge.design.paths.curves import arc_lengths
from padforge.fabricate.checks import Finding, check_result
from padforge.fabricate.plan import FibreLayer, Plan, fibre_layers, without
from padforge.fabricate.settings import DispenserSettings

TOLERANCE_MM = 0.005  # maximum distance of a toolpath from its curve: a tenth of a fine gantry's repeatability
_FLAT_SHARE = 0.2  # fraction of the tolerance for flattening
_SIMPLIFY_SHARE = 0.8  # fraction of the tolerance for simplification, which removes most points
_MAX_TURN = 0.02  # between two samples of the heading, radians
_FEED_STEPS = 10  # feeds are rounded down to tenths of the maximum, which keeps programs readable
_ROUNDING_MM = 1e-9


@dataclass(frozen=True)
class Stroke:
    """The toolpath of one fibre, from the end of its first lead to the end of the second."""

    fibre: int  # index, 0..F-1
    positions_mm: Array  # corners of the path in the frame of the pad turned over; shape (n, 2)
    z_mm: float  # height of the needle's tip, negative within the track
    feeds_mm_s: Array  # speed from each corner to the next; shape (n - 1,)

    @cached_property
    def steps_mm(self) -> Array:
        """Distance from each corner to the next; shape (n - 1,)."""
        return np.hypot(*np.diff(self.positions_mm, axis=0).T)


@dataclass(frozen=True)
class Step:
    """The strokes of one layer in the order of placement; the layer is sealed before the next step."""

    layer: FibreLayer
    strokes: tuple[Stroke, ...]


def plan_toolpath(plan: Plan, diameter_mm: float, max_strain: float = math.inf) -> list[Step]:
    """Compute the toolpath of every fibre of a finished pad, layer by layer from the deepest.

    `diameter_mm` and `max_strain` are those of the fibre.
    """
    lead_mm = plan.settings.mould.lead_mm
    paths, traces = plan.paths(_FLAT_SHARE * TOLERANCE_MM, lead_mm), plan.trace(_MAX_TURN, lead_mm)
    steps = []
    for layer in fibre_layers(plan):
        strokes = []
        for fibre in layer.fibres:
            simplified = shapely.LineString(paths[fibre]).simplify(
                _SIMPLIFY_SHARE * TOLERANCE_MM, preserve_topology=False
            )
            positions, is_corner = _split_ends(shapely.get_coordinates(simplified), diameter_mm)
            radii = _min_bend_radii(*traces[fibre], positions, diameter_mm)
            feeds = _compute_feeds(plan.settings.dispenser, radii, diameter_mm, max_strain)
            is_needed = is_corner | np.concatenate([[True], np.diff(feeds) != 0, [True]])
            z = round(diameter_mm - layer.depth_mm, 9)
            strokes.append(Stroke(fibre, mirror_x(positions[is_needed]), z, feeds[is_needed[:-1]]))
        steps.append(Step(layer, tuple(strokes)))
    return steps


def mirror_x(positions_mm: Array) -> Array:
    """Transform positions (..., 2) between the frames of the plan and of the pad turned over; never -0."""
    return positions_mm * (-1, 1) + 0.0


def _split_ends(positions: Array, end_mm: float) -> tuple[Array, NDArray[np.bool_]]:
    """Split the ends off long segments, which alone are slow next to a bend; points (m, 2), which are original (m,)."""
    steps = np.diff(positions, axis=0)
    length = np.hypot(*steps.T)
    long = np.flatnonzero(length > 4 * end_mm)
    ends = end_mm * steps[long] / length[long, None]
    split = np.stack([positions[long] + ends, positions[long + 1] - ends], axis=1).reshape(-1, 2)
    index = np.repeat(long + 1, 2)
    is_corner = np.insert(np.ones(len(positions), bool), index, False)
    return np.insert(positions, index, split, axis=0), is_corner


def _min_bend_radii(points: Array, headings: Array, positions: Array, diameter_mm: float) -> Array:
    """Compute the minimum bend radius (n - 1,), mm, between successive positions (n, 2) along a trace.

    The radius is the diameter of the fibre, as an arc length, divided by the turn of the heading over that length.
    Pointwise curvature would be meaningless: a PCHIP curve is only C1, and its end slopes differ from the leads'.
    """
    arc = arc_lengths(points)
    turn = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(headings)))])
    corners = np.asarray(shapely.line_locate_point(shapely.LineString(points), shapely.points(positions)))
    half = diameter_mm / 2
    station = half * np.arange(math.ceil(arc[-1] / half) + 2)
    turns = np.interp(station + half, arc, turn) - np.interp(station - half, arc, turn)
    first, last = np.floor(corners[:-1] / half).astype(int), np.ceil(corners[1:] / half).astype(int)
    max_turns = np.maximum.reduceat(turns, np.column_stack([first, last + 1]).ravel())[::2]
    return np.divide(2 * half, max_turns, out=np.full(len(max_turns), np.inf), where=max_turns > 1e-6)


def _compute_feeds(dispenser: DispenserSettings, radii_mm: Array, diameter_mm: float, max_strain: float) -> Array:
    """Compute the speeds (n,), mm/s, in bends of radii (n,), limited by the machine and by the fibre.

    In a bend of radius r the machine needs the acceleration v^2 / r. The outside of a fibre of diameter d is strained
    by d / 2r there, which reduces the strain available for the pull of the feed, assumed proportional to the speed.
    """
    max_feed = dispenser.feed_mm_s
    machine_limit = np.sqrt(dispenser.acceleration_mm_s2 * radii_mm)
    fibre_limit = max_feed * (1 - diameter_mm / (2 * radii_mm * max_strain))
    tenths = np.floor(np.minimum(machine_limit, fibre_limit) / max_feed * _FEED_STEPS + 1e-6)
    return max_feed * np.clip(tenths, 1, _FEED_STEPS) / _FEED_STEPS


def check_toolpath(plan: Plan, steps: Sequence[Step]) -> list[Finding]:
    """Check a toolpath against the dispenser's box and the width of the tracks; positions are in the plan's frame."""
    return [_check_box(plan, steps), _check_tip(plan, steps)]


def _check_box(plan: Plan, steps: Sequence[Step]) -> Finding:
    """Check that all corners lie in the dispenser's box; then so do the straight segments, since a box is convex."""
    dispenser = plan.settings.dispenser
    low, high = np.reshape(dispenser.box_mm, (3, 2)).T
    origin, height = (*dispenser.origin_mm, 0), dispenser.travel_height_mm
    paths = []
    for stroke in (stroke for step in steps for stroke in step.strokes):
        along = np.pad(stroke.positions_mm, ((0, 0), (0, 1)), constant_values=stroke.z_mm)
        start, end = np.pad(stroke.positions_mm[[0, -1]], ((0, 0), (0, 1)), constant_values=height)
        paths.append(np.vstack([start, along, end]))
    margins = [np.minimum(path + origin - low, high - path - origin).min(axis=1) for path in paths]
    margin = float(min(values.min() for values in margins))
    corners = np.vstack(paths)
    extent, allowed = (
        ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", *ends, strict=True))
        for ends in ((corners.min(axis=0) + origin, corners.max(axis=0) + origin), (low, high))
    )
    message = f"the needle goes {extent} mm; its box is {allowed} mm"
    pairs = zip(paths, margins, strict=True)
    worst = [path[np.argmin(values), :2] for path, values in pairs if values.min() < -_ROUNDING_MM]
    positions = mirror_x(np.reshape(worst, (-1, 2)))
    return check_result("dispenser_box", margin >= -_ROUNDING_MM, margin, 0.0, message, positions)


def _check_tip(plan: Plan, steps: Sequence[Step]) -> Finding:
    """Check that the needle, where it is below the surface, fits between the walls of the track."""
    tip = plan.settings.dispenser.tip_mm
    widths, positions = [], []
    for step in steps:
        walls = without(plan.silicone, plan.ridges[step.layer.index])
        shapely.prepare(walls)
        for stroke in (stroke for stroke in step.strokes if stroke.z_mm < 0):
            line = shapely.LineString(mirror_x(stroke.positions_mm))
            widths.append(2 * float(shapely.distance(line, walls)))
            if widths[-1] < tip:
                positions.append(shapely.get_coordinates(shapely.shortest_line(line, walls))[0])
    width = min(widths, default=plan.settings.mould.ridge_width_mm)
    message = f"the needle is {tip:g} mm wide, the narrowest track {width:.3g} mm"
    return check_result("dispenser_tip", not positions, tip, round(width, 6), message, positions)


def gcode(plan: Plan, steps: Sequence[Step]) -> str:
    """Return the G-code of a toolpath, for Marlin and GRBL.

    The operator fastens and cuts every fibre, and seals every layer before the next, during M0, which waits until all
    moves have ended. Coordinates are the machine's; the pad's middle is at the dispenser's origin. The program has no
    G0, which GRBL executes at maximum speed while hands are near. Messages have no brackets, which would end the
    comment, and no number after an s or a p, which firmwares read as a time to wait.
    """
    dispenser = plan.settings.dispenser
    (x, y), height = dispenser.origin_mm, dispenser.travel_height_mm
    program = _Program(dispenser.origin_mm)
    program.lines += [
        *(f"; {line}" for line in _summary_lines(plan, steps)),
        f"; the pad's middle is at X{_format_mm(x)} Y{_format_mm(y)};"
        " set zero of z by G92 Z0 (Marlin), G10 L20 P1 Z0 (GRBL)",
        "G21",
        "G90",
        "M0 (needle over the pad, zero of z is set)",
        f"G1 Z{_format_mm(height)} F{_format_feed(dispenser.travel_mm_s)}",
    ]
    for number, step in enumerate(steps, 1):
        for stroke in step.strokes:
            name = f"fibre {stroke.fibre + 1}, {plan.pad.layout.fibre_name(stroke.fibre)}"
            (start_x, start_y), *corners = stroke.positions_mm.tolist()
            end_x, end_y = corners[-1]
            program.move_to(start_x, start_y, height, dispenser.travel_mm_s)
            program.move_to(start_x, start_y, stroke.z_mm, dispenser.feed_mm_s)
            program.lines.append(f"M0 ({name}: fasten its end under the needle)")
            for (u, v), feed in zip(corners, stroke.feeds_mm_s.tolist(), strict=True):
                program.move_to(u, v, stroke.z_mm, feed)
            program.lines.append(f"M0 ({name}: cut it at the needle)")
            program.move_to(end_x, end_y, height, dispenser.travel_mm_s)
        depth = f"{step.layer.depth_mm:.3g} mm deep"
        program.lines.append(f"M0 (layer {number} of {len(steps)}, {depth}: seal it and let it cure)")
    return "\n".join([*program.lines, ""])


class _Program:
    """Lines of G-code; moves list only the coordinates and the feed that change."""

    def __init__(self, origin_mm: tuple[float, float]) -> None:
        self.lines: list[str] = []
        self._origin_mm = origin_mm
        self._words: dict[str, str] = {}  # of the last move

    def move_to(self, x_mm: float, y_mm: float, z_mm: float, speed_mm_s: float) -> None:
        """Add a straight move to a position in the pad's frame, unless the needle is there already."""
        x0, y0 = self._origin_mm
        axes = {"X": _format_mm(x0 + x_mm), "Y": _format_mm(y0 + y_mm), "Z": _format_mm(z_mm)}
        target = axes | {"F": _format_feed(speed_mm_s)}
        changed = [letter + number for letter, number in target.items() if self._words.get(letter) != number]
        if any(word[0] != "F" for word in changed):
            self.lines.append(" ".join(["G1", *changed]))
            self._words = target


def _summary_lines(plan: Plan, steps: Sequence[Step]) -> Iterator[str]:
    """Yield the comments at the head of a program, for the operator."""
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


def _format_mm(value_mm: float) -> str:
    """Format a coordinate, rounded to a micrometre and never -0."""
    return f"{round(value_mm, 3) + 0.0:.10g}"


def _format_feed(speed_mm_s: float) -> str:
    return f"{max(1, round(60 * speed_mm_s))}"  # mm/min; firmwares ignore a feed of 0
