"""The parts of a mould, one function each: outlines in mm and sizes go in, prisms come out.

A casting leaves the mould upwards, so nothing here hangs over: every part is as wide or wider further down.
"""

import math
from collections.abc import Callable, Iterable

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from .prisms import Body, Prism, cylinder

INTO_FLOOR_MM = 0.2
"""How far parts sink into what they stand on before they are joined to it: no two faces coincide."""
VENT_MM = 1.5
"""Diameter of a vent of the lid."""
BORE_MM, FUNNEL_MM, FUNNEL_DEG, _FUNNEL_WALL_MM = 6.0, 6.0, 30.0, 2.0
"""Spout: its bore, the height, lean from upright and wall of its funnel."""
PIN_CLEARANCE_MM = 0.3
"""By how much wider the lid's holes are than the pins."""


def tray(
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


def ridge(
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


def wells(places: Iterable[tuple[float, float]], *, diameter_mm: float = 3.0, sides: int = 64) -> BaseGeometry:
    """The outline of discs at the ridge ends, that leave wells in the casting; they are as high as their ridges."""
    return shapely.union_all([cylinder(x, y, diameter_mm, sides) for x, y in places])


def pins(places: Iterable[tuple[float, float]], *, top_mm: float = 8.0, diameter_mm: float = 2.0) -> list[Prism]:
    """Registration pins on the walls, as high as they are wide."""
    return [Prism(cylinder(x, y, diameter_mm), top_mm - INTO_FLOOR_MM, top_mm + diameter_mm) for x, y in places]


def lid(
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


def spout(
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


def spout_mm() -> float:
    """Diameter of the spout at its top, mm, where it is widest."""
    return BORE_MM + 2 * _FUNNEL_WALL_MM + 2 * FUNNEL_MM * math.tan(math.radians(FUNNEL_DEG))
