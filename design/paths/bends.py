"""How a fibre bends and how near its folds come to each other: pure functions on the points of one curve.

A fibre is a graph over its travel axis, so its heading (the angle of its tangent to that axis) stays within a right
angle either side of 0 and it never meets itself.
"""

import numpy as np
import shapely

from padforge.design.morphology import Array
from padforge.design.paths.curves import cubic, quadratic

FOLD = np.pi / 2
"""Points of a fibre that lie `FOLD` gaps apart along it, half a turn of a circle one gap wide, are to keep that gap."""
UNFOLDED = 2 * np.arccos(1 / FOLD)
"""Headings within this range cannot fold: a curve within an angle a of a line has chords of cos a times its length."""
_TINY = 1e-30
"""Divides in place of the length of a segment whose ends coincide."""


def extreme_headings(slopes: Array) -> Array:
    """(..., 2n+1) headings at the ends of n spans and where each is steepest or flattest inside, from start to end.

    Between two of them the heading is monotone.

    Args:
        slopes: (..., n, 3) Bezier coefficients of each span's slope.
    """
    pairs = np.stack([slopes[..., 0], quadratic(slopes, _stationary(slopes))], axis=-1)
    return np.arctan(np.concatenate([pairs.reshape(*pairs.shape[:-2], -1), slopes[..., -1:, 2]], axis=-1))


def trace_curve(spans: Array, slopes: Array, step: float) -> tuple[Array, Array]:
    """Points (n, 2) of one fibre and its exact headings (n,) there; from one to the next it turns by at most `step`.

    Such points also measure its length: a chord is shorter than its arc by less than the fraction step^2 / 8.

    Args:
        spans: (N+1, 4, 2) Bezier control points. slopes: (N+1, 3) Bezier coefficients of the slope.
    """
    starts = np.arange(len(spans))
    at = np.append(np.column_stack([starts, starts + _stationary(slopes)]), len(spans))  # span + parameter in it
    heading = extreme_headings(slopes)
    while True:
        middle = (at[:-1] + at[1:]) / 2
        wide = (np.abs(np.diff(heading)) > step) & (at[:-1] < middle) & (middle < at[1:])
        if not wide.any():
            break
        new = np.flatnonzero(wide) + 1
        at = np.insert(at, new, middle[wide])
        span = middle[wide].astype(int)
        heading = np.insert(heading, new, np.arctan(quadratic(slopes[span], middle[wide] - span)))
    span = np.minimum(at.astype(int), len(spans) - 1)
    return cubic(spans[span], at - span), heading


def rolled_turns(points: Array, from_axis: Array, radius: float) -> Array:
    """(n - 1,) radians by which a curve turns away from its plane, from point to point, once that is rolled up.

    A plane that is rolled up on a cylinder about y stays as long everywhere. A line on it at the angle a to x is then
    curved out of the plane by cos(a)^2 / `radius` (Euler's formula: 1 / radius about the cylinder, 0 along it), beside
    its curvature 1 / r in the plane; the two stand at right angles, so that it is curved by their root sum of squares.

    Args:
        points: (n, 2) so near that their headings hardly differ. from_axis: (n,) angle to the x axis there.
    """
    curved = np.cos(from_axis) ** 2 / radius
    return (curved[1:] + curved[:-1]) / 2 * np.hypot(*np.diff(points, axis=0).T)


def bend_radius(points: Array, headings: Array, window: float, rolled: Array | float = 0.0) -> tuple[float, Array]:
    """Least bend radius of a curve, and the place (2,) in the middle of that bend.

    The radius is `window` divided by the greatest angle the curve turns, left and right added up, in a stretch of that
    length (or by what all of it turns, where it is shorter than that: then its length stands for the window). A PCHIP
    curve is only C1, so its pointwise curvature says nothing about how a fibre of finite stiffness lies.

    Between two points the curve is taken to turn evenly; what a window turns is then piecewise linear in where the
    window lies, and greatest for one that starts or ends at a point.

    Args:
        points: (n, 2) on the curve, so near that chords measure its length; a corner is a point given twice.
        headings: (n,) of the tangents there, unwrapped.
        rolled: (n - 1,) what it turns out of the plane from point to point: `rolled_turns`.
    """
    arc = _arc(points)
    window = min(window, arc[-1])
    turned = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(headings), rolled))])
    # A corner at either end of a window counts: a window starts before the turn at its first point (`turned` there,
    # or at the first of two equal points), and `interp` takes the last of equal arcs.
    ahead = np.interp(arc + window, arc, turned) - turned
    behind = turned - np.interp(arc - window, arc, turned)
    i, j = int(np.argmax(ahead)), int(np.argmax(behind))
    if ahead[i] >= behind[j]:
        angle, half = ahead[i], turned[i] + ahead[i] / 2
    else:
        angle, half = behind[j], turned[j] - behind[j] / 2
    place = _at(points, arc, np.interp(half, turned, arc))
    return (window / float(angle) if angle > 0 else np.inf), place


def fold_gap(line: Array, gap: float) -> tuple[float, Array] | None:
    """Least distance of two points of a polyline (n, 2) that lie at least `FOLD` gaps apart along it, and their middle.

    None where all of them keep `gap`. The polyline must not meet itself: then the least distance is found between a
    vertex and a segment, or between two points exactly `FOLD` gaps apart.
    """
    apart = FOLD * gap
    arc = _arc(line)
    if arc[-1] < apart:
        return None
    start, offset = _exactly_apart(line, arc, apart)
    within = np.hypot(*offset.T).min(initial=gap)
    others, to_segment = _vertices_to_segments(line, arc, apart, within)
    start, offset = np.concatenate([start, others]), np.concatenate([offset, to_segment])
    distance = np.hypot(*offset.T)
    if distance.min(initial=np.inf) >= gap:
        return None
    worst = int(np.argmin(distance))
    return float(distance[worst]), start[worst] + offset[worst] / 2


def _vertices_to_segments(line: Array, arc: Array, apart: float, within: float) -> tuple[Array, Array]:
    """Vertices near a segment and the way from each to the nearest point of it that lies `apart` along the line."""
    segments = np.asarray(shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1)))
    vertex, segment = shapely.STRtree(segments).query(shapely.points(line), predicate="dwithin", distance=within)
    ahead = segment >= vertex
    allowed = np.where(ahead, arc[segment + 1] - arc[vertex], arc[vertex] - arc[segment]) >= apart
    vertex, segment, ahead = vertex[allowed], segment[allowed], ahead[allowed]
    length = np.maximum(arc[segment + 1] - arc[segment], _TINY)
    low = np.where(ahead, (arc[vertex] + apart - arc[segment]) / length, 0)
    high = np.where(ahead, 1, (arc[vertex] - apart - arc[segment]) / length)
    start, step = line[segment] - line[vertex], line[segment + 1] - line[segment]
    fraction = _nearest_zero(start, step, np.clip(low, 0, 1), np.clip(high, 0, 1))
    return line[vertex], start + fraction * step


def _exactly_apart(line: Array, arc: Array, apart: float) -> tuple[Array, Array]:
    """Points with another one exactly `apart` ahead, nearest in every stretch both run straight, and the way to it."""
    at = np.concatenate([arc, arc - apart])
    at = np.unique(at[(at >= 0) & (at <= arc[-1] - apart)])
    here = _at(line, arc, at)
    offset = _at(line, arc, at + apart) - here
    along, step = np.diff(here, axis=0), np.diff(offset, axis=0)
    fraction = _nearest_zero(offset[:-1], step, 0, 1)
    return here[:-1] + fraction * along, offset[:-1] + fraction * step


def _nearest_zero(start: Array, step: Array, low: Array | float, high: Array | float) -> Array:
    """(n, 1) fraction within low..high at which start + fraction * step, both (n, 2), is nearest to zero."""
    square = np.maximum((step**2).sum(axis=1), _TINY)
    return np.clip(-(start * step).sum(axis=1) / square, low, high)[:, None]


def _stationary(slopes: Array) -> Array:
    """(...,) parameter within 0..1 where a quadratic Bezier (..., 3) has its extremum, any where it has none inside."""
    first, second = slopes[..., 0] - slopes[..., 1], slopes[..., 2] - slopes[..., 1]
    bend = first + second
    return np.clip(np.divide(first, bend, out=np.zeros_like(bend), where=bend != 0), 0, 1)


def _arc(points: Array) -> Array:
    """(n,) length of a polyline from its start to every vertex."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _at(points: Array, arc: Array, where: Array | float) -> Array:
    """(..., 2) points of a polyline at lengths `where` (...) from its start."""
    return np.stack([np.interp(where, arc, points[:, 0]), np.interp(where, arc, points[:, 1])], axis=-1)
