"""Courses that pass keep-outs: every fibre goes by on one side, and a family's fibres stay in their order."""

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from padforge.design.common.validation import InputError
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots
from padforge.design.paths.curves import refine
from padforge.design.settings import PadSettings, RulesSettings


def keep_outs(pad: PadSettings) -> list[Polygon]:
    """The polygons of `[pad] keep_out_mm`, in grid units from the pad's corner."""
    scale, middle = pad.layout.unit_mm, np.array(pad.layout.extent) / 2
    return [Polygon(np.array(corners) / scale + middle) for corners in pad.keep_out_mm]


def check_fibre_ends(pad: PadSettings, rules: RulesSettings) -> None:
    """Refuse keep-outs that come too near to the ends of fibres, which cannot move.

    Raises:
        InputError: naming the polygon, the fibre and the place of its end.
    """
    layout = pad.layout
    for number, polygon in enumerate(keep_outs(pad), 1):
        for fibre in range(layout.fibres):
            family, level = layout.family(fibre), layout.levels[fibre]
            for travel in (0.0, layout.extent[family]):
                end = (travel, level) if family == 0 else (level, travel)
                apart = polygon.distance(shapely.Point(end)) * layout.unit_mm
                if apart < rules.keep_out_mm or apart == 0:
                    x, y = ((a - size / 2) * layout.unit_mm for a, size in zip(end, layout.extent, strict=True))
                    raise InputError(
                        f"[pad] keep_out_mm: polygon {number} is {apart:.3g} mm from an end of fibre {fibre + 1}, at "
                        f"({x:.4g}, {y:.4g}) mm, allowed is {rules.keep_out_mm:g} or more ([rules] keep_out_mm)"
                    )


def is_outside(places: NDArray[np.float64], pad: PadSettings) -> NDArray[np.bool_]:
    """(Q,) which of the places (Q, 2), in grid units, lie in no keep-out."""
    free = np.ones(len(places), bool)
    for polygon in keep_outs(pad):
        free &= ~shapely.intersects_xy(polygon, places)
    return free


_CLEAR = 1.15
"""Clearance of a passing fibre, of that of the rules: PCHIP leaves the way through its knots' corners by a little."""
_SMOOTH = 1.5
"""Length of the way to the side, of the least whose bends keep the rules."""


class _Passage:
    """How one family passes one keep-out: lanes beside it, which fibres take and leave again smoothly."""

    def __init__(self, box: Array, family: int, pad: PadSettings, rules: RulesSettings) -> None:
        layout = pad.layout
        unit, across = layout.unit_mm, layout.extent[1 - family]
        clear = _CLEAR * rules.keep_out_mm / unit + MARGIN
        (self.begin, low), (self.end, high) = box[:, [family, 1 - family]] + np.array([[-clear], [clear]])
        gap, border = max(rules.min_gap_mm / unit, MARGIN), rules.border_mm / unit
        levels = layout.levels[layout.families[family]]
        room = np.maximum([low - border, across - high - border], 0)
        most = np.where(room > 0, 1 + room // (1.1 * gap), 0).astype(int)
        below = min(int((levels < (low + high) / 2).sum()), most[0])
        below = max(below, min(most[0], len(levels) - most[1]))
        above = len(levels) - below
        apart = np.minimum(2 * gap, room / np.maximum([below - 1, above - 1], 1))
        self.lanes = levels.copy()
        self.lanes[:below] = np.minimum(levels[:below], low - apart[0] * np.arange(below)[::-1])
        self.lanes[below:] = np.maximum(levels[below:], high + apart[1] * np.arange(above))
        aside = float(np.abs(self.lanes - levels).max(initial=0))
        # a cubic from 0 to 0 slope that rises by h over a length l bends by 6 h / l^2
        way = max(_SMOOTH * np.sqrt(6 * aside * rules.min_bend_radius_mm / unit), aside)
        room = self.begin, layout.extent[family] - self.end  # a way that is steeper for that the search has to mend
        self.ways = [max(min(way, each), MARGIN) for each in room]

    @property
    def marks(self) -> list[float]:
        """Travel coordinates at which the way to the lanes and the one back begin and end."""
        return [self.begin - self.ways[0], self.begin, self.end, self.end + self.ways[1]]

    def taken(self, travel: Array, cross: Array) -> Array:
        """Cross coordinates (k, n) of fibres that take the lanes, at travel coordinates (k, n)."""
        outside = np.maximum((self.begin - travel) / self.ways[0], (travel - self.end) / self.ways[1])
        share = 1 - np.clip(outside, 0, 1)
        share = share**2 * (3 - 2 * share)
        return cross + share * (self.lanes[:, None] - cross)


def _passages(pad: PadSettings, rules: RulesSettings, family: int) -> list[_Passage]:
    """Of all keep-outs for a family that has fibres; none where the rules do not ask for it."""
    if not rules.enforce or not pad.layout.counts[family]:
        return []
    boxes = [np.array(polygon.bounds).reshape(2, 2) for polygon in keep_outs(pad)]
    return [_Passage(box, family, pad, rules) for box in boxes]


def pass_keep_outs(knots: Array, pad: PadSettings, rules: RulesSettings) -> Array:
    """Knots (F, N+2, 2) of the same course, but for where it leads by a keep-out: fibres take their lanes there."""
    layout = pad.layout
    found = knots.copy()
    for family, rows in enumerate(layout.families):
        for passage in _passages(pad, rules, family):
            travel, cross = found[rows, 1:-1, family], found[rows, 1:-1, 1 - family]
            found[rows, 1:-1, 1 - family] = np.clip(
                passage.taken(travel, cross), MARGIN, layout.extent[1 - family] - MARGIN
            )
    return found


def straight_paths(pad: PadSettings, rules: RulesSettings, count: int) -> Array:
    """Knots (F, `count` + 2, 2) of straight fibres, which bow around keep-outs where the rules ask for it."""
    layout = pad.layout
    marks = []
    for family, extent in enumerate(layout.extent):
        found = [mark for passage in _passages(pad, rules, family) for mark in passage.marks]
        marks.append(np.unique(np.clip(found, 2 * MARGIN, extent - 2 * MARGIN)))
    fewest = max(len(each) for each in marks)
    if fewest > count:
        return pass_keep_outs(refine(Morphology.straight(layout).knots, count, layout), pad, rules)
    inner = np.empty((layout.fibres, fewest, 2))
    for family, rows in enumerate(layout.families):
        missing = fewest - len(marks[family])
        first = marks[family].min(initial=layout.extent[family])
        inner[rows, :, family] = [*np.linspace(0, first, missing + 2)[1:-1], *marks[family]]
        inner[rows, :, 1 - family] = layout.levels[rows, None]
    return refine(pass_keep_outs(assemble_knots(inner, layout), pad, rules), count, layout)
