"""How far lines run along each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError, check_float, check_type
from padforge.design.kernels.geometry import near_intervals
from padforge.design.kernels.pchip import pchip_slopes
from padforge.design.morphology import Array, Morphology, assemble_knots
from padforge.design.settings import Layout

MAX_POINTS = 10**7
"""Most points the curves of a pad are flattened to."""


def slopes(pad: Morphology) -> Array:
    """(F, N+2) PCHIP slope of the cross coordinate at each knot, per unit of travel."""
    out = np.empty(pad.knots.shape[:2])
    for fibre, (t, v) in enumerate(_travel_and_cross(pad)):
        pchip_slopes(t, v, out[fibre])
    return out


def beziers(pad: Morphology) -> Array:
    """(F, N+1, 4, 2) Bezier control points of every span: a PCHIP span is exactly one cubic Bezier segment."""
    d = slopes(pad)
    spans = np.empty((len(pad.knots), pad.knots.shape[1] - 1, 4, 2))
    for fibre, (t, v) in enumerate(_travel_and_cross(pad)):
        travel = pad.layout.family(fibre)
        third = np.diff(t) / 3
        spans[fibre, :, :, travel] = np.stack([t[:-1], t[:-1] + third, t[1:] - third, t[1:]], axis=1)
        rise = np.stack([v[:-1], v[:-1] + third * d[fibre, :-1], v[1:] - third * d[fibre, 1:], v[1:]], axis=1)
        spans[fibre, :, :, 1 - travel] = rise
    return spans


def slope_beziers(pad: Morphology) -> Array:
    """(F, N+1, 3) Bezier coefficients of every span's slope, cross per travel: a quadratic in the span's parameter."""
    d = slopes(pad)
    inner = np.empty((len(d), d.shape[1] - 1))
    for fibre, (t, v) in enumerate(_travel_and_cross(pad)):
        inner[fibre] = 3 * np.diff(v) / np.diff(t) - d[fibre, :-1] - d[fibre, 1:]
    return np.stack([d[:, :-1], inner, d[:, 1:]], axis=2)


def quadratic(control: Array, u: Array) -> Array:
    """Quadratic Beziers: the values (...,) of coefficients (..., 3) at parameters (...,)."""
    w = 1 - u
    return w**2 * control[..., 0] + 2 * w * u * control[..., 1] + u**2 * control[..., 2]


def cubic(control: Array, u: Array) -> Array:
    """Cubic Beziers: the points (..., 2) of control points (..., 4, 2) at parameters (...,)."""
    u = u[..., None]
    w = 1 - u
    p = np.moveaxis(control, -2, 0)
    return w**3 * p[0] + 3 * w**2 * u * p[1] + 3 * w * u**2 * p[2] + u**3 * p[3]


def flatten(pad: Morphology, tolerance: float) -> list[Array]:
    """Each fibre as a polyline (n, 2) within `tolerance` of its curve, in grid units.

    A span is cut into n equal steps of its parameter with n = ceil(sqrt(3 L / (4 tolerance))), L the largest second
    difference of its control points; the chord error is then at most `tolerance` (Wang's bound for cubics).

    Raises:
        InputError: a tolerance out of range, or so small that there would be more than MOST_POINTS.
    """
    tolerance = check_float("tolerance", tolerance, 1e-12, 1e6)
    curves = beziers(check_type("pad", pad, Morphology))
    second = np.linalg.norm(np.diff(curves, 2, axis=2), axis=3).max(axis=2)
    counts = np.maximum(1, np.ceil(np.sqrt(0.75 * second / tolerance))).astype(int)
    if counts.sum() > MAX_POINTS:
        raise InputError(f"tolerance is {tolerance:g}: that takes {counts.sum()} points, allowed are {MAX_POINTS}")
    steps = counts.ravel()
    starts = np.cumsum(steps) - steps  # a pad's spans at once: many take no longer than a few
    u = (np.arange(steps.sum()) - np.repeat(starts, steps)) / np.repeat(steps, steps)
    points = cubic(np.repeat(curves.reshape(-1, 4, 2), steps, axis=0), u)
    fibres = np.split(points, starts.reshape(counts.shape)[1:, 0])
    return [np.vstack([line, spans[-1, -1:]]) for line, spans in zip(fibres, curves, strict=True)]


def lengths(pad: Morphology) -> Array:
    """(F,) arc length of every fibre in grid units, to about 1e-5 where knots nearly coincide."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    u = ((nodes + 1) / 2)[:, None]
    derivative = 3 * np.diff(beziers(pad), axis=2)[:, :, :, None, :]
    speed = derivative[:, :, 0] * (1 - u) ** 2 + 2 * derivative[:, :, 1] * u * (1 - u) + derivative[:, :, 2] * u**2
    return (np.linalg.norm(speed, axis=-1) @ (weights / 2)).sum(axis=1)


@dataclass(frozen=True)
class Crossing:
    """Two fibres that meet: their indices (0..F-1, first < second) and the place (x, y) in grid units."""

    first: int
    second: int
    place: tuple[float, float]


def crossings(pad: Morphology, tolerance: float = 1e-4, across: bool = True) -> list[Crossing]:
    """Every place where two fibres meet, ordered by fibre and place; fibres are flattened to `tolerance`.

    Fibres that touch or run on each other count at the middle of what they share. Without `across` only fibres of
    one family are looked at.
    """
    check_type("across", across, bool)
    import shapely  # takes a while, and lengths are asked for without it

    lines = np.array([shapely.LineString(points) for points in flatten(pad, tolerance)])
    first, second = shapely.STRtree(lines).query(lines)
    horizontals = pad.layout.horizontals
    wanted = (first < second) & (across | ((first < horizontals) == (second < horizontals)))
    first, second = first[wanted], second[wanted]
    shared = shapely.intersection(lines[first], lines[second])
    parts, pair = shapely.get_parts(shared, return_index=True)
    point = shapely.get_type_id(parts) == shapely.GeometryType.POINT
    overlap = np.flatnonzero(shapely.length(shared) > 0)
    runs, of_overlap = shapely.get_parts(shapely.line_merge(shared[overlap]), return_index=True)
    middles = shapely.line_interpolate_point(runs, 0.5, normalized=True)
    places = shapely.get_coordinates(np.concatenate([parts[point], middles])).tolist()
    pair = np.concatenate([pair[point], overlap[of_overlap]])
    found = [
        Crossing(i, j, (x, y)) for i, j, (x, y) in zip(first[pair].tolist(), second[pair].tolist(), places, strict=True)
    ]
    return sorted(found, key=lambda c: (c.first, c.second, c.place))


def crossing_angles(pad: Morphology, across: Sequence[Crossing]) -> Array:
    """Angle in degrees, 0..90, between the curves' tangents at crossings of a horizontal with a vertical fibre.

    Where two fibres touch or run on each other they have one tangent, so that the angle is 0.
    """
    x, y = np.array([c.place for c in across]).reshape(-1, 2).T
    rise = _slopes_at(pad, np.array([c.first for c in across], dtype=int), x)  # dy / dx of the horizontal
    run = _slopes_at(pad, np.array([c.second for c in across], dtype=int), y)  # dx / dy of the vertical
    return np.degrees(np.arctan2(np.abs(1 - rise * run), np.abs(rise + run)))


def _slopes_at(pad: Morphology, fibre: NDArray[np.int_], travel: Array) -> Array:
    """Slope of each fibre (n,) at its own travel coordinate (n,)."""
    knots = np.where((fibre < pad.layout.horizontals)[:, None], pad.knots[fibre, :, 0], pad.knots[fibre, :, 1])
    span = np.clip((knots <= travel[:, None]).sum(axis=1) - 1, 0, knots.shape[1] - 2)
    row = np.arange(len(fibre))
    u = (travel - knots[row, span]) / (knots[row, span + 1] - knots[row, span])
    return quadratic(slope_beziers(pad)[fibre, span], u)


def _travel_and_cross(pad: Morphology) -> list[tuple[Array, Array]]:
    """Travel and cross coordinates of every fibre, contiguous."""
    axes = [pad.layout.family(fibre) for fibre in range(len(pad.knots))]
    return [(knots[:, a].copy(), knots[:, 1 - a].copy()) for knots, a in zip(pad.knots, axes, strict=True)]


def refine(knots: Array, count: int, layout: Layout) -> Array:
    """Knots with `count` inner ones a fibre: more are put on the curve, in the middle of the longest spans.

    Args:
        knots: (F, n, 2) with n - 2 <= count. layout: of the F fibres.
    """
    from scipy.interpolate import PchipInterpolator

    fibres = []
    for fibre, line in enumerate(knots):
        axis = layout.family(fibre)
        travel = line[:, axis]
        curve = PchipInterpolator(travel, line[:, 1 - axis])
        while len(travel) < count + 2:
            longest = int(np.argmax(np.diff(travel)))
            travel = np.insert(travel, longest + 1, travel[longest : longest + 2].mean())
        cross = curve(travel)
        fibres.append(np.stack([travel, cross] if axis == 0 else [cross, travel], axis=-1))
    return assemble_knots(np.array(fibres)[:, 1:-1], layout)


_TOUCHING = 1e-6
"""Share of the width by which two intervals of one line may be apart and still be one stretch: rounding."""


@dataclass(frozen=True)
class CommonStretches:
    """Stretches of lines in which all of each is near another line, ordered by line, other line and place.

    Attributes:
        line: (n,) index of each one's line.
        other: (n,) index of the line that it is near.
        begin: (n,) arc at which it begins, from the start of its line.
        end: (n,) arc at which it ends.
    """

    line: NDArray[np.int_]
    other: NDArray[np.int_]
    begin: Array
    end: Array

    @property
    def length(self) -> Array:
        """(n,) length of each along its line."""
        return self.end - self.begin


def common_stretches(lines: Sequence[Array], others: Sequence[Array], width: float) -> CommonStretches:
    """Return every stretch of `lines` that is nearer than `width` to one of `others`.

    Two straight lines that cross at an angle a have a stretch of 2 width / sin(a) in common.

    Args:
        lines: polylines (n, 2), one or more.
        others: polylines (n, 2), one or more, in the same unit.
        width: distance below which two lines count as running along each other.
    """
    near = near_intervals(*_joined(lines), *_joined(others), width)
    pair = near[:, 0].astype(int) * len(others) + near[:, 1].astype(int)
    # pairs laid out one after another on one axis: intervals that follow on each other are one stretch
    offset = pair * (near[:, 3].max(initial=0.0) + 2 * width)
    order = np.lexsort((near[:, 2], pair))
    pair, offset, begin, end = pair[order], offset[order], near[order, 2], near[order, 3]
    until = np.maximum.accumulate(end + offset)
    new = np.ones(len(pair), bool)
    new[1:] = begin[1:] + offset[1:] > until[:-1] + _TOUCHING * width
    first = np.flatnonzero(new)
    last = np.append(first, len(pair))[1:] - 1
    line, other = np.divmod(pair[first], len(others))
    return CommonStretches(line, other, begin[first], until[last] - offset[last])


def _joined(lines: Sequence[Array]) -> tuple[Array, NDArray[np.int_]]:
    """All points of lines, one line after the other, and where each line's begin, and how many points there are."""
    return np.ascontiguousarray(np.concatenate(lines)), np.cumsum([0, *map(len, lines)])
