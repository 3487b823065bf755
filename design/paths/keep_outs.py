"""Paths past keep-outs: every fibre passes on one side, and the fibres of a family keep their order."""

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from padforge.common.validation import InputError
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots
from padforge.design.paths.curves import refine
from padforge.design.settings import PadSettings, RulesSettings


def keep_outs(pad: PadSettings) -> list[Polygon]:
    """Return the polygons of `[pad] keep_out_mm`, round holes too, in grid units from the pad's corner."""
    scale, middle = pad.layout.unit_mm, np.array(pad.layout.extent) / 2
    return [Polygon(np.array(corners) / scale + middle) for corners in pad.keep_out_corners_mm]


def check_fibre_ends(pad: PadSettings, rules: RulesSettings) -> None:
    """Refuse keep-outs too near to fibre ends, which cannot move."""
    layout = pad.layout
    for number, polygon in enumerate(keep_outs(pad), 1):
        for fibre in range(layout.fibres):
            family, level = layout.family(fibre), layout.levels[fibre]
            for along in (0.0, layout.extent[family]):
                end = (along, level) if family == 0 else (level, along)
                distance_mm = polygon.distance(shapely.Point(end)) * layout.unit_mm
                if distance_mm < rules.keep_out_mm or distance_mm == 0:
                    x, y = (np.array(end) - np.array(layout.extent) / 2) * layout.unit_mm
                    end_name = f"an end of fibre {fibre + 1}, at ({x:.4g}, {y:.4g}) mm"
                    allowed = f"{rules.keep_out_mm:g} or more ([rules] keep_out_mm)"
                    error = f"keep-out {number} is {distance_mm:.3g} mm from {end_name}, allowed is {allowed}"
                    raise InputError(f"[pad] keep_out_mm: {error}")


def is_outside(positions: NDArray[np.float64], pad: PadSettings) -> NDArray[np.bool_]:
    """Return the mask (Q,) of the positions (Q, 2), grid units, that lie outside all keep-outs."""
    polygons = np.array(keep_outs(pad), dtype=object)
    return ~shapely.intersects_xy(polygons[:, None], *positions.T).any(axis=0)


class _Passage:
    """Lanes on which the k fibres of a family pass the box of a keep-out, with smooth transitions before and after it.

    From `begin` to `end` along the axis fibres are at `lanes` (k,) across it; `transitions` are the lengths before and
    after, and `marks` the coordinates along at which transitions begin and end. All are in grid units.
    """

    def __init__(self, box: Array, family: int, pad: PadSettings, rules: RulesSettings) -> None:
        layout = pad.layout
        unit, width = layout.unit_mm, layout.extent[1 - family]
        # more than the rules demand, since a PCHIP curve leaves the polygon of its knots
        clearance = 1.15 * rules.keep_out_mm / unit + MARGIN
        (self.begin, low), (self.end, high) = box[:, [family, 1 - family]] + np.array([[-clearance], [clearance]])
        gap, border = max(rules.min_gap_mm / unit, MARGIN), rules.border_mm / unit
        levels = layout.levels[layout.families[family]]
        # 1. Fibres pass on the side on which they end, unless there is no room for so many lanes.
        room_below, room_above = max(low - border, 0), max(width - high - border, 0)
        max_below, max_above = (int(1 + room // (1.1 * gap)) if room > 0 else 0 for room in (room_below, room_above))
        n_below = min(int((levels < (low + high) / 2).sum()), max_below)
        n_below = max(n_below, min(max_below, len(levels) - max_above))
        n_above = len(levels) - n_below
        # 2. Lanes begin beside the keep-out, two gaps apart if there is room. Fibres that end further off stay there.
        spacing_below = min(2 * gap, room_below / max(n_below - 1, 1))
        spacing_above = min(2 * gap, room_above / max(n_above - 1, 1))
        self.lanes = levels.copy()
        self.lanes[:n_below] = np.minimum(levels[:n_below], low - spacing_below * np.arange(n_below)[::-1])
        self.lanes[n_below:] = np.maximum(levels[n_below:], high + spacing_above * np.arange(n_above))
        # 3. Transitions are half as long again as the rules need: a cubic with zero end slopes that rises by h over a
        # length l has curvature 6 h / l^2. The search has to repair those for which the pad is too short.
        rise = float(np.abs(self.lanes - levels).max(initial=0))
        length = max(1.5 * np.sqrt(6 * rise * rules.min_mean_bend_radius_mm / unit), rise)
        available = self.begin, layout.extent[family] - self.end
        self.transitions = [max(min(length, limit), MARGIN) for limit in available]
        self.marks = [self.begin - self.transitions[0], self.begin, self.end, self.end + self.transitions[1]]

    def shift_to_lanes(self, along: Array, across: Array) -> Array:
        """Return the coordinates across of knots at `along` and `across`, all (k, n), moved towards the lanes."""
        distance = np.maximum((self.begin - along) / self.transitions[0], (along - self.end) / self.transitions[1])
        share = 1 - np.clip(distance, 0, 1)
        share = share**2 * (3 - 2 * share)  # smoothstep
        return across + share * (self.lanes[:, None] - across)


def _passages(pad: PadSettings, rules: RulesSettings, family: int) -> list[_Passage]:
    """Return the passages of a family by each keep-out; none if it has no fibres or rules are not enforced."""
    if not rules.enforce or not pad.layout.counts[family]:
        return []
    boxes = [np.array(polygon.bounds).reshape(2, 2) for polygon in keep_outs(pad)]
    return [_Passage(box, family, pad, rules) for box in boxes]


def pass_keep_outs(knots: Array, pad: PadSettings, rules: RulesSettings) -> Array:
    """Shift knots (F, N + 2, 2), grid units, near keep-outs to the lanes that pass them."""
    shifted = knots.copy()
    for family, rows in enumerate(pad.layout.families):
        limit = pad.layout.extent[1 - family] - MARGIN
        for passage in _passages(pad, rules, family):
            across = passage.shift_to_lanes(shifted[rows, 1:-1, family], shifted[rows, 1:-1, 1 - family])
            shifted[rows, 1:-1, 1 - family] = np.clip(across, MARGIN, limit)
    return shifted


def straight_paths(pad: PadSettings, rules: RulesSettings, count: int) -> Array:
    """Return the knots (F, count + 2, 2) of straight fibres, which pass keep-outs if the rules are enforced.

    Knots include the marks of the passages, unless these are more than `count`.
    """
    layout = pad.layout
    marks = []
    for family, extent in enumerate(layout.extent):
        positions = [mark for passage in _passages(pad, rules, family) for mark in passage.marks]
        marks.append(np.unique(np.clip(positions, 2 * MARGIN, extent - 2 * MARGIN)))
    n_marks = max(map(len, marks))
    if n_marks > count:
        return pass_keep_outs(refine(Morphology.straight(layout).knots, count, layout), pad, rules)
    inner = np.empty((layout.fibres, n_marks, 2))
    for family, rows in enumerate(layout.families):
        missing = n_marks - len(marks[family])  # both families have as many knots
        first = marks[family].min(initial=layout.extent[family])
        inner[rows, :, family] = [*np.linspace(0, first, missing + 2)[1:-1], *marks[family]]
        inner[rows, :, 1 - family] = layout.levels[rows, None]
    return refine(pass_keep_outs(assemble_knots(inner, layout), pad, rules), count, layout)
