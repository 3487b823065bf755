"""Bend radius of a fibre and the gap between its folds: functions of the points of one curve.

A fibre is a graph over its axis, so its heading (the angle of its tangent to the axis) stays within a right angle of 0,
and it never crosses itself.
"""

import numpy as np
import shapely

from padforge.design.morphology import Array
from padforge.design.paths.curves import cubic, quadratic

FOLD = np.pi / 2
"""Points of a fibre keep the gap if they are `FOLD` gaps apart along it, half a turn of a circle one gap wide."""
UNFOLDED = 2 * np.arccos(1 / FOLD)
"""Range of headings that cannot fold: chords within an angle a of a line are at least cos a times the arc."""
_TINY = 1e-30
"""Divides in position of the length of a segment whose ends coincide."""


def extreme_headings(slopes: Array) -> Array:
    """Return the headings at the ends of spans and at the extremes of the slope inside; monotone between two of them.

    Args:
        slopes: Bezier coefficients of each span's slope; shape (..., n, 3).

    Returns:
        Headings from start to end; shape (..., 2 n + 1), rad.
    """
    pairs = np.stack([slopes[..., 0], quadratic(slopes, _stationary(slopes))], axis=-1)
    return np.arctan(np.concatenate([pairs.reshape(*pairs.shape[:-2], -1), slopes[..., -1:, 2]], axis=-1))


def trace_curve(spans: Array, slopes: Array, step: float) -> tuple[Array, Array]:
    """Sample one fibre so that it turns by at most `step` from point to point.

    Such points also measure its length: a chord is shorter than its arc by less than the fraction step^2 / 8.

    Args:
        spans: Bezier control points; shape (N + 1, 4, 2).
        slopes: Bezier coefficients of the slope; shape (N + 1, 3).
        step: largest change of heading between points, rad.

    Returns:
        Points (n, 2), and the exact headings there (n,), rad.
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


def rolled_turns(points: Array, angles: Array, radius: float) -> Array:
    """Compute the turn out of the plane, from point to point, of a curve in a plane rolled up on a cylinder about y.

    Rolling preserves lengths. A line at the angle a to x is then curved out of the plane by cos(a)^2 / `radius`
    (Euler's theorem), in addition to its curvature in the plane; the two are orthogonal and add as root sum of squares.

    Args:
        points: points whose headings hardly differ from one to the next; shape (n, 2).
        angles: angles to the x axis there; shape (n,), rad.
        radius: radius of the cylinder, in the unit of the points.

    Returns:
        Turns; shape (n - 1,), rad.
    """
    curvature = np.cos(angles) ** 2 / radius
    return (curvature[1:] + curvature[:-1]) / 2 * np.hypot(*np.diff(points, axis=0).T)


def bend_radius(
    points: Array, headings: Array, window: float, out_of_plane: Array | float = 0.0
) -> tuple[float, Array]:
    """Compute the smallest bend radius of a curve: `window` over the largest total turn in a stretch of that length.

    For a shorter curve its length is the window. A PCHIP curve is only C1, so its pointwise curvature does not describe
    how a fibre of finite stiffness lies. The curve is assumed to turn evenly between two points; the turn in a window
    is then piecewise linear in the window's position, with its maximum at a window that starts or ends at a point.

    Args:
        points: points on the curve, dense enough that chords measure its length; a corner is a point given twice;
            shape (n, 2).
        headings: headings of the tangents there, unwrapped; shape (n,), rad.
        window: length over which turns are added up.
        out_of_plane: turns out of the plane from point to point, from `rolled_turns`; shape (n - 1,), rad.

    Returns:
        Radius, and the position (2,) of the middle of that bend.
    """
    arc = _cumulative_length(points)
    window = min(window, arc[-1])
    turn = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(headings), out_of_plane))])
    # A corner at either end of a window counts: a window starts before the turn at its first point (`turn` there,
    # or at the first of two equal points), and `interp` takes the last of equal arcs.
    ahead = np.interp(arc + window, arc, turn) - turn
    behind = turn - np.interp(arc - window, arc, turn)
    i, j = int(np.argmax(ahead)), int(np.argmax(behind))
    if ahead[i] >= behind[j]:
        angle, half = ahead[i], turn[i] + ahead[i] / 2
    else:
        angle, half = behind[j], turn[j] - behind[j] / 2
    position = _interpolate(points, arc, np.interp(half, turn, arc))
    return (window / float(angle) if angle > 0 else np.inf), position


def fold_gap(line: Array, gap: float) -> tuple[float, Array] | None:
    """Compute the smallest distance of two points of a polyline that are at least `FOLD` gaps apart along it.

    The polyline must not cross itself: the smallest distance is then between a vertex and a segment, or between two
    points exactly `FOLD` gaps apart.

    Args:
        line: vertices; shape (n, 2).
        gap: distance to keep.

    Returns:
        Distance, and the middle (2,) of the two points; None if all keep the gap.
    """
    min_arc = FOLD * gap
    arc = _cumulative_length(line)
    if arc[-1] < min_arc:
        return None
    start, offset = _pairs_at_arc(line, arc, min_arc)
    radius = np.hypot(*offset.T).min(initial=gap)
    vertices, to_segment = _pairs_vertex_segment(line, arc, min_arc, radius)
    start, offset = np.concatenate([start, vertices]), np.concatenate([offset, to_segment])
    distance = np.hypot(*offset.T)
    if distance.min(initial=np.inf) >= gap:
        return None
    worst = int(np.argmin(distance))
    return float(distance[worst]), start[worst] + offset[worst] / 2


def _pairs_vertex_segment(line: Array, arc: Array, min_arc: float, radius: float) -> tuple[Array, Array]:
    """Return vertices near a segment, and offsets to its nearest point at least `min_arc` away along the line."""
    segments = np.asarray(shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1)))
    vertex, segment = shapely.STRtree(segments).query(shapely.points(line), predicate="dwithin", distance=radius)
    ahead = segment >= vertex
    allowed = np.where(ahead, arc[segment + 1] - arc[vertex], arc[vertex] - arc[segment]) >= min_arc
    vertex, segment, ahead = vertex[allowed], segment[allowed], ahead[allowed]
    length = np.maximum(arc[segment + 1] - arc[segment], _TINY)
    low = np.where(ahead, (arc[vertex] + min_arc - arc[segment]) / length, 0)
    high = np.where(ahead, 1, (arc[vertex] - min_arc - arc[segment]) / length)
    start, step = line[segment] - line[vertex], line[segment + 1] - line[segment]
    fraction = _closest_fraction(start, step, np.clip(low, 0, 1), np.clip(high, 0, 1))
    return line[vertex], start + fraction * step


def _pairs_at_arc(line: Array, arc: Array, min_arc: float) -> tuple[Array, Array]:
    """Return points, and offsets to those exactly `min_arc` ahead: the smallest while both are on straight segments."""
    at = np.concatenate([arc, arc - min_arc])
    at = np.unique(at[(at >= 0) & (at <= arc[-1] - min_arc)])
    here = _interpolate(line, arc, at)
    offset = _interpolate(line, arc, at + min_arc) - here
    advance, step = np.diff(here, axis=0), np.diff(offset, axis=0)
    fraction = _closest_fraction(offset[:-1], step, 0, 1)
    return here[:-1] + fraction * advance, offset[:-1] + fraction * step


def _closest_fraction(start: Array, step: Array, low: Array | float, high: Array | float) -> Array:
    """Return the fraction (n, 1) within low..high at which start + fraction * step, both (n, 2), is closest to zero."""
    square = np.maximum((step**2).sum(axis=1), _TINY)
    return np.clip(-(start * step).sum(axis=1) / square, low, high)[:, None]


def _stationary(slopes: Array) -> Array:
    """Return the parameter within 0..1 of the extremum of quadratic Beziers (..., 3); any if there is none inside."""
    first, second = slopes[..., 0] - slopes[..., 1], slopes[..., 2] - slopes[..., 1]
    bend = first + second
    return np.clip(np.divide(first, bend, out=np.zeros_like(bend), where=bend != 0), 0, 1)


def _cumulative_length(points: Array) -> Array:
    """Return the arc length (n,) of a polyline at each vertex."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _interpolate(points: Array, arc: Array, where: Array | float) -> Array:
    """Return the points (..., 2) of a polyline at arc lengths `where` (...)."""
    return np.stack([np.interp(where, arc, points[:, 0]), np.interp(where, arc, points[:, 1])], axis=-1)
