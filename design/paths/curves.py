"""Curves of a pad: PCHIP spans as Bezier curves, lengths, crossings, common stretches, bends, folds, spare knots.

A fibre is a graph over its axis, so its heading (the angle of its tangent to the axis) stays within a right angle of 0,
and it never crosses itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from padforge.common.validation import check_float
from padforge.design.kernels.geometry import find_near_intervals
from padforge.design.kernels.pchip import population_slopes
from padforge.design.morphology import Array, Morphology, assemble_knots, split_axes
from padforge.design.settings import Layout

FOLD = np.pi / 2  # distance along a fibre, in gaps, from which on points must keep the gap: half a circle one gap wide
# range of headings that cannot fold: chords within an angle a of a line are at least cos a times the arc
UNFOLDED = 2 * np.arccos(1 / FOLD)
SPARE_LENGTH = 1e-4  # length of all spare knots of a fibre, grid units: far below what can be printed
_LEVEL_TOLERANCE = 1e-9  # smaller rises are due to rounding of positions that a file states in pitches
_TINY = 1e-30  # divisor in place of the length of a segment whose ends coincide


def _hermite(pad: Morphology) -> tuple[Array, Array, Array]:
    """Return the knots along and across each fibre's axis, and the PCHIP slopes there, all (F, N + 2)."""
    along, across = split_axes(pad.knots[None], pad.layout.horizontals)
    return along[0], across[0], population_slopes(along, across)[0]


def slopes(pad: Morphology) -> Array:
    """Compute the PCHIP slopes at the knots, change across per change along the axis; shape (F, N + 2)."""
    return _hermite(pad)[2]


def beziers(pad: Morphology) -> Array:
    """Compute the Bezier control points (F, N + 1, 4, 2) of every span, which is exactly one cubic; grid units."""
    t, v, d = _hermite(pad)
    third = np.diff(t) / 3
    along = np.stack([t[:, :-1], t[:, :-1] + third, t[:, 1:] - third, t[:, 1:]], axis=-1)
    across = np.stack([v[:, :-1], v[:, :-1] + third * d[:, :-1], v[:, 1:] - third * d[:, 1:], v[:, 1:]], axis=-1)
    spans = np.stack([along, across], axis=-1)
    spans[pad.layout.horizontals :] = spans[pad.layout.horizontals :, :, :, ::-1].copy()  # verticals run along y
    return spans


def slope_beziers(pad: Morphology) -> Array:
    """Compute the Bezier coefficients (F, N + 1, 3) of every span's slope, across per along: a quadratic."""
    t, v, d = _hermite(pad)
    inner = 3 * np.diff(v) / np.diff(t) - d[:, :-1] - d[:, 1:]
    return np.stack([d[:, :-1], inner, d[:, 1:]], axis=2)


def quadratic(control: Array, u: Array) -> Array:
    """Evaluate quadratic Bezier polynomials with coefficients (..., 3) at parameters (...)."""
    w = 1 - u
    return w**2 * control[..., 0] + 2 * w * u * control[..., 1] + u**2 * control[..., 2]


def cubic(control: Array, u: Array) -> Array:
    """Evaluate cubic Bezier curves with control points (..., 4, 2) at parameters (...)."""
    u = u[..., None]
    w = 1 - u
    p = np.moveaxis(control, -2, 0)
    return w**3 * p[0] + 3 * w**2 * u * p[1] + 3 * w * u**2 * p[2] + u**3 * p[3]


def flatten(pad: Morphology, tolerance: float) -> list[Array]:
    """Flatten each fibre to a polyline.

    A span is cut into n equal steps of its parameter with n = ceil(sqrt(3 L / (4 tolerance))), L the largest second
    difference of its control points; the chord error is then at most `tolerance` (Wang's bound for cubics).

    Args:
        pad: the fibres.
        tolerance: largest distance of curve and polyline, grid units.

    Returns:
        A polyline (n, 2) of each fibre, grid units.

    Raises:
        InputError: a tolerance out of range.
    """
    return flatten_beziers(beziers(pad), check_float("tolerance", tolerance, 1e-8, 1e6))


def flatten_beziers(curves: Array, tolerance: float) -> list[Array]:
    """Flatten rows (R, n, 4, 2) of cubic Bezier curves, each beginning where the one before ends, as `flatten` does."""
    second = np.linalg.norm(np.diff(curves, 2, axis=2), axis=3).max(axis=2)
    steps = np.maximum(1, np.ceil(np.sqrt(0.75 * second / tolerance))).astype(int).ravel()
    starts = np.cumsum(steps) - steps  # all spans at once: many take no longer than a few
    u = (np.arange(steps.sum()) - np.repeat(starts, steps)) / np.repeat(steps, steps)
    points = cubic(np.repeat(curves.reshape(-1, 4, 2), steps, axis=0), u)
    fibres = np.split(points, starts.reshape(second.shape)[1:, 0])
    return [np.vstack([line, spans[-1, -1:]]) for line, spans in zip(fibres, curves, strict=True)]


def lengths(pad: Morphology) -> Array:
    """Compute the arc length of each fibre by Gauss-Legendre quadrature, to about 1e-5 where knots nearly coincide."""
    return bezier_lengths(beziers(pad))


def bezier_lengths(curves: Array) -> Array:
    """Compute the lengths (R,) of rows (R, n, 4, 2) of cubic Bezier curves, as `lengths` does."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    u = ((nodes + 1) / 2)[:, None]
    derivative = 3 * np.diff(curves, axis=2)[:, :, :, None, :]
    speed = derivative[:, :, 0] * (1 - u) ** 2 + 2 * derivative[:, :, 1] * u * (1 - u) + derivative[:, :, 2] * u**2
    return (np.linalg.norm(speed, axis=-1) @ (weights / 2)).sum(axis=1)


@dataclass(frozen=True)
class Crossing:
    """Crossing of two fibres."""

    first: int  # index of a fibre
    second: int  # index of the other one, > first
    position: tuple[float, float]  # x and y, grid units


def crossings(pad: Morphology, tolerance: float = 1e-4, across: bool = True) -> list[Crossing]:
    """Find every crossing of two fibres, ordered by fibre and position.

    Fibres that touch or run along each other cross in the middle of the common stretch.

    Args:
        pad: the fibres.
        tolerance: tolerance of `flatten`, grid units.
        across: whether to include crossings of horizontals with verticals, beside those within a family.
    """
    import shapely  # takes a while, and lengths are computed without it

    lines = np.array([shapely.LineString(points) for points in flatten(pad, tolerance)])
    first, second = shapely.STRtree(lines).query(lines)
    horizontals = pad.layout.horizontals
    wanted = (first < second) & (across | ((first < horizontals) == (second < horizontals)))
    first, second = first[wanted], second[wanted]
    shared = shapely.intersection(lines[first], lines[second])
    # points of intersection, and the middles of shared stretches
    parts, pair = shapely.get_parts(shared, return_index=True)
    is_point = shapely.get_type_id(parts) == shapely.GeometryType.POINT
    overlap = np.flatnonzero(shapely.length(shared) > 0)
    stretches, overlap_index = shapely.get_parts(shapely.line_merge(shared[overlap]), return_index=True)
    middles = shapely.line_interpolate_point(stretches, 0.5, normalized=True)
    positions = shapely.get_coordinates(np.concatenate([parts[is_point], middles]))
    pair = np.concatenate([pair[is_point], overlap[overlap_index]])
    rows = zip(first[pair].tolist(), second[pair].tolist(), map(tuple, positions.tolist()), strict=True)
    return [Crossing(*row) for row in sorted(rows)]


def crossing_angles(pad: Morphology, crossings: Sequence[Crossing]) -> Array:
    """Compute the angles between the tangents at crossings of a horizontal with a vertical fibre, 0..90 degrees.

    Fibres that touch or run along each other have a common tangent, so their angle is 0.
    """
    x, y = np.array([c.position for c in crossings]).reshape(-1, 2).T
    dy_dx = _slopes_at(pad, np.array([c.first for c in crossings], dtype=int), x)
    dx_dy = _slopes_at(pad, np.array([c.second for c in crossings], dtype=int), y)
    return np.degrees(np.arctan2(np.abs(1 - dy_dx * dx_dy), np.abs(dy_dx + dx_dy)))


def _slopes_at(pad: Morphology, fibre: NDArray[np.int_], at: Array) -> Array:
    """Return the slope of each of the fibres (n,) at a coordinate (n,) along its axis."""
    knots = _hermite(pad)[0][fibre]
    span = np.clip((knots <= at[:, None]).sum(axis=1) - 1, 0, knots.shape[1] - 2)
    row = np.arange(len(fibre))
    u = (at - knots[row, span]) / (knots[row, span + 1] - knots[row, span])
    return quadratic(slope_beziers(pad)[fibre, span], u)


def refine(knots: Array, count: int, layout: Layout) -> Array:
    """Insert knots on the curves (F, n, 2), in the middle of the longest spans, up to `count` inner knots a fibre."""
    from scipy.interpolate import PchipInterpolator

    fibres = []
    for fibre, line in enumerate(knots):
        axis = layout.family(fibre)
        along = line[:, axis]
        curve = PchipInterpolator(along, line[:, 1 - axis])
        while len(along) < count + 2:
            longest = int(np.argmax(np.diff(along)))
            along = np.insert(along, longest + 1, along[longest : longest + 2].mean())
        fibres.append(np.stack([along, curve(along)][:: 1 - 2 * axis], axis=-1))
    return assemble_knots(np.array(fibres)[:, 1:-1], layout)


def add_spare_knots(paths: Sequence[Array], layout: Layout) -> Array:
    """Give all fibres (n, 2) the same number of knots (F, n, 2) by adding spare ones that do not change the curves."""
    n_knots = max(map(len, paths))
    return np.stack([_add_spares(path, layout.family(i), n_knots - len(path)) for i, path in enumerate(paths)])


def remove_spare_knots(knots: Array, layout: Layout) -> list[Array]:
    """Return the knots (n, 2) of each fibre of (F, n, 2), grid units, without spare ones."""
    paths = []
    for fibre, line in enumerate(knots):
        step = np.abs(np.diff(line, axis=0))
        axis = layout.family(fibre)
        spare = (step[:, axis] <= SPARE_LENGTH * (1 + _LEVEL_TOLERANCE)) & (step[:, 1 - axis] <= _LEVEL_TOLERANCE)
        spare[-1] = False
        paths.append(line[np.append(True, ~spare)])
    return paths


def _add_spares(path: Array, axis: int, count: int) -> Array:
    if not count:
        return path
    at = _find_level_knot(path[:, axis], path[:, 1 - axis])
    if at is None:
        return _add_spares(_insert_knot_on_curve(path.tobytes(), axis), axis, count - 1)
    step = min(SPARE_LENGTH, (path[at + 1, axis] - path[at, axis]) / 4) / count
    spares = np.repeat(path[at : at + 1], count, axis=0)
    spares[:, axis] += step * np.arange(1, count + 1)
    return np.insert(path, at + 1, spares, axis=0)


def _find_level_knot(along: Array, across: Array) -> int | None:
    """Find the knot where the curve is level, not next to an end, with the most room behind it; None if none is."""
    rise, room = np.diff(across), np.diff(along)
    if not rise.any():
        return int(np.argmax(room))
    level = np.append(rise[0] == 0, rise[:-1] * rise[1:] <= 0)
    level[[1, -1]] = False
    return int(np.argmax(np.where(level, room, -1))) if level.any() else None


@lru_cache(maxsize=256)  # an editor changes one fibre and leaves the others
def _insert_knot_on_curve(path: bytes, axis: int) -> Array:
    """Insert a knot on the curve of a fibre, knots (n, 2) as bytes, near an end, where it changes the curve least."""
    from scipy.interpolate import PchipInterpolator

    knots = np.frombuffer(path).reshape(-1, 2)
    along, across = knots[:, axis], knots[:, 1 - axis]
    curve = PchipInterpolator(along, across)
    spans = sorted({0, 1, len(along) - 3, len(along) - 2} & set(range(len(along) - 1)))
    trials = np.array([0.15, 0.3, 0.5, 0.7, 0.85])  # positions on a span at which a knot is tried
    positions = np.concatenate([along[k] + (along[k + 1] - along[k]) * trials for k in spans])
    dense = np.concatenate([np.linspace(along[k], along[k + 1], 33) for k in spans])
    best, least = along, np.inf
    for position in positions:
        more = np.sort(np.append(along, position))
        largest_change = float(np.abs(PchipInterpolator(more, curve(more))(dense) - curve(dense)).max())
        if largest_change < least:
            best, least = more, largest_change
    result = np.empty((len(best), 2))
    result[:, axis], result[:, 1 - axis] = best, curve(best)
    result[[0, -1]] = knots[[0, -1]]
    return result


@dataclass(frozen=True)
class CommonStretches:
    """Stretches (n,) of lines that are entirely near another line, ordered by line, other line and position."""

    line: NDArray[np.int_]
    other: NDArray[np.int_]  # the line that it is near
    begin: Array  # arc length along `line`
    end: Array

    @property
    def length(self) -> Array:
        """Length of each stretch; shape (n,)."""
        return self.end - self.begin


def common_stretches(lines: Sequence[Array], others: Sequence[Array], width: float) -> CommonStretches:
    """Find every stretch of polylines (n, 2) that is nearer than `width` to one of `others`.

    Two straight lines that cross at an angle a have a stretch of 2 width / sin(a) in common.
    """
    near = find_near_intervals(*_concatenate(lines), *_concatenate(others), width)
    pair = near[:, 0].astype(int) * len(others) + near[:, 1].astype(int)
    # place pairs one after another on one axis, then merge intervals that follow on each other
    offset = pair * (near[:, 3].max(initial=0.0) + 2 * width)
    order = np.lexsort((near[:, 2], pair))
    pair, offset, begin, end = pair[order], offset[order], near[order, 2], near[order, 3]
    until = np.maximum.accumulate(end + offset)
    is_new = np.append(True, begin[1:] + offset[1:] > until[:-1] + 1e-6 * width)[: len(pair)]  # but for rounding
    first = np.flatnonzero(is_new)
    last = np.append(first, len(pair))[1:] - 1
    line, other = np.divmod(pair[first], len(others))
    return CommonStretches(line, other, begin[first], until[last] - offset[last])


def _concatenate(lines: Sequence[Array]) -> tuple[Array, NDArray[np.int_]]:
    """Return the points of all lines, and the index of each line's first point, ending with their number."""
    return np.ascontiguousarray(np.concatenate(lines)), np.cumsum([0, *map(len, lines)])


def extreme_headings(slopes: Array) -> Array:
    """Return the headings, rad, at the ends and the extremum of n spans, between which they are monotone.

    The slopes are (..., n, 3), the headings (..., 2 n + 1).
    """
    pairs = np.stack([slopes[..., 0], quadratic(slopes, _stationary(slopes))], axis=-1)
    return np.arctan(np.concatenate([pairs.reshape(*pairs.shape[:-2], -1), slopes[..., -1:, 2]], axis=-1))


def trace_curve(spans: Array, slopes: Array, step: float) -> tuple[Array, Array]:
    """Sample one fibre so that it turns by at most `step`, rad, between two points.

    A chord of such points is shorter than its arc by less than the fraction step^2 / 8.

    Args:
        spans: `beziers` of the fibre; shape (S, 4, 2).
        slopes: `slope_beziers` of the fibre; shape (S, 3).
        step: maximum turn, rad.

    Returns:
        Points (n, 2), and the exact headings there (n,), rad.
    """
    # 1. Begin at the ends of all spans and at their extreme headings. A position is the index of a span plus the
    # parameter in it.
    starts = np.arange(len(spans))
    positions = np.append(np.column_stack([starts, starts + _stationary(slopes)]), len(spans))
    headings = extreme_headings(slopes)
    # 2. Halve intervals that turn too much, down to the resolution of a float.
    while True:
        middles = (positions[:-1] + positions[1:]) / 2
        halved = (np.abs(np.diff(headings)) > step) & (positions[:-1] < middles) & (middles < positions[1:])
        if not halved.any():
            break
        new, middles = np.flatnonzero(halved) + 1, middles[halved]
        span = middles.astype(int)
        positions = np.insert(positions, new, middles)
        headings = np.insert(headings, new, np.arctan(quadratic(slopes[span], middles - span)))
    span = np.minimum(positions.astype(int), len(spans) - 1)
    return cubic(spans[span], positions - span), headings


def rolled_turns(points: Array, angles: Array, radius: float) -> Array:
    """Compute the turns (n - 1,), rad, out of the plane of a curve in a plane rolled up on a cylinder about y.

    Rolling preserves lengths. A line at the angle a to x is then curved out of the plane by cos(a)^2 / `radius`
    (Euler's theorem), in addition to its curvature in the plane; the two are orthogonal and add as root sum of squares.
    The headings (n,) of the points (n, 2) must hardly differ from one to the next.
    """
    curvature = np.cos(angles) ** 2 / radius
    return (curvature[1:] + curvature[:-1]) / 2 * np.hypot(*np.diff(points, axis=0).T)


def bend_radius(
    points: Array, headings: Array, window: float, out_of_plane: Array | float = 0.0
) -> tuple[float, Array]:
    """Compute the smallest bend radius of a curve: `window` over the largest total turn in a stretch of that length.

    A PCHIP curve is only C1, so its pointwise curvature does not describe how a fibre of finite stiffness lies. The
    curve is assumed to turn evenly between two points. The turn in a window is then piecewise linear in the window's
    position, so that its maximum is in a window that starts or ends at a point.

    Args:
        points: points so dense that chords measure the length; at a corner two of them coincide; shape (n, 2).
        headings: unwrapped headings of the tangents there; shape (n,), rad.
        window: length of the stretch; for a shorter curve its own length.
        out_of_plane: `rolled_turns` of the curve; shape (n - 1,), rad.

    Returns:
        The radius, and the position (2,) of the middle of the tightest bend.
    """
    arc = arc_lengths(points)
    window = min(window, arc[-1])
    turned = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(headings), out_of_plane))])  # since the first point
    # Corners at both ends of a window count: `turned` at the first of two equal points is without the corner, and
    # `interp` returns that of the last one.
    starting = np.interp(arc + window, arc, turned) - turned  # turn in the window that starts at each point
    ending = turned - np.interp(arc - window, arc, turned)  # turn in the window that ends there
    start, end = int(np.argmax(starting)), int(np.argmax(ending))
    if starting[start] >= ending[end]:
        turn, turned_at_middle = float(starting[start]), turned[start] + starting[start] / 2
    else:
        turn, turned_at_middle = float(ending[end]), turned[end] - ending[end] / 2
    position = interpolate(points, arc, np.interp(turned_at_middle, turned, arc))
    return (window / turn if turn > 0 else np.inf), position


def fold_gap(line: Array, gap: float) -> tuple[float, Array] | None:
    """Compute the smallest distance of two points of a polyline that are at least `FOLD` gaps apart along it.

    The polyline must not cross itself: the smallest distance is then between a vertex and a segment, or between two
    points exactly `FOLD` gaps apart. Also returned is the middle (2,) of the two points; None if all keep the gap.
    """
    min_arc = FOLD * gap
    arc = arc_lengths(line)
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
    import shapely  # takes a while, and lengths are computed without it

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
    here = interpolate(line, arc, at)
    offset = interpolate(line, arc, at + min_arc) - here
    advance, step = np.diff(here, axis=0), np.diff(offset, axis=0)
    fraction = _closest_fraction(offset[:-1], step, 0, 1)
    return here[:-1] + fraction * advance, offset[:-1] + fraction * step


def _closest_fraction(start: Array, step: Array, low: Array | float, high: Array | float) -> Array:
    """Return the fraction (n, 1) within low..high at which start + fraction * step, both (n, 2), is closest to zero."""
    square = np.maximum((step**2).sum(axis=1), _TINY)
    return np.clip(-(start * step).sum(axis=1) / square, low, high)[:, None]


def _stationary(slopes: Array) -> Array:
    """Return the parameter of the extremum of quadratic Beziers (..., 3), or any within 0..1 if none is inside."""
    first, second = slopes[..., 0] - slopes[..., 1], slopes[..., 2] - slopes[..., 1]
    bend = first + second
    return np.clip(np.divide(first, bend, out=np.zeros_like(bend), where=bend != 0), 0, 1)


def arc_lengths(points: Array) -> Array:
    """Return the arc length (n,) of a polyline at each vertex."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def interpolate(points: Array, arc: Array, where: Array | float) -> Array:
    """Return the points (..., 2) of a polyline at arc lengths `where` (...)."""
    return np.stack([np.interp(where, arc, points[:, axis]) for axis in (0, 1)], axis=-1)
