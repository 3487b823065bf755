"""Printed bodies as unions and differences of prisms: mould, lid, mould for conductive material, and holder.

z = 0 is the underside of a body, on the print bed; the top of the tray's floor is at `floor_mm`. Lengths are mm.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.common.validation import InputError
from padforge.fabricate.plan import Plan, offset_box
from padforge.fabricate.settings import WELL_MM, WELL_RIM_MM, WELL_SLOT_MM

# printed bodies, and their colours in CAD programs and slicers
BODY_COLOURS = {"mould": "#8FA3B8", "lid": "#D9C27E", "conductive": "#6F8F72", "holder": "#B0886E"}
INTO_FLOOR_MM = 0.2  # overlap of a part with the solid below it, so that no two faces coincide
LID_MM = 3.0  # thickness of the lid
_VENT_MM = 1.5  # diameter of the lid's vents
_VENT_INSET_MM = 3.0  # distance of the vents from the cavity's rim
_BORE_MM = 6.0  # diameter of the spout's bore
_FUNNEL_MM = 6.0  # height of the spout's funnel
_FUNNEL_WALL_MM = 2.0
_FUNNEL_FLARE_MM = _FUNNEL_MM * math.tan(math.radians(30.0))  # increase of the funnel's radius up to its top
_PIN_CLEARANCE_MM = 0.3  # difference in diameter between the lid's holes and the pins
HOLDER_WALL_MM = 1.0  # height of the holder's walls above its floor, far below the pad's surface and any probe
HOLDER_PLAY_MM = 0.2  # clearance on every side of the pad in its holder

Position = tuple[float, float]


@dataclass(frozen=True)
class Prism:
    """A vertical prism, or a frustum."""

    area: BaseGeometry  # outline at the bottom, mm
    bottom_mm: float
    top_mm: float
    flare_mm: float = 0.0  # outward offset of the outline at the top; only for rectangles and regular polygons


@dataclass(frozen=True)
class Body:
    """The union of `base`, minus `cuts`, plus `adds`, in this order."""

    base: tuple[Prism, ...]
    cuts: tuple[Prism, ...] = ()
    adds: tuple[Prism, ...] = ()


def cylinder(x: float, y: float, diameter_mm: float, sides: int = 64) -> shapely.Polygon:
    """Return a regular polygon for a vertical cylinder around (x, y), mm; with 64 sides its error is 0.13 %."""
    return shapely.Point(x, y).buffer(diameter_mm / 2, quad_segs=sides // 4)


def _tray(outline: BaseGeometry, hollows: Iterable[BaseGeometry], floor: float, depth: float, flare: float = 0) -> Body:
    """Build an open tray with rectangular hollows; their walls lean outwards by `flare` from floor to rim."""
    rim, flare_per_mm = floor + depth, flare / depth
    cuts = tuple(Prism(hollow, floor, rim + 1, flare + flare_per_mm) for hollow in hollows)  # to 1 mm above the rim
    return Body((Prism(outline, 0, rim),), cuts)


def terraces(height_mm: float, terrace_mm: float) -> list[float]:
    """Return the distances of a ridge's terraces below its top, mm: 0, then one for every `terrace_mm` of height."""
    return [0.0, *np.arange(terrace_mm, height_mm - 1e-6, terrace_mm).tolist()] if terrace_mm < height_mm else [0.0]


def mould_body(plan: Plan, wells: Sequence[BaseGeometry] = ()) -> Body:
    """Build the mould of a compensated plan: tray, ridges with wells if any, exits, numbers, pillars and pins."""
    ridges = []
    for layer, fibres in enumerate(plan.layers):
        top_outline = (plan.ridges[layer] | wells[layer]) if wells else plan.ridges[layer]
        ridges += ridge_prisms(plan, fibres, top_outline)
    tray = tray_body(plan)
    return replace(tray, adds=(*ridges, *(number for number in number_prisms(plan) if number), *tray.adds))


def tray_body(plan: Plan) -> Body:
    """Build the tray of a mould with exits, pillars and pins, without ridges."""
    floor, rim = plan.settings.mould.floor_mm, plan.settings.mould.floor_mm + plan.silicone_mm
    tray = _tray(plan.tray, [plan.cavity, *plan.exits], floor, plan.silicone_mm, plan.flare_mm)
    pillars = [Prism(outline, floor - INTO_FLOOR_MM, rim) for outline in shapely.get_parts(plan.pillars)]
    pillars += [Prism(head, floor - INTO_FLOOR_MM, floor + plan.head_mm) for head in plan.heads]
    return replace(tray, adds=(*pillars, *(registration_pins(plan) if plan.settings.mould.pins else ())))


def ridge_prisms(
    plan: Plan, fibres: Sequence[int], top_outline: BaseGeometry, tolerance_mm: float | None = None
) -> list[Prism]:
    """Build the terraces of the ridges of some fibres of a layer, the upper first; a ridge without taper has one.

    `top_outline` is the outline of the uppermost terrace. The outlines of the others deviate by at most `tolerance_mm`,
    by default that of the settings.
    """
    floor, height = plan.settings.mould.floor_mm, plan.heights_mm[plan.layer_indices[fibres[0]]]
    prisms = []
    for below in terraces(height, plan.settings.terrace_mm):  # a sloping side is printed as steps
        outline = plan.outline(fibres, below, tolerance_mm) if below else top_outline
        prisms.append(Prism(outline, floor - INTO_FLOOR_MM, floor + height - below))
    return prisms


def number_prisms(plan: Plan) -> list[Prism | None]:
    """Build the number of every fibre; None if it does not fit; [] if numbers are disabled."""
    floor = plan.settings.mould.floor_mm
    top = floor + plan.settings.mould.shallow_ridge_height_mm
    return [Prism(number, floor - INTO_FLOOR_MM, top) if number else None for number in plan.numbers]


def registration_pins(plan: Plan) -> list[Prism]:
    """Build the registration pins, as high as they are wide, sunk into the walls by `INTO_FLOOR_MM`."""
    rim, pin = plan.settings.mould.floor_mm + plan.silicone_mm, _pin_mm(plan)
    return [Prism(cylinder(x, y, pin), rim - INTO_FLOOR_MM, rim + pin) for x, y in _pin_positions(plan)]


def _pin_mm(plan: Plan) -> float:
    """Return the diameter of the pins: half the width of their corner, rounded down to 0.1 mm.

    Raises:
        InputError: they do not fit on the walls.
    """
    diameter = int(5 * plan.corner_mm + 1e-9) / 10
    if diameter < 1:
        raise InputError(
            f"[mould] pins: the walls' corners are {plan.corner_mm:g} mm wide, allowed are 2 mm or more"
            " (wall_mm + exit_mm)"
        )
    return diameter


def _pin_positions(plan: Plan) -> list[Position]:
    """Return the middles of three corners of the tray, so that a lid fits in one orientation only."""
    x_min, y_min, x_max, y_max = offset_box(plan.tray, -plan.corner_mm / 2).bounds
    return [(x_min, y_min), (x_max, y_min), (x_min, y_max)]


def conductive_plan(plan: Plan) -> Plan:
    """Return the plan of the mould for conductive material, with exits large enough for wells."""
    mould = plan.settings.mould.model_copy(update={"exit_mm": WELL_SLOT_MM, "exit_width_mm": WELL_SLOT_MM})
    return replace(plan, settings=replace(plan.settings, mould=mould))


def well_outlines(plan: Plan) -> list[BaseGeometry]:
    """Return the outlines of the wells at the ends of the ridges of every layer, as regular polygons, mm."""
    wells = [fibre_wells(plan, fibre) for fibre in range(plan.pad.layout.fibres)]
    return [shapely.union_all([wells[fibre] for fibre in fibres]) for fibres in plan.layers]


def fibre_wells(plan: Plan, fibre: int, sides: int = 64) -> BaseGeometry:
    """Return the outlines of the two wells of a fibre, as regular polygons, mm."""
    discs = []
    for lead in plan.leads.pairs[fibre]:
        position, out = lead.turned_mm.copy(), lead.outward[lead.axis]
        position[lead.axis] = plan.leads.edge_mm(lead) + out * WELL_RIM_MM + out * WELL_MM / 2
        discs.append(cylinder(*position.tolist(), WELL_MM, sides))
    return shapely.union_all(discs)


def lid_body(plan: Plan) -> Body:
    """Build the lid that lies on the tray's walls: a plate with vents, and, if enabled, holes for pins and a spout.

    Raises:
        InputError: the pad is too small for vents beside the spout, or keep-outs obstruct them.
    """
    mould, (low, high) = plan.settings.mould, np.reshape(plan.cavity.bounds, (2, 2))
    insets = [min(_VENT_INSET_MM, side / 4) for side in high - low]
    xs, ys = ((a + inset, b - inset) for a, b, inset in zip(low, high, insets, strict=True))
    spout = _free_position(plan, (sum(xs) / 2, sum(ys) / 2), _BORE_MM) if mould.spout else None
    vents = [_free_position(plan, position, _VENT_MM) for position in product(xs, ys)]
    mouth_mm = _BORE_MM + 2 * _FUNNEL_WALL_MM + 2 * _FUNNEL_FLARE_MM
    min_distance = (mouth_mm + _VENT_MM) / 2
    if spout and min(math.dist(spout, vent) for vent in vents) < min_distance:
        width, min_width = min(high - low), math.sqrt(2) * min_distance + 2 * _VENT_INSET_MM
        raise InputError(f"[mould] spout: got true for a pad {width:.4g} mm wide, allowed from {min_width:.4g} mm")
    holes = [cylinder(x, y, _VENT_MM) for x, y in vents]
    if mould.pins:
        holes += [cylinder(x, y, _pin_mm(plan) + _PIN_CLEARANCE_MM) for x, y in _pin_positions(plan)]
    base, cuts = [Prism(plan.tray, 0, LID_MM)], [Prism(hole, -1, LID_MM + 1) for hole in holes]
    if spout:  # printed as it lies, without supports
        foot, bore = cylinder(*spout, _BORE_MM + 2 * _FUNNEL_WALL_MM), cylinder(*spout, _BORE_MM)
        top, flare = LID_MM + _FUNNEL_MM, _FUNNEL_FLARE_MM * (1 + 1 / _FUNNEL_MM)  # of the cut, to 1 mm above the top
        base.append(Prism(foot, LID_MM - INTO_FLOOR_MM, top, _FUNNEL_FLARE_MM))
        cuts += [Prism(bore, -1, LID_MM + INTO_FLOOR_MM), Prism(bore, LID_MM, top + 1, flare)]
    return Body(tuple(base), tuple(cuts))


def lid_holes(plan: Plan) -> int:
    """Return the number of holes through the lid: vents, holes for the pins, and the spout."""
    mould = plan.settings.mould
    return 4 + (3 if mould.pins else 0) + (1 if mould.spout else 0)


def _free_position(plan: Plan, wanted: Position, diameter_mm: float) -> Position:
    """Return the position nearest to `wanted` where a bore of the lid is clear of pillars."""
    reach = diameter_mm / 2 + 0.5  # 0.5 mm between a bore of the lid and a pillar
    if not plan.pillars.area or plan.pillars.distance(shapely.Point(wanted)) >= reach:
        return wanted
    bounds = np.reshape(offset_box(plan.cavity, -reach).bounds, (2, 2))
    positions = np.stack(np.meshgrid(*np.linspace(*bounds, 101, axis=1)), axis=-1).reshape(-1, 2)
    positions = positions[shapely.distance(plan.pillars, shapely.points(positions)) >= reach]
    if not len(positions):
        raise InputError(
            f"[mould] lid: got true, allowed only where keep-outs leave room for bores of {diameter_mm:g} mm"
        )
    x, y = positions[np.hypot(*(positions - wanted).T).argmin()].tolist()
    return x, y


def holder_body(plan: Plan) -> Body:
    """Build the tray that holds the finished pad for pressing: turned over left to right, with its tracks up.

    The leads leave through slots. A cut corner marks where the first horizontal and vertical fibres start.
    """
    mould, cut = plan.settings.mould, plan.corner_mm
    play = plan.flare_mm + HOLDER_PLAY_MM  # the pad's underside is the rim of the casting, its widest part
    half = mould.exit_width_mm / 2 + play
    through = mould.wall_mm + mould.exit_mm + plan.flare_mm + 1
    slots = []
    for lead in (lead for pair in plan.leads.pairs for lead in pair):
        to_middle_mm = plan.leads.edge_mm(lead) * lead.outward[lead.axis]
        x_min, y_min, x_max, y_max = plan.leads.box_at_edge(lead, half, -to_middle_mm, through).bounds
        slots.append(shapely.box(-x_max, y_min, -x_min, y_max))
    _, y_min, x_max, _ = plan.tray.bounds
    marked = plan.tray - shapely.Polygon([(x_max, y_min), (x_max - cut, y_min), (x_max, y_min + cut)])
    hollow = shapely.union_all([offset_box(plan.cavity, play), *slots])
    return _tray(marked, [hollow], mould.floor_mm, HOLDER_WALL_MM)


def printed_bodies(plan: Plan) -> dict[str, Body]:
    """Build all bodies to print for a pad, the mould first; all except the holder are compensated for shrinkage."""
    mould, printed = plan.settings.mould, plan.shrinkage_compensated
    bodies = {"mould": mould_body(printed)}
    if mould.lid:
        bodies["lid"] = lid_body(printed)
    if mould.conductive:
        wells = conductive_plan(plan).shrinkage_compensated
        bodies["conductive"] = mould_body(wells, well_outlines(wells))
    if mould.holder:  # with `conductive`, wide enough for both pads
        bodies["holder"] = holder_body(conductive_plan(plan) if mould.conductive else plan)
    return bodies


def bed_frame(plan: Plan) -> dict[str, Any]:
    """Compute the pose of the pad in its holder, which a slicer puts in the middle of the bed."""
    floor_mm, bed_mm = plan.settings.mould.floor_mm, plan.settings.printer.bed_mm
    _, y_min, _, y_max = plan.tray.bounds
    return {
        "bed_mm": list(bed_mm),
        "centre_mm": [bed_mm[0] / 2, bed_mm[1] / 2 - (y_min + y_max) / 2],  # of the pad
        "angle_deg": 0.0,  # from the bed's y axis to the pad's
        "mirrored": True,  # the tracks lie up, which inverts the pad's x axis
        "pad_mm": np.round(_sides(plan.cavity), 6).tolist(),
        "surface_mm": round(floor_mm + plan.thickness_mm, 6),  # heights are above the bed
        "walls_mm": round(floor_mm + HOLDER_WALL_MM, 6),
    }


def sizes(plan: Plan) -> dict[str, Any]:
    """Compute the sizes of pad and mould that the settings do not fix, mm; width and height if these differ."""
    printed = plan.shrinkage_compensated
    mould = printed.settings.mould
    result = {
        "pad_mm": _sides(plan.cavity),
        "pad_thickness_mm": plan.thickness_mm,
        "cavity_mm": _sides(printed.cavity),
        "cavity_depth_mm": printed.silicone_mm,
        "rim_mm": _sides(offset_box(printed.cavity, printed.flare_mm)),
        "tray_mm": _sides(printed.tray),
        "tray_height_mm": mould.floor_mm + printed.silicone_mm,
        "ridge_foot_mm": mould.ridge_width_mm + 2 * printed.heights_mm[-1] * printed.settings.ridge_slope,
        **({"pin_mm": _pin_mm(printed)} if mould.pins else {}),
        **({"lid_mm": LID_MM} if mould.lid else {}),
        **({"well_mm": WELL_MM} if mould.conductive else {}),
    }
    return {name: np.round(size, 6).tolist() for name, size in result.items()}


def _sides(box: shapely.Polygon) -> float | list[float]:
    """Return the side of a square, or width and height."""
    x_min, y_min, x_max, y_max = box.bounds
    return x_max - x_min if x_max - x_min == y_max - y_min else [x_max - x_min, y_max - y_min]
