"""The bodies of a mould, put together from their parts.

z = 0 is the underside of a body, which lies on the print bed; the tray's floor has its top at `floor_mm`. Lengths
are mm.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import shapely
from shapely.geometry.base import BaseGeometry

from design.common.errors import InputError

from . import parts
from .plan import Plan, square
from .prisms import Body, Prism

if TYPE_CHECKING:
    from manifold3d import Manifold

WELL_MM = 3.0
"""Diameter of the wells for conductive material."""
_WELL_RIM_MM = 1.0
"""Silicone around a well."""
_VENT_INSET_MM = 3.0
"""How far from the cavity's rim the lid's vents lie."""
LID_MM = 3.0
"""Thickness of the lid."""
HOLDER_WALL_MM = 1.0
"""Height of the holder's walls above its floor: far below the pad's surface, so that no probe meets them."""
HOLDER_PLAY_MM = 0.2
"""Room on every side of the pad in its holder."""


def plan_mesh(plan: Plan) -> "Manifold":
    """The mould of a plan as a manifold3d mesh."""
    from .mesh import mesh

    return mesh(mould_body(plan))


def mould_body(plan: Plan, wells: Sequence[BaseGeometry] = ()) -> Body:
    """The inverse mould: tray, ridges, exits, numbers and pins.

    Args:
        wells: outlines that belong to the ridges of each level, mm; none for a pad whose fibres are laid.

    Raises:
        InputError: pins that find no room on the walls.
    """
    mould = plan.settings.mould
    floor, hollows = mould.floor_mm, [plan.cavity, *plan.exits]
    body = parts.tray(plan.tray, hollows, floor_mm=floor, depth_mm=plan.silicone_mm, flare_mm=plan.flare_mm)
    for level, height in enumerate(plan.heights_mm):

        def outline(below: float, level: int = level) -> BaseGeometry:
            if below:
                return plan.outline(level, below)
            return plan.ridges[level] | wells[level] if wells else plan.ridges[level]

        ridges = parts.ridge(outline, floor_mm=floor, height_mm=height, terrace_mm=plan.settings.terrace_mm)
        body = body.with_adds(ridges)
    written = [outline for outline in plan.numbers if outline is not None]
    body = body.with_adds(parts.numeral_prisms(written, floor_mm=floor, height_mm=mould.shallow_ridge_height_mm))
    if mould.pins:
        body = body.with_adds(pins(plan))
    return body


def pins(plan: Plan) -> list[Prism]:
    """The registration pins, sunk into the walls by `parts.INTO_FLOOR_MM`.

    Raises:
        InputError: they find no room on the walls.
    """
    top = plan.settings.mould.floor_mm + plan.silicone_mm
    return parts.pins(_pin_places(plan), top_mm=top, diameter_mm=_pin_mm(plan))


def sizes(plan: Plan) -> dict[str, float]:
    """What pad and mould came out as, mm: where the settings leave it open or the pad needs more than they say."""
    printed = plan.enlarged
    mould, edge = printed.settings.mould, printed.cavity.bounds[2]
    achieved = {
        "pad_mm": 2 * plan.cavity.bounds[2],
        "pad_thickness_mm": plan.thickness_mm,
        "cavity_mm": 2 * edge,
        "cavity_depth_mm": printed.silicone_mm,
        "rim_mm": 2 * (edge + printed.flare_mm),
        "tray_mm": 2 * printed.tray.bounds[2],
        "tray_height_mm": mould.floor_mm + printed.silicone_mm,
        "ridge_foot_mm": mould.ridge_width_mm + 2 * printed.heights_mm[-1] * printed.settings.ridge_slope,
    }
    if mould.pins:
        achieved["pin_mm"] = _pin_mm(printed)
    if mould.lid:
        achieved["lid_mm"] = LID_MM
    if mould.conductive:
        achieved["well_mm"] = WELL_MM
    return {name: round(size, 6) for name, size in achieved.items()}


def lid_body(plan: Plan) -> Body:
    """The lid that lies on the tray's walls; its holes fit the pins, if there are any.

    Raises:
        InputError: a pad too small for vents beside the spout.
    """
    mould, edge = plan.settings.mould, plan.cavity.bounds[2]
    inset = edge - min(_VENT_INSET_MM, edge / 2)
    least = (parts.spout_mm() + parts.VENT_MM) / math.sqrt(2)
    if mould.spout and 2 * inset < least:
        from_mm = least + 2 * _VENT_INSET_MM
        raise InputError(f"[mould] spout: got true for a pad {2 * edge:.4g} mm wide, allowed from {from_mm:.4g} mm")
    body = parts.lid(
        plan.tray,
        [(x, y) for x in (-inset, inset) for y in (-inset, inset)],
        thickness_mm=LID_MM,
        pin_places=_pin_places(plan) if mould.pins else (),
        pin_mm=_pin_mm(plan) if mould.pins else 0.0,
    )
    return parts.spout(body, thickness_mm=LID_MM) if mould.spout else body


def lid_holes(plan: Plan) -> int:
    """How many holes lead through the lid: vents, those for pins, and the spout."""
    mould = plan.settings.mould
    return 4 + 3 * mould.pins + mould.spout


def holder_body(plan: Plan) -> Body:
    """The tray in which the finished pad lies as it was laid: tracks up, turned over left to right.

    Slots let the leads out. The corner where the first horizontal and the first vertical fibre start is cut. Ends of
    fibres are level with each other, so that the slots are the same seen from either side.
    """
    mould, out, cut = plan.settings.mould, plan.tray.bounds[2], plan.corner_mm
    play = plan.flare_mm + HOLDER_PLAY_MM  # what lies below was the rim of the casting, wider than its tracks' side
    half = mould.exit_width_mm / 2 + play
    slots = []
    for fibre, line in enumerate(plan.lines):
        across = line.coords[0][1 - plan.family(fibre)], line.coords[-1][1 - plan.family(fibre)]
        for side, middle in zip((-1, 1), across, strict=True):
            along, beside = sorted((0.0, side * (out + 1))), (middle - half, middle + half)
            (x0, x1), (y0, y1) = (beside, along) if plan.family(fibre) else (along, beside)
            slots.append(shapely.box(x0, y0, x1, y1))
    marked = plan.tray - shapely.Polygon([(out, -out), (out - cut, -out), (out, cut - out)])
    hollow = shapely.union_all([square(plan.cavity.bounds[2] + play), *slots])
    return parts.tray(marked, [hollow], floor_mm=mould.floor_mm, depth_mm=HOLDER_WALL_MM)


def bed_frame(plan: Plan) -> dict[str, bool | float | list[float]]:
    """Where the pad lies while its holder stands where a slicer puts it, in the middle of the bed; mm and degrees.

    Returns:
        "bed_mm": width, depth and height of the printer. "centre_mm": of the pad, x and y. "angle_deg": from the bed's
        y axis to the pad's. "mirrored": that the pad lies with its tracks up, its x axis against that of the bed.
        "pad_mm": side of the pad. "surface_mm", "walls_mm": of the pad and of the holder's walls above the bed.
    """
    floor_mm, bed_mm = plan.settings.mould.floor_mm, plan.settings.printer.bed_mm
    return {
        "bed_mm": list(bed_mm),
        "centre_mm": [side / 2 for side in bed_mm[:2]],
        "angle_deg": 0.0,
        "mirrored": True,
        "pad_mm": round(2 * plan.cavity.bounds[2], 6),
        "surface_mm": round(floor_mm + plan.thickness_mm, 6),
        "walls_mm": round(floor_mm + HOLDER_WALL_MM, 6),
    }


def conductive_plan(plan: Plan) -> Plan:
    """The plan of the second mould: exits large enough for wells, everything else alike.

    Raises:
        InputError: exits that large do not fit the pitch.
    """
    side = WELL_MM + 2 * _WELL_RIM_MM
    mould = plan.settings.mould.model_copy(update={"exit_mm": side, "exit_width_mm": side})
    return replace(plan, settings=replace(plan.settings, mould=mould))


def conductive_body(plan: Plan) -> Body:
    """The mould whose casting has a well at both ends of every track.

    Args:
        plan: of the second mould.
    """
    return mould_body(plan, well_outlines(plan))


def well_outlines(plan: Plan, sides: int = 64) -> list[BaseGeometry]:
    """The outlines of the wells at the ends of the ridges of every level, as polygons of so many sides, mm."""
    away = plan.cavity.bounds[2] + _WELL_RIM_MM + WELL_MM / 2
    places: list[list[tuple[float, float]]] = [[] for _ in plan.heights_mm]
    for fibre, line in enumerate(plan.lines):
        for end, side in ((0, -away), (-1, away)):
            across = line.coords[end][1 - plan.family(fibre)]
            places[plan.levels[fibre]].append((across, side) if plan.family(fibre) else (side, across))
    return [parts.wells(own, diameter_mm=WELL_MM, sides=sides) for own in places]


def _pin_mm(plan: Plan) -> float:
    """Diameter of the pins: half of the corner they stand on, in tenths of a millimetre."""
    diameter = int(5 * plan.corner_mm + 1e-9) / 10
    if diameter < 1:
        raise InputError(
            f"[mould] pins: the walls' corners are {plan.corner_mm:g} mm wide, allowed are 2 mm or more"
            " (wall_mm + exit_mm)"
        )
    return diameter


def _pin_places(plan: Plan) -> list[tuple[float, float]]:
    """Three corners of the tray, so that a lid fits one way only."""
    away = plan.tray.bounds[2] - plan.corner_mm / 2
    return [(-away, -away), (away, -away), (-away, away)]
