"""Signals of a layer or a profile and their gradient, by Gauss quadrature over elements of the fibres.

Gauss rules cut the spans of a fibre into elements whose positions and lengths do not depend on the press. The signal of
a press is the sum of the weights of the elements within its profile. In the reverse pass the gradient with respect to
position and length is accumulated over all presses first, then passed on to knots and slopes once per element.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common.compilation import kernel
from padforge.design.kernels.exact_gradient import differentiate_cubic
from padforge.design.kernels.geometry import (
    DEGREE,
    DIRECTED,
    EPS,
    MANHATTAN,
    PLAIN,
    WeightLaw,
    weigh_profile,
)
from padforge.design.kernels.pchip import extremes

Array = NDArray[np.float64]

LAYER_PRECISION = 1.5e-2
"""RMS error of signals of a layer near a press in a search, relative to the largest signal. Over a whole pad it is a
tenth to a quarter of that. The strain of a shallow fibre has a step at the edge of the contact; resolving it would take
twice as long.
"""
FINE_PRECISION = 1e-3
"""The same in the evaluation of a pad; for a profile the maximum error, in a search as well."""
TABLE_SHARE = 0.1
"""Maximum error of tabulated weights, relative to the largest one, as a share of the precision of signals."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)  # lower orders do not resolve the bends of a span
_NODES, _WEIGHTS = (1 + _NODES) / 2, _WEIGHTS / 2  # on [0, 1]
_LAYER_NODES, _LAYER_WEIGHTS = np.polynomial.legendre.leggauss(5)
_LAYER_NODES, _LAYER_WEIGHTS = (1 + _LAYER_NODES) / 2, _LAYER_WEIGHTS / 2
_FAR_NODES, _FAR_WEIGHTS = np.array([0.5]), np.array([1.0])
MAX_PIECES = 512
"""Maximum number of pieces of a span, which bounds memory. Only a profile hundreds of times shorter than a span would
need more.
"""


class Elements(NamedTuple):
    """Fibres cut into E elements: fine ones for near presses, then coarse ones for far presses."""

    horizontals: int  # number of fibres, the first ones, that run along x
    starts: Any  # first fine element of each span and, in the last column, the end of the last span; shape (F, n)
    far_starts: Any  # the same of coarse elements; shape (F, n)
    along: Array  # coordinates along the axis of the fibre; shape (E,), grid units
    across: Array  # coordinates across it; shape (E,), grid units
    length: Array  # lengths; shape (E,), grid units
    tangent_along: Array  # unit tangents, along the axis; shape (E,)
    tangent_across: Array  # unit tangents, across it; shape (E,)
    share: Array  # positions on the span, from 0 to 1; shape (E,)
    weight: Array  # quadrature weights, relative to the span; shape (E,)


def weight_table(law: WeightLaw, precision: float) -> Array:
    """Return w and v as piecewise cubics in equal steps of the squared distance, a Hermite interpolant of the profile.

    Rows of the profile have a higher degree and must be searched for; a row of this table is found by its index and
    fits in one cache line. It has no more rows than the `precision` of signals takes, so that a core caches all of it.

    Returns:
        Coefficients of w, then of v, by family and step, in powers of the fraction of a step; 0 after the end of the
        profile; shape (families, steps + 1, 8), with one family if both have the same profile.
    """
    profiles = law.profile[: _n_families(law)]
    for exponent in range(8, 18):
        tables = np.stack([_tabulate(profile, law, 1 << exponent) for profile in profiles])
        if all(_is_precise(table, profile, law, precision) for table, profile in zip(tables, profiles, strict=True)):
            break
    return tables


def _n_families(law: WeightLaw) -> int:
    """Return the number of families of fibres whose profiles differ, 1 or 2."""
    return 1 + int((law.profile[0] != law.profile[1]).any())


def _tabulate(profile: Array, law: WeightLaw, steps: int) -> Array:
    """Return the cubics of one family; shape (steps + 1, 8)."""
    out, width, step = np.zeros((steps + 1, 8)), law.radius * law.radius / steps, np.arange(steps)
    low, high = step * width, np.minimum(step + 1, steps * (1 - EPS)) * width
    for c, column in ((0, PLAIN), (4, DIRECTED)):
        (y0, d0), (y1, d1) = (_evaluate(profile, column, square) for square in (low, high))
        d0, d1 = width * d0, width * d1
        out[:-1, c], out[:-1, c + 1], out[:-1, c + 2] = y0, d0, 3 * (y1 - y0) - 2 * d0 - d1
        out[:-1, c + 3] = 2 * (y0 - y1) + d0 + d1
    return out


def _is_precise(table: Array, profile: Array, law: WeightLaw, precision: float) -> bool:
    """Return whether a table keeps its share of a precision in the middle of its steps, where a cubic errs most."""
    steps = len(table) - 1
    middles = (np.arange(steps) + 0.5) * law.radius**2 / steps
    exact = np.stack([_evaluate(profile, column, middles)[0] for column in (PLAIN, DIRECTED)])
    found = table[:-1].reshape(steps, 2, 4) @ 0.5 ** np.arange(4)
    return bool(np.abs(found.T - exact).max() <= TABLE_SHARE * precision * np.abs(exact).max())


def _evaluate(profile: Array, column: int, squares: Array) -> tuple[Array, Array]:
    """Return a polynomial of a profile, PLAIN or DIRECTED, and its derivative at squared distances of any shape.

    This is `evaluate_row` in NumPy: it is called so rarely that compiling a kernel would take longer.
    """
    row = profile[np.searchsorted(profile[:, 0], squares, side="right") - 1]
    c, x = np.moveaxis(row[..., column : column + DEGREE + 1], -1, 0), squares - row[..., 0]
    low, high = c[0] + x * (c[1] + x * (c[2] + x * c[3])), c[4] + x * (c[5] + x * (c[6] + x * c[7]))
    slope = c[1] + x * (2 * c[2] + 3 * x * c[3])
    slope += x * x * x * (4 * c[4] + x * (5 * c[5] + x * (6 * c[6] + 7 * x * c[7])))
    return low + x * x * (x * x) * high, slope


def element_spacings(law: WeightLaw, precision: float) -> tuple[float, float]:
    """Return the spacings of fine and of coarse elements at which signals of straight fibres are precise.

    The error relative to the largest signal is at most `precision`; for a layer this is the RMS error near the press.
    """
    far = 0.5 * law.near * math.sqrt(precision / LAYER_PRECISION)  # the midpoint rule has an error of second order
    return min(_fine_spacing(family, law, precision) for family in range(_n_families(law))), far


def _fine_spacing(family: int, law: WeightLaw, precision: float) -> float:
    """Return the spacing of fine elements of a family, reduced from radius / 4 until signals are precise."""
    end = law.radius
    distances, shifts = end * np.arange(32) / 32, np.arange(16)[:, None] / 16
    if law.edge:  # outside the edge of a contact, strains are smooth
        distances, shifts = 1.5 * law.edge * np.arange(12) / 12, np.arange(6)[:, None] / 6
    rule, weights = (_LAYER_NODES, _LAYER_WEIGHTS) if law.directional else (_NODES, _WEIGHTS)

    def straight_signals(spacing: float) -> Array:
        """Return the signals (distances, shifts) of elements of this spacing that begin at shifted positions."""
        width = len(rule) * spacing
        begin = width * (np.arange(-math.ceil(end / width) - 1, math.ceil(end / width) + 1) + shifts)
        points = (begin[..., None] + width * rule).reshape(len(shifts), -1, 1) * [1.0, 0.0]
        lengths, presses = np.tile(width * weights, begin.shape[-1]), distances[:, None] * [0.0, 1.0]
        tangents = np.tile([1.0, 0.0], (len(lengths), 1))
        return np.stack([sum_elements(row, lengths, tangents, presses, law, family) for row in points], axis=1)

    spacing = end / 4
    for _ in range(24):  # down to 1 / 200 of the first spacing, for steep profiles
        signals = straight_signals(spacing)
        reference = signals.mean(axis=1, keepdims=True)  # errors of different shifts cancel in the mean
        error, largest = np.abs(signals - reference), np.abs(reference).max()
        if (math.sqrt((error**2).mean()) if law.directional else error.max()) <= precision * largest:
            break
        spacing *= 0.8
    return spacing


@kernel(inline="always")
def _count_pieces(h: float, rise: float, d0: float, d1: float, longest: float) -> int:
    """Return the number of equal pieces of a span, of a mean length of at most `longest`."""
    # the slope of a span is a quadratic, which stays within its Bezier points
    steepest = max(abs(h * d0), abs(h * d1), abs(3 * rise - h * (d0 + d1)))
    return math.ceil(min(math.hypot(h, steepest) / longest, 1.0 * MAX_PIECES))


@kernel
def _count_elements(
    along: Any, across: Any, slope: Any, horizontals: int, low: Any, high: Any, nodes: int, spacing: float, total: int
) -> Any:
    """Return the number of pieces and the first element of each span, both (F, n), and in the last column their end.

    A piece has `nodes` elements, of a mean length of at most `spacing`; `total` elements precede the first span. Spans
    outside the rectangle from `low` to `high`, both (2,), get no pieces.
    """
    fibres, n = along.shape
    pieces, starts = np.zeros((fibres, n), np.int64), np.zeros((fibres, n), np.int64)
    for f in range(fibres):
        axis = 0 if f < horizontals else 1
        for j in range(n - 1):
            starts[f, j] = total
            t0, t1, v0, v1 = along[f, j], along[f, j + 1], across[f, j], across[f, j + 1]
            is_near = t1 > low[axis] and t0 < high[axis]
            if is_near and max(v0, v1) > low[1 - axis] and min(v0, v1) < high[1 - axis]:
                pieces[f, j] = _count_pieces(t1 - t0, v1 - v0, slope[f, j], slope[f, j + 1], nodes * spacing)
                total += pieces[f, j] * nodes
        starts[f, n - 1] = total
    return pieces, starts


@kernel
def _place_elements(
    along: Any, across: Any, slope: Any, pieces: Any, starts: Any, nodes: Any, weights: Any, length: int, out: Any
) -> None:
    """Write the elements of a Gauss rule on all pieces into the fields out (7, E) of `Elements`."""
    fibres, n = along.shape
    for f in range(fibres):
        for j in range(n - 1):
            h, v0, height = along[f, j + 1] - along[f, j], across[f, j], across[f, j + 1] - across[f, j]
            a1 = h * slope[f, j]
            a2, a3 = 3 * height - 2 * a1 - h * slope[f, j + 1], a1 + h * slope[f, j + 1] - 2 * height
            k = starts[f, j]
            for piece in range(pieces[f, j]):
                for i in range(len(nodes)):
                    s, weight = (piece + nodes[i]) / pieces[f, j], weights[i] / pieces[f, j]
                    rise = a1 + s * (2 * a2 + 3 * a3 * s)
                    norm = math.hypot(h, rise)
                    speed = h + abs(rise) if length == MANHATTAN else norm
                    out[0, k], out[1, k] = along[f, j] + h * s, v0 + s * (a1 + s * (a2 + s * a3))
                    out[2, k], out[3, k], out[4, k] = weight * speed, h / norm, rise / norm
                    out[5, k], out[6, k] = s, weight
                    k += 1


@kernel
def fibre_elements(
    along: Any, across: Any, slope: Any, horizontals: int, presses: Any, law: Any, spacings: tuple[float, float]
) -> Any:
    """Cut the spans of a pad into `Elements`, except spans outside the profiles of all presses."""
    low, high = np.empty((2, 2)), np.empty((2, 2))  # rectangles of fine and of coarse elements
    for axis in range(2):
        least, largest = extremes(presses[:, axis])
        for i, reach in enumerate((min(law.near, law.radius), law.radius)):
            low[i, axis], high[i, axis] = least - reach, largest + reach
    curves, (spacing, far_spacing) = (along, across, slope, horizontals), spacings
    nodes, weights = (_LAYER_NODES, _LAYER_WEIGHTS) if law.directional else (_NODES, _WEIGHTS)
    pieces, starts = _count_elements(*curves, low[0], high[0], len(nodes), spacing, np.int64(0))
    total = starts[-1, -1]
    far_pieces, far_starts = np.zeros_like(pieces), np.full_like(starts, total)
    if law.near < law.radius:
        far_pieces, far_starts = _count_elements(*curves, low[1], high[1], len(_FAR_NODES), far_spacing, total)
    out = np.empty((7, far_starts[-1, -1]))
    _place_elements(along, across, slope, pieces, starts, nodes, weights, law.length, out)
    _place_elements(along, across, slope, far_pieces, far_starts, _FAR_NODES, _FAR_WEIGHTS, law.length, out)
    return Elements(horizontals, starts, far_starts, out[0], out[1], out[2], out[3], out[4], out[5], out[6])


@kernel
def weigh_elements(elements: Any, along: Any, sensitivity: Any) -> None:
    """Multiply the lengths of elements by the sensitivity (F, K) of their fibre at even steps along its axis."""
    fibres, n = along.shape
    last = sensitivity.shape[1] - 1
    for f in range(fibres):
        first, rate = along[f, 0], last / (along[f, n - 1] - along[f, 0])
        for starts in (elements.starts, elements.far_starts):
            for k in range(starts[f, 0], starts[f, n - 1]):
                at = min(max((elements.along[k] - first) * rate, 0.0), float(last))
                i = min(int(at), last - 1)
                elements.length[k] *= sensitivity[f, i] + (at - i) * (sensitivity[f, i + 1] - sensitivity[f, i])


@kernel
def _is_near(t: Any, v: Any, j: int, ct: float, cv: float, end: float) -> bool:
    """Return whether the bounding box of span j is within `end` of (ct, cv) along both axes; spans are monotone."""
    is_beside = t[j] < ct + end and t[j + 1] > ct - end
    return is_beside and min(v[j], v[j + 1]) < cv + end and max(v[j], v[j + 1]) > cv - end


@kernel
def element_signals(along: Any, across: Any, elements: Any, presses: Any, law: Any, table: Any, out: Any) -> None:
    """Compute the signals of a pad from its elements and the `weight_table` of the law into `out` (Q, F)."""
    (fibres, n), end = along.shape, law.radius
    steps = table.shape[1] - 1
    rate = steps / end**2
    for f in range(fibres):
        t, v, axis = along[f], across[f], 0 if f < elements.horizontals else 1
        rows = table[min(axis, len(table) - 1)]
        bottom, top = extremes(v)
        for q in range(len(presses)):
            ct, cv, total = presses[q, axis], presses[q, 1 - axis], 0.0
            for j in range(n - 1 if bottom - end < cv < top + end else 0):
                if not _is_near(t, v, j, ct, cv, end):
                    continue
                begin, after = elements.far_starts[f, j], elements.far_starts[f, j + 1]
                if _is_near(t, v, j, ct, cv, law.near):
                    begin, after = elements.starts[f, j], elements.starts[f, j + 1]
                for k in range(begin, after):
                    dt, dv = elements.along[k] - ct, elements.across[k] - cv
                    square = dt * dt + dv * dv
                    at = min(square * rate, 1.0 * steps)
                    i = np.uint64(at)  # unsigned, so that no code for negative indices is compiled
                    x = at - np.int64(i)
                    weight = rows[i, 0] + x * (rows[i, 1] + x * (rows[i, 2] + x * rows[i, 3]))
                    if law.directional and square > 0:
                        projection = dt * elements.tangent_along[k] + dv * elements.tangent_across[k]
                        directed = rows[i, 4] + x * (rows[i, 5] + x * (rows[i, 6] + x * rows[i, 7]))
                        weight += directed * (projection * projection / square)
                    total += elements.length[k] * weight
            out[q, f] = total


@kernel
def sum_elements(points: Any, length: Any, tangents: Any, presses: Any, law: Any, family: int) -> Any:
    """Sum the weights of E elements for each press (Q,), by their points (E, 2), lengths (E,) and tangents (E, 2)."""
    out, profile = np.zeros(len(presses)), law.profile[family]
    for q in range(len(presses)):
        for k in range(len(length)):
            dt, dv = points[k, 0] - presses[q, 0], points[k, 1] - presses[q, 1]
            out[q] += length[k] * weigh_profile(dt, dv, tangents[k, 0], tangents[k, 1], profile, law)
    return out


@kernel(inline="always")
def _differentiate_elements(
    along: Any, across: Any, elements: Any, presses: Any, upstream: Any, law: Any, table: Any, out: Any
) -> None:
    """Add the gradient of sum(upstream * signals) to `out` (E, 5).

    Its columns are the gradients by along, across, length, tangent_along and tangent_across of each element.
    """
    (fibres, n), end = along.shape, law.radius
    steps = table.shape[1] - 1
    rate = steps / end**2
    for f in range(fibres):
        t, v, axis = along[f], across[f], 0 if f < elements.horizontals else 1
        rows = table[min(axis, len(table) - 1)]
        bottom, top = extremes(v)
        for q in range(len(presses)):
            ct, cv, up = presses[q, axis], presses[q, 1 - axis], upstream[q, f]
            for j in range(n - 1 if bottom - end < cv < top + end else 0):
                if not _is_near(t, v, j, ct, cv, end):
                    continue
                begin, after = elements.far_starts[f, j], elements.far_starts[f, j + 1]
                if _is_near(t, v, j, ct, cv, law.near):
                    begin, after = elements.starts[f, j], elements.starts[f, j + 1]
                for k in range(begin, after):
                    dt, dv = elements.along[k] - ct, elements.across[k] - cv
                    square = dt * dt + dv * dv
                    at = square * rate
                    if at >= steps:
                        continue
                    i = np.uint64(at)
                    x, up_length = at - np.int64(i), 2 * up * elements.length[k]
                    weight = rows[i, 0] + x * (rows[i, 1] + x * (rows[i, 2] + x * rows[i, 3]))
                    radial = up_length * rate * (rows[i, 1] + x * (2 * rows[i, 2] + x * 3 * rows[i, 3]))
                    if law.directional and square > 0:
                        ut, uv = elements.tangent_along[k], elements.tangent_across[k]
                        directed = rows[i, 4] + x * (rows[i, 5] + x * (rows[i, 6] + x * rows[i, 7]))
                        directed_slope = rate * (rows[i, 5] + x * (2 * rows[i, 6] + x * 3 * rows[i, 7]))
                        inverse = 1 / square
                        cosine_by_distance = (dt * ut + dv * uv) * inverse
                        cosine_square = cosine_by_distance * cosine_by_distance * square
                        weight += directed * cosine_square
                        radial += up_length * cosine_square * (directed_slope - directed * inverse)
                        grad_projection = up_length * directed * cosine_by_distance
                        out[k, 0] += grad_projection * ut
                        out[k, 1] += grad_projection * uv
                        out[k, 3] += grad_projection * dt
                        out[k, 4] += grad_projection * dv
                    out[k, 0] += radial * dt
                    out[k, 1] += radial * dv
                    out[k, 2] += up * weight


@kernel
def elements_gradient(
    along: Any, across: Any, slope: Any, elements: Any, presses: Any, upstream: Any, law: Any, table: Any
) -> Any:
    """Compute the gradient (3, F, n) of sum(upstream (Q, F) * signals) by along, across and slope of one pad.

    Slopes are treated as independent of knots. The elements are those of `fibre_elements` for the same arguments.
    """
    fibres, n = along.shape
    out, element_gradient = np.zeros((3, fibres, n)), np.zeros((len(elements.length), 5))
    _differentiate_elements(along, across, elements, presses, upstream, law, table, element_gradient)
    for starts in (elements.starts, elements.far_starts):
        _pass_to_knots(along, across, slope, elements, starts, element_gradient, law, out)
    return out


@kernel(inline="always")
def _pass_to_knots(
    along: Any, across: Any, slope: Any, elements: Any, starts: Any, element_gradient: Any, law: Any, out: Any
) -> None:
    """Add the gradient (E, 5) by the elements that begin at `starts` to that by along, across and slope (3, F, n)."""
    fibres, n = along.shape
    d_point, d_tangent = np.empty((6, 2)), np.empty((6, 2))
    for f in range(fibres):
        for j in range(n - 1):
            h, d0, d1 = along[f, j + 1] - along[f, j], slope[f, j], slope[f, j + 1]
            m = (across[f, j + 1] - across[f, j]) / h
            for k in range(starts[f, j], starts[f, j + 1]):
                s = elements.share[k]
                dv_ds = h * (d0 + s * (2 * (3 * m - 2 * d0 - d1) + 3 * s * (d0 + d1 - 2 * m)))
                is_manhattan, norm = law.length == MANHATTAN, math.hypot(h, dv_ds)
                speed = h + abs(dv_ds) if is_manhattan else norm
                speed_t = 1.0 if is_manhattan else h / speed
                speed_v = math.copysign(1.0, dv_ds) if is_manhattan else dv_ds / speed
                grad_speed = element_gradient[k, 2] * elements.weight[k]
                ut, uv = elements.tangent_along[k], elements.tangent_across[k]
                # only the part of the gradient across the unit tangent turns it
                grad_turn = (element_gradient[k, 4] * ut - element_gradient[k, 3] * uv) / norm
                differentiate_cubic(s, h, d0, d1, d_point, d_tangent)
                for x in range(6):
                    by_position = element_gradient[k, 0] * d_point[x, 0] + element_gradient[k, 1] * d_point[x, 1]
                    by_length = grad_speed * (speed_t * d_tangent[x, 0] + speed_v * d_tangent[x, 1])
                    by_tangent = grad_turn * (ut * d_tangent[x, 1] - uv * d_tangent[x, 0])
                    out[x // 2, f, j + x % 2] += by_position + by_length + by_tangent
