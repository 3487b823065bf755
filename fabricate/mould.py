"""The bodies of a mould, put together from their parts.

z = 0 is the underside of a body, which lies on the print bed; the tray's floor has its top at `floor_mm`. Lengths
are mm.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.design.common.validation import InputError
from padforge.fabricate.plan import Plan, offset_box
from padforge.fabricate.settings import WELL_MM, WELL_RIM_MM, WELL_SLOT_MM

COLOURS = {"mould": "#8FA3B8", "lid": "#D9C27E", "conductive": "#6F8F72", "holder": "#B0886E"}
"""The bodies that are printed, by the colour in which CAD programs and slicers show each."""


@dataclass(frozen=True)
class Prism:
    """An upright solid from `bottom_mm` to `top_mm`.

    Attributes:
        area: its outline at the bottom, mm.
        flare_mm: by how much the outline has grown on every side at the top; for rectangles and regular polygons.
    """

    area: BaseGeometry
    bottom_mm: float
    top_mm: float
    flare_mm: float = 0.0


@dataclass(frozen=True)
class Body:
    """The union of `base` without `cuts` and with `adds`, in this order."""

    base: tuple[Prism, ...]
    cuts: tuple[Prism, ...] = ()
    adds: tuple[Prism, ...] = ()

    def with_adds(self, adds: Iterable[Prism]) -> "Body":
        """The body with more on it."""
        return replace(self, adds=(*self.adds, *adds))


def cylinder(x: float, y: float, diameter_mm: float, sides: int = 64) -> shapely.Polygon:
    """The outline of an upright cylinder around (x, y), mm; with 64 sides within 0.13 % of the diameter."""
    return shapely.Point(x, y).buffer(diameter_mm / 2, quad_segs=sides // 4)


INTO_FLOOR_MM = 0.2
"""How far parts sink into what they stand on before they are joined to it: no two faces coincide."""
VENT_MM = 1.5
"""Diameter of a vent of the lid."""
BORE_MM, FUNNEL_MM, FUNNEL_DEG, _FUNNEL_WALL_MM = 6.0, 6.0, 30.0, 2.0
"""Spout: its bore, the height, lean from upright and wall of its funnel."""
PIN_CLEARANCE_MM = 0.3
"""By how much wider the lid's holes are than the pins."""


def tray_body(
    outline: BaseGeometry,
    hollows: Iterable[BaseGeometry],
    *,
    floor_mm: float = 2.0,
    depth_mm: float = 6.0,
    flare_mm: float = 0.0,
) -> Body:
    """An open tray.

    Args:
        outline: of the tray. hollows: rectangles on its floor whose union is filled with silicone.
        floor_mm: thickness of the floor. depth_mm: height of the walls above it.
        flare_mm: how far the walls lean outwards over that height.
    """
    top = floor_mm + depth_mm
    past = flare_mm / depth_mm  # a cut goes on 1 mm past the top at the same lean
    cuts = [Prism(hollow, floor_mm, top + 1, flare_mm + past) for hollow in hollows]
    return Body((Prism(outline, 0, top),), tuple(cuts))


def ridge_prisms(
    outline: Callable[[float], BaseGeometry],
    *,
    floor_mm: float = 2.0,
    height_mm: float = 0.4,
    terrace_mm: float = math.inf,
) -> list[Prism]:
    """A ridge on the floor: upright, or tapered in terraces, which is what a printer makes of a taper.

    Args:
        outline: gives the ridge's outline so many mm below its top.
        terrace_mm: height of a terrace; infinite for upright sides.
    """
    bottom, top = floor_mm - INTO_FLOOR_MM, floor_mm + height_mm
    return [Prism(outline(down), bottom, top - down) for down in terraces(height_mm, terrace_mm)]


def terraces(height_mm: float, terrace_mm: float) -> list[float]:
    """How far below its top every terrace of a ridge lies, mm: 0, then one for every `terrace_mm` of its height."""
    return [0.0, *np.arange(terrace_mm, height_mm - 1e-6, terrace_mm).tolist()] if terrace_mm < height_mm else [0.0]


def numeral_prisms(strokes: Iterable[BaseGeometry], *, floor_mm: float = 2.0, height_mm: float = 0.4) -> list[Prism]:
    """Raised writing on the floor; `strokes` are mirrored, so that they read on the casting."""
    return [Prism(number, floor_mm - INTO_FLOOR_MM, floor_mm + height_mm) for number in strokes]


def well_outline(places: Iterable[tuple[float, float]], *, diameter_mm: float = 3.0, sides: int = 64) -> BaseGeometry:
    """The outline of discs at the ridge ends, that leave wells in the casting; they are as high as their ridges."""
    return shapely.union_all([cylinder(x, y, diameter_mm, sides) for x, y in places])


def pin_prisms(places: Iterable[tuple[float, float]], *, top_mm: float = 8.0, diameter_mm: float = 2.0) -> list[Prism]:
    """Registration pins on the walls, as high as they are wide."""
    return [Prism(cylinder(x, y, diameter_mm), top_mm - INTO_FLOOR_MM, top_mm + diameter_mm) for x, y in places]


def lid_plate(
    outline: BaseGeometry,
    vents: Iterable[tuple[float, float]],
    *,
    thickness_mm: float = 3.0,
    vent_mm: float = VENT_MM,
    pin_places: Iterable[tuple[float, float]] = (),
    pin_mm: float = 2.0,
) -> Body:
    """A flat plate that levels the silicone; excess and air leave through its vents."""
    holes = [cylinder(x, y, vent_mm) for x, y in vents]
    holes += [cylinder(x, y, pin_mm + PIN_CLEARANCE_MM) for x, y in pin_places]
    return Body((Prism(outline, 0, thickness_mm),), tuple(Prism(hole, -1, thickness_mm + 1) for hole in holes))


def add_spout(
    plate: Body,
    place: tuple[float, float] = (0, 0),
    *,
    thickness_mm: float = 3.0,
    bore_mm: float = BORE_MM,
    funnel_mm: float = FUNNEL_MM,
) -> Body:
    """The plate with a funnel at a place to pour through, `funnel_mm` high; printed as it lies, without supports."""
    flare = funnel_mm * math.tan(math.radians(FUNNEL_DEG))
    foot = cylinder(*place, bore_mm + 2 * _FUNNEL_WALL_MM)
    cup = Prism(foot, thickness_mm - INTO_FLOOR_MM, thickness_mm + funnel_mm, flare)
    bore = Prism(cylinder(*place, bore_mm), -1, thickness_mm + INTO_FLOOR_MM)
    mouth = Prism(cylinder(*place, bore_mm), thickness_mm, thickness_mm + funnel_mm + 1, flare * (1 + 1 / funnel_mm))
    return Body((*plate.base, cup), (*plate.cuts, bore, mouth))


def spout_diameter_mm() -> float:
    """Diameter of the spout at its top, mm, where it is widest."""
    return BORE_MM + 2 * _FUNNEL_WALL_MM + 2 * FUNNEL_MM * math.tan(math.radians(FUNNEL_DEG))


_VENT_INSET_MM = 3.0
"""How far from the cavity's rim the lid's vents lie."""
_BESIDE_PILLAR_MM, _TRIED = 0.5, 101
"""Between a bore of the lid and a pillar, at least, and how many places are tried for one along each side."""
LID_MM = 3.0
"""Thickness of the lid."""
HOLDER_WALL_MM = 1.0
"""Height of the holder's walls above its floor: far below the pad's surface, so that no probe meets them."""
HOLDER_PLAY_MM = 0.2
"""Room on every side of the pad in its holder."""


def mould_body(plan: Plan, wells: Sequence[BaseGeometry] = ()) -> Body:
    """The inverse mould: tray, ridges, exits, numbers, pillars and pins.

    Args:
        wells: outlines that belong to the ridges of each level, mm; none for a pad whose fibres are laid.

    Raises:
        InputError: pins that find no room on the walls.
    """
    mould = plan.settings.mould
    floor, hollows = mould.floor_mm, [plan.cavity, *plan.exits]
    body = tray_body(plan.tray, hollows, floor_mm=floor, depth_mm=plan.silicone_mm, flare_mm=plan.flare_mm)
    for level, height in enumerate(plan.heights_mm):

        def outline(below: float, level: int = level) -> BaseGeometry:
            if below:
                return plan.outline(level, below)
            return plan.ridges[level] | wells[level] if wells else plan.ridges[level]

        ridges = ridge_prisms(outline, floor_mm=floor, height_mm=height, terrace_mm=plan.settings.terrace_mm)
        body = body.with_adds(ridges)
    written = [outline for outline in plan.numbers if outline is not None]
    body = body.with_adds(numeral_prisms(written, floor_mm=floor, height_mm=mould.shallow_ridge_height_mm))
    if plan.pillars.area:
        body = body.with_adds([Prism(plan.pillars, floor - INTO_FLOOR_MM, floor + plan.silicone_mm)])
    if mould.pins:
        body = body.with_adds(registration_pins(plan))
    return body


def registration_pins(plan: Plan) -> list[Prism]:
    """The registration pins, sunk into the walls by `INTO_FLOOR_MM`.

    Raises:
        InputError: they find no room on the walls.
    """
    top = plan.settings.mould.floor_mm + plan.silicone_mm
    return pin_prisms(_pin_places(plan), top_mm=top, diameter_mm=_pin_mm(plan))


def sizes(plan: Plan) -> dict[str, Any]:
    """What pad and mould came out as, mm: where the settings leave it open or the pad needs more than they say.

    Of what is not square there are width and height.
    """
    printed = plan.shrinkage_compensated
    mould = printed.settings.mould
    achieved = {
        "pad_mm": _sides(plan.cavity),
        "pad_thickness_mm": plan.thickness_mm,
        "cavity_mm": _sides(printed.cavity),
        "cavity_depth_mm": printed.silicone_mm,
        "rim_mm": _sides(offset_box(printed.cavity, printed.flare_mm)),
        "tray_mm": _sides(printed.tray),
        "tray_height_mm": mould.floor_mm + printed.silicone_mm,
        "ridge_foot_mm": mould.ridge_width_mm + 2 * printed.heights_mm[-1] * printed.settings.ridge_slope,
    }
    if mould.pins:
        achieved["pin_mm"] = _pin_mm(printed)
    if mould.lid:
        achieved["lid_mm"] = LID_MM
    if mould.conductive:
        achieved["well_mm"] = WELL_MM
    return {name: np.round(size, 6).tolist() for name, size in achieved.items()}


def lid_body(plan: Plan) -> Body:
    """The lid that lies on the tray's walls; its holes fit the pins, if there are any.

    Raises:
        InputError: a pad too small for vents beside the spout, or keep-outs that leave no room for them.
    """
    mould, (low, high) = plan.settings.mould, np.reshape(plan.cavity.bounds, (2, 2))
    insets = [min(_VENT_INSET_MM, side / 4) for side in high - low]
    (left, right), (near, far) = ((a + inset, b - inset) for a, b, inset in zip(low, high, insets, strict=True))
    middle = _free_place(plan, ((left + right) / 2, (near + far) / 2), BORE_MM) if mould.spout else None
    vents = [_free_place(plan, (x, y), VENT_MM) for x in (left, right) for y in (near, far)]
    least = (spout_diameter_mm() + VENT_MM) / 2
    if middle and min(math.dist(middle, vent) for vent in vents) < least:
        width, from_mm = min(high - low), math.sqrt(2) * least + 2 * _VENT_INSET_MM
        raise InputError(f"[mould] spout: got true for a pad {width:.4g} mm wide, allowed from {from_mm:.4g} mm")
    body = lid_plate(
        plan.tray,
        vents,
        thickness_mm=LID_MM,
        pin_places=_pin_places(plan) if mould.pins else (),
        pin_mm=_pin_mm(plan) if mould.pins else 0.0,
    )
    return add_spout(body, middle, thickness_mm=LID_MM) if middle else body


def lid_holes(plan: Plan) -> int:
    """How many holes lead through the lid: vents, those for pins, and the spout."""
    mould = plan.settings.mould
    return 4 + 3 * mould.pins + mould.spout


def holder_body(plan: Plan) -> Body:
    """The tray in which the finished pad lies as it was laid: tracks up, turned over left to right.

    Slots let the leads out. The corner where the first horizontal and the first vertical fibre start is cut.
    """
    mould, cut = plan.settings.mould, plan.corner_mm
    play = plan.flare_mm + HOLDER_PLAY_MM  # what lies below was the rim of the casting, wider than its tracks' side
    half = mould.exit_width_mm / 2 + play
    through = mould.wall_mm + mould.exit_mm + plan.flare_mm + 1
    slots = []
    for lead in (lead for pair in plan.leads.pairs for lead in pair):
        middle_mm = plan.leads.edge_mm(lead) * lead.outward[lead.axis]
        x0, y0, x1, y1 = plan.leads.beside(lead, half, -middle_mm, through).bounds
        slots.append(shapely.box(-x1, y0, -x0, y1))
    _, low, right, _ = plan.tray.bounds
    marked = plan.tray - shapely.Polygon([(right, low), (right - cut, low), (right, low + cut)])
    hollow = shapely.union_all([offset_box(plan.cavity, play), *slots])
    return tray_body(marked, [hollow], floor_mm=mould.floor_mm, depth_mm=HOLDER_WALL_MM)


def bed_frame(plan: Plan) -> dict[str, Any]:
    """Where the pad lies while its holder stands where a slicer puts it, in the middle of the bed; mm and degrees.

    Returns:
        "bed_mm": width, depth and height of the printer. "centre_mm": of the pad, x and y. "angle_deg": from the bed's
        y axis to the pad's. "mirrored": that the pad lies with its tracks up, its x axis against that of the bed.
        "pad_mm": side of the pad, or its width and height. "surface_mm", "walls_mm": of the pad and of the holder's
        walls above the bed.
    """
    floor_mm, bed_mm = plan.settings.mould.floor_mm, plan.settings.printer.bed_mm
    _, low, _, high = plan.tray.bounds
    return {
        "bed_mm": list(bed_mm),
        "centre_mm": [bed_mm[0] / 2, bed_mm[1] / 2 - (low + high) / 2],
        "angle_deg": 0.0,
        "mirrored": True,
        "pad_mm": np.round(_sides(plan.cavity), 6).tolist(),
        "surface_mm": round(floor_mm + plan.thickness_mm, 6),
        "walls_mm": round(floor_mm + HOLDER_WALL_MM, 6),
    }


def conductive_plan(plan: Plan) -> Plan:
    """The plan of the second mould: exits large enough for wells, everything else alike.

    Raises:
        InputError: exits that large do not fit the pitch.
    """
    mould = plan.settings.mould.model_copy(update={"exit_mm": WELL_SLOT_MM, "exit_width_mm": WELL_SLOT_MM})
    return replace(plan, settings=replace(plan.settings, mould=mould))


def conductive_body(plan: Plan) -> Body:
    """The mould whose casting has a well at both ends of every track.

    Args:
        plan: of the second mould.
    """
    return mould_body(plan, well_outlines(plan))


def well_outlines(plan: Plan, sides: int = 64) -> list[BaseGeometry]:
    """The outlines of the wells at the ends of the ridges of every level, as polygons of so many sides, mm."""
    places: list[list[tuple[float, float]]] = [[] for _ in plan.heights_mm]
    for level, pair in zip(plan.layer_indices, plan.leads.pairs, strict=True):
        for lead in pair:
            place, out = lead.turned_mm.copy(), lead.outward[lead.axis]
            place[lead.axis] = plan.leads.edge_mm(lead) + out * WELL_RIM_MM + out * WELL_MM / 2
            places[level].append((float(place[0]), float(place[1])))
    return [well_outline(own, diameter_mm=WELL_MM, sides=sides) for own in places]


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
    left, low, right, high = offset_box(plan.tray, -plan.corner_mm / 2).bounds
    return [(left, low), (right, low), (left, high)]


def _sides(box: shapely.Polygon) -> float | list[float]:
    """The side of a square, or width and height."""
    left, low, right, high = box.bounds
    return right - left if right - left == high - low else [right - left, high - low]


def _free_place(plan: Plan, wanted: tuple[float, float], diameter_mm: float) -> tuple[float, float]:
    """The place in the cavity nearest to the one wanted where a bore of the lid comes out over silicone.

    Raises:
        InputError: there is none.
    """
    reach = diameter_mm / 2 + _BESIDE_PILLAR_MM
    if not plan.pillars.area or plan.pillars.distance(shapely.Point(wanted)) >= reach:
        return wanted
    low, high = np.reshape(offset_box(plan.cavity, -reach).bounds, (2, 2))
    across, up = (np.linspace(a, b, _TRIED) for a, b in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    places = places[shapely.distance(plan.pillars, shapely.points(places)) >= reach]
    if not len(places):
        room = f"allowed only where keep-outs leave room for bores of {diameter_mm:g} mm"
        raise InputError(f"[mould] lid: got true, {room}")
    x, y = places[np.hypot(*(places - wanted).T).argmin()].tolist()
    return x, y
