"""Where polylines are near each other, as intervals of their arcs."""

import math
from typing import Any

import numpy as np
from numba import njit

_BOXED = 8
"""Segments that are put into one box, which is looked at before they are."""


@njit(cache=True, error_model="numpy")
def _clip(value: float, slope: float, least: float, most: float, low: float, high: float) -> tuple[float, float]:
    """What of low..high has value + t slope within least..most, ends that run past each other where nothing has."""
    if slope == 0:
        return (low, high) if least <= value <= most else (1.0, 0.0)
    first, last = (least - value) / slope, (most - value) / slope
    return max(low, min(first, last)), min(high, max(first, last))


@njit(cache=True, error_model="numpy")
def _in_disc(x: float, y: float, dx: float, dy: float, radius: float) -> tuple[float, float]:
    """What of 0..1 has (x, y) + t (dx, dy) within `radius` of 0, ends that run past each other where nothing has."""
    square, middle = dx * dx + dy * dy, x * dx + y * dy
    root = middle * middle - square * (x * x + y * y - radius * radius)
    if root < 0:
        return 1.0, 0.0
    half = math.sqrt(root)
    return max(0.0, (-middle - half) / square), min(1.0, (half - middle) / square)


@njit(cache=True, error_model="numpy")
def _near_part(x: float, y: float, dx: float, dy: float, ex: float, ey: float, width: float) -> tuple[float, float]:
    """What of 0..1 has (x, y) + t (dx, dy) within `width` of the segment from 0 to (ex, ey).

    What is near a segment is a rectangle with a disc at either end. It is convex: a line is in it from the first place
    at which it is in one of the three to the last.
    """
    low, high = 1.0, 0.0
    reach = math.hypot(ex, ey)
    if reach > 0:
        ux, uy = ex / reach, ey / reach
        low, high = _clip(x * ux + y * uy, dx * ux + dy * uy, 0.0, reach, 0.0, 1.0)
        low, high = _clip(y * ux - x * uy, dy * ux - dx * uy, -width, width, low, high)
    for at in (0.0, 1.0):
        begin, end = _in_disc(x - at * ex, y - at * ey, dx, dy, width)
        if begin < end:
            low, high = (min(low, begin), max(high, end)) if low < high else (begin, end)
    return low, high


@njit(cache=True, error_model="numpy")
def _boxes(points: Any, first: Any, margin: float) -> tuple[Any, Any, Any]:
    """Boxes around every few segments of lines, and a margin: sides (n, 4), segments (n, 2) from and to, lines (n,)."""
    count = 0
    for line in range(len(first) - 1):
        count += (first[line + 1] - first[line] + _BOXED - 2) // _BOXED
    sides, segments, lines = np.empty((count, 4)), np.empty((count, 2), np.int64), np.empty(count, np.int64)
    box = 0
    for line in range(len(first) - 1):
        for start in range(first[line], first[line + 1] - 1, _BOXED):
            end = min(start + _BOXED, first[line + 1] - 1)
            sides[box, :2], sides[box, 2:] = np.inf, -np.inf
            for k in range(start, end + 1):
                for axis in range(2):
                    sides[box, axis] = min(sides[box, axis], points[k, axis] - margin)
                    sides[box, 2 + axis] = max(sides[box, 2 + axis], points[k, axis] + margin)
            segments[box, 0], segments[box, 1], lines[box] = start, end, line
            box += 1
    return sides, segments, lines


@njit(cache=True, error_model="numpy")
def _arcs(points: Any, first: Any) -> Any:
    """(n,) length of the line of each vertex up to it."""
    arcs = np.zeros(len(points))
    for line in range(len(first) - 1):
        for k in range(first[line] + 1, first[line + 1]):
            arcs[k] = arcs[k - 1] + math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
    return arcs


@njit(cache=True, error_model="numpy", nogil=True)
def near_intervals(points: Any, first: Any, others: Any, other_first: Any, width: float) -> Any:
    """(k, 4) line, other line, and the arcs of the line from and to which a segment of it is near one of the other.

    Args:
        points: (n, 2) vertices of all lines, one after the other.
        first: (L + 1,) where each line's begin, and n.
        others: (m, 2) as `points`, of the lines they are compared with.
        other_first: (M + 1,) as `first`.
        width: distance below which they are near.
    """
    sides, segments, lines = _boxes(points, first, width)
    other_sides, other_segments, other_lines = _boxes(others, other_first, 0.0)
    arcs = _arcs(points, first)
    found, count = np.empty((64, 4)), 0
    for box in range(len(sides)):
        left, low, right, high = sides[box]
        for beside in range(len(other_sides)):
            if other_sides[beside, 0] > right or other_sides[beside, 2] < left:
                continue
            if other_sides[beside, 1] > high or other_sides[beside, 3] < low:
                continue
            for i in range(segments[box, 0], segments[box, 1]):
                x, y, length = points[i, 0], points[i, 1], arcs[i + 1] - arcs[i]
                dx, dy = points[i + 1, 0] - x, points[i + 1, 1] - y
                if length == 0:
                    continue
                for j in range(other_segments[beside, 0], other_segments[beside, 1]):
                    ox, oy = others[j, 0] - x, others[j, 1] - y
                    ex, ey = others[j + 1, 0] - others[j, 0], others[j + 1, 1] - others[j, 1]
                    if min(ox, ox + ex) > max(0.0, dx) + width or max(ox, ox + ex) < min(0.0, dx) - width:
                        continue
                    if min(oy, oy + ey) > max(0.0, dy) + width or max(oy, oy + ey) < min(0.0, dy) - width:
                        continue
                    since, until = _near_part(-ox, -oy, dx, dy, ex, ey, width)
                    if since >= until:
                        continue
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                    found[count, 0], found[count, 1] = lines[box], other_lines[beside]
                    found[count, 2], found[count, 3] = arcs[i] + since * length, arcs[i] + until * length
                    count += 1
    return found[:count]
