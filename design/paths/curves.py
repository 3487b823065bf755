"""Curves of a pad: PCHIP spans as Bezier curves, lengths, crossings, and stretches that run along each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError, check_float, check_type
from padforge.design.kernels.geometry import find_near_intervals
from padforge.design.kernels.pchip import population_slopes
from padforge.design.morphology import Array, Morphology, assemble_knots, split_axes
from padforge.design.settings import Layout

MAX_POINTS = 10**7
"""Points that the curves of a pad are flattened to."""
_ROUNDING = 1e-6
"""Gap, relative to the width, up to which two intervals of a line are one stretch."""


def _hermite(pad: Morphology) -> tuple[Array, Array, Array]:
    """Return the knots along and across each fibre's axis, and the PCHIP slopes there, all (F, N + 2)."""
    along, across = split_axes(pad.knots[None], pad.layout.horizontals)
    return along[0], across[0], population_slopes(along, across)[0]


def slopes(pad: Morphology) -> Array:
    """Compute the PCHIP slopes at the knots, across per along; shape (F, N + 2)."""
    return _hermite(pad)[2]


def beziers(pad: Morphology) -> Array:
    """Compute the Bezier control points of every span, which is exactly one cubic Bezier segment.

    Returns:
        Control points; shape (F, N + 1, 4, 2), grid units.
    """
    t, v, d = _hermite(pad)
    third = np.diff(t) / 3
    along = np.stack([t[:, :-1], t[:, :-1] + third, t[:, 1:] - third, t[:, 1:]], axis=-1)
    across = np.stack([v[:, :-1], v[:, :-1] + third * d[:, :-1], v[:, 1:] - third * d[:, 1:], v[:, 1:]], axis=-1)
    spans = np.stack([along, across], axis=-1)
    spans[pad.layout.horizontals :] = spans[pad.layout.horizontals :, :, :, ::-1].copy()  # verticals run along y
    return spans


def slope_beziers(pad: Morphology) -> Array:
    """Compute the Bezier coefficients of every span's slope, a quadratic in the span's parameter.

    Returns:
        Coefficients, across per along; shape (F, N + 1, 3).
    """
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
        InputError: a tolerance out of range, or so small that there would be more than MAX_POINTS.
    """
    tolerance = check_float("tolerance", tolerance, 1e-12, 1e6)
    curves = beziers(check_type("pad", pad, Morphology))
    second = np.linalg.norm(np.diff(curves, 2, axis=2), axis=3).max(axis=2)
    counts = np.maximum(1, np.ceil(np.sqrt(0.75 * second / tolerance))).astype(int)
    if counts.sum() > MAX_POINTS:
        raise InputError(f"tolerance is {tolerance:g}: that takes {counts.sum()} points, allowed are {MAX_POINTS}")
    steps = counts.ravel()
    starts = np.cumsum(steps) - steps  # all spans at once: many take no longer than a few
    u = (np.arange(steps.sum()) - np.repeat(starts, steps)) / np.repeat(steps, steps)
    points = cubic(np.repeat(curves.reshape(-1, 4, 2), steps, axis=0), u)
    fibres = np.split(points, starts.reshape(counts.shape)[1:, 0])
    return [np.vstack([line, spans[-1, -1:]]) for line, spans in zip(fibres, curves, strict=True)]


def lengths(pad: Morphology) -> Array:
    """Compute the arc length of each fibre by Gauss-Legendre quadrature, to about 1e-5 where knots nearly coincide.

    Returns:
        Lengths; shape (F,), grid units.
    """
    nodes, weights = np.polynomial.legendre.leggauss(32)
    u = ((nodes + 1) / 2)[:, None]
    derivative = 3 * np.diff(beziers(pad), axis=2)[:, :, :, None, :]
    speed = derivative[:, :, 0] * (1 - u) ** 2 + 2 * derivative[:, :, 1] * u * (1 - u) + derivative[:, :, 2] * u**2
    return (np.linalg.norm(speed, axis=-1) @ (weights / 2)).sum(axis=1)


@dataclass(frozen=True)
class Crossing:
    """Crossing of two fibres.

    Attributes:
        first: index of the first fibre.
        second: index of the second fibre, > first.
        position: x and y, grid units.
    """

    first: int
    second: int
    position: tuple[float, float]


def crossings(pad: Morphology, tolerance: float = 1e-4, across: bool = True) -> list[Crossing]:
    """Find every crossing of two fibres, ordered by fibre and position.

    Fibres that touch or run along each other cross in the middle of what they share.

    Args:
        pad: the fibres.
        tolerance: tolerance of `flatten`, grid units.
        across: whether to include crossings of horizontals with verticals, beside those within a family.
    """
    check_type("across", across, bool)
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
    """Compute the angles between the tangents at crossings of a horizontal with a vertical fibre.

    Fibres that touch or run along each other have a common tangent, so their angle is 0.

    Args:
        pad: the fibres.
        crossings: n crossings; the first fibre is the horizontal one.

    Returns:
        Angles, 0..90 degrees; shape (n,).
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
    """Insert knots on the curves, in the middle of the longest spans, up to `count` inner knots a fibre.

    Args:
        knots: shape (F, n, 2) with n - 2 <= count, grid units.
        count: inner knots per fibre.
        layout: layout of the F fibres.

    Returns:
        Knots; shape (F, count + 2, 2), grid units.
    """
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


@dataclass(frozen=True)
class CommonStretches:
    """Stretches of lines that are entirely near another line, ordered by line, other line and position.

    Attributes:
        line: index of the line; shape (n,).
        other: index of the line that it is near; shape (n,).
        begin: arc length at the start, along `line`; shape (n,).
        end: arc length at the end; shape (n,).
    """

    line: NDArray[np.int_]
    other: NDArray[np.int_]
    begin: Array
    end: Array

    @property
    def length(self) -> Array:
        """Length of each stretch; shape (n,)."""
        return self.end - self.begin


def common_stretches(lines: Sequence[Array], others: Sequence[Array], width: float) -> CommonStretches:
    """Find every stretch of `lines` that is nearer than `width` to one of `others`.

    Two straight lines that cross at an angle a have a stretch of 2 width / sin(a) in common.

    Args:
        lines: polylines (n, 2), one or more.
        others: polylines (n, 2), one or more, in the same unit.
        width: distance below which two lines count as running along each other.
    """
    near = find_near_intervals(*_concatenate(lines), *_concatenate(others), width)
    pair = near[:, 0].astype(int) * len(others) + near[:, 1].astype(int)
    # place pairs one after another on one axis, then merge intervals that follow on each other
    offset = pair * (near[:, 3].max(initial=0.0) + 2 * width)
    order = np.lexsort((near[:, 2], pair))
    pair, offset, begin, end = pair[order], offset[order], near[order, 2], near[order, 3]
    until = np.maximum.accumulate(end + offset)
    is_new = np.ones(len(pair), bool)
    is_new[1:] = begin[1:] + offset[1:] > until[:-1] + _ROUNDING * width
    first = np.flatnonzero(is_new)
    last = np.append(first, len(pair))[1:] - 1
    line, other = np.divmod(pair[first], len(others))
    return CommonStretches(line, other, begin[first], until[last] - offset[last])


def _concatenate(lines: Sequence[Array]) -> tuple[Array, NDArray[np.int_]]:
    """Return the points of all lines, and the index of each line's first point, ending with their number."""
    return np.ascontiguousarray(np.concatenate(lines)), np.cumsum([0, *map(len, lines)])
