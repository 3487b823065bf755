"""Sensor numbers for the mould's floor: digits of straight strokes, as wide as a ridge, where there is room."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

_CORNERS = {"a": "TLTR", "b": "TRMR", "c": "MRBR", "d": "BLBR", "e": "MLBL", "f": "TLML", "g": "MLMR"}
_HEIGHT, _SIDE = {"T": 1.0, "M": 0.5, "B": 0.0}, {"L": 0.0, "R": 0.5}
_STROKES = ("abcdef", "bc", "abged", "abgcd", "fgbc", "afgcd", "afgedc", "abc", "abcdefg", "abcdfg")
"""The strokes of the digits 0 to 9, of seven."""
_SEARCH_MM = 0.5
"""Spacing of the places that are tried for a number."""


def number_strokes(number: int, height_mm: float, width_mm: float) -> BaseGeometry:
    """A number's outline, mm, middle at (0, 0), mirrored left to right: a casting is read from the other side.

    Args:
        height_mm: of the digits, centre line to centre line. width_mm: of their strokes.
    """
    advance = 0.5 + (width_mm + max(width_mm, 0.25 * height_mm)) / height_mm
    strokes = []
    for place, digit in enumerate(str(number)):
        for stroke in _STROKES[int(digit)]:
            ends = _CORNERS[stroke]
            points = [(place * advance + _SIDE[ends[i + 1]], _HEIGHT[ends[i]]) for i in (0, 2)]
            strokes.append(np.array(points) * height_mm)
    outline = shapely.union_all(shapely.buffer(shapely.linestrings(strokes), width_mm / 2, cap_style="square"))
    left, low, right, high = outline.bounds
    return affinity.scale(affinity.translate(outline, -(left + right) / 2, -(low + high) / 2), xfact=-1, origin=(0, 0))


def with_room(
    numbers: Sequence[BaseGeometry],
    lines: Sequence[shapely.LineString],
    area: BaseGeometry,
    bounds: tuple[float, float, float, float],
    clear_mm: float,
    reach_mm: float,
) -> list[BaseGeometry | None]:
    """The numbers on the floor, each beside the start of its own line; None where there is no room.

    Args:
        numbers: outlines with their middles at (0, 0). lines: centre lines of their ridges.
        area: that is free of walls and pillars. bounds: of what is between the walls.
        clear_mm: from a ridge's middle to writing, at least.
        reach_mm: how far into the pad, and within half of it to either side of the line's start, a number may lie.
    """
    shapely.prepare(lines)
    floor, taken = area.buffer(-clear_mm, join_style="mitre"), []
    placed: list[BaseGeometry | None] = []
    for number, line in zip(numbers, lines, strict=True):
        start, second = np.array(line.coords[:2])
        inward = np.sign(second - start)  # along an axis: lines leave the walls upright
        start = np.where(inward > 0, bounds[:2], start)
        ahead, aside = np.arange(0, reach_mm, _SEARCH_MM), np.arange(-reach_mm / 2, reach_mm / 2, _SEARCH_MM)
        depth, shift = (grid.ravel() for grid in np.meshgrid(ahead, aside))
        middles = start + depth[:, None] * inward + shift[:, None] * inward[::-1]
        middles = middles[np.argsort(np.hypot(depth, shift), kind="stable")]
        half = np.array(number.bounds[2:])
        boxes = shapely.box(*(middles - half).T, *(middles + half).T)
        free = shapely.within(boxes, floor)
        for other in (*lines, *taken):
            free[free] = ~shapely.dwithin(other, boxes[free], clear_mm)
        first = int(np.argmax(free))
        if not free[first]:
            placed.append(None)
            continue
        taken.append(boxes[first])
        placed.append(affinity.translate(number, *middles[first]))
    return placed
