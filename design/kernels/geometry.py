"""Geometry shared by the kernels: press shapes and weights, reachable fibres, near polylines, polynomial roots."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common.compilation import kernel
from padforge.design.kernels.pchip import piece_of
from padforge.design.settings import Layout, profile_spline

Array = NDArray[np.float64]

EPS = 2.0**-52
UNIFORM, INVERSE_SQUARE, INVERSE, PROFILE = 0, 1, 2, 3
MANHATTAN, EUCLIDEAN = 0, 1
DEGREE = 7  # of the polynomials of a layer's profile; those of splines are cubic, with further coefficients 0
PLAIN = 1  # first column of the coefficients of w in a row of a profile
DIRECTED = 2 + DEGREE  # first column of the coefficients of v
COLUMNS = 3 + 2 * DEGREE  # number of columns of a profile


class Ends(NamedTuple):
    """Fibre ends: horizontal i, from 0, is at the height (i + 1) spacing_y, vertical i at x = (i + 1) spacing_x."""

    horizontals: int  # number of horizontals
    verticals: int  # number of verticals
    spacing_y: float  # distance of horizontals, grid units
    spacing_x: float  # distance of verticals, grid units


class WeightLaw(NamedTuple):
    """Weight of a fibre element in a press.

    A profile is w(d) + v(d) cos^2 phi, with the distance d to the press centre and the angle phi between the fibre and
    the direction to the centre; v is 0 at d = 0. It has a table for each family, since their fibres may lie at
    different depths. A row of the table has a squared distance, and the coefficients of the polynomials w and v in the
    excess over that squared distance, which hold up to that of the next row.
    """

    radius: float  # circumradius of the shape, or the distance at which a profile ends
    weight: int  # UNIFORM, INVERSE_SQUARE, INVERSE or PROFILE
    length: int  # MANHATTAN or EUCLIDEAN
    profile: Array = np.empty((2, 0, COLUMNS))  # the tables; without the first axis in the frame of a family
    bins: NDArray[np.int32] = np.empty(0, np.int32)  # row at the beginning of each of equal steps of squared distance
    bin_rate: float = 0.0  # steps per squared distance
    directional: bool = False  # whether v is not 0
    near: float = math.inf  # distance from which the profile is smooth enough for a coarse quadrature
    edge: float = 0.0  # distance of the edge of a contact, at which the profile bends most; 0 if there is none


@kernel
def weigh(square: float, law: Any) -> float:
    """Return the weight of a fibre element in a shape, at a squared distance from the press centre."""
    radius, weight = law.radius, law.weight
    if weight == UNIFORM:
        return 1.0
    if weight == INVERSE_SQUARE:
        return 1 / (radius + square)
    return 1 / max(math.sqrt(square), radius / 100)


@kernel(inline="always")  # else counting references takes most of the time
def find_row(square: float, profile: Any, law: Any) -> int:
    """Return the row of a family's profile that applies at a squared distance, below that of its end."""
    row = law.bins[int(square * law.bin_rate)]
    while row < len(profile) - 1 and square >= profile[row + 1, 0]:
        row += 1
    return row


@kernel(inline="always")  # else counting references takes most of the time
def evaluate_row(profile: Any, row: int, column: int, x: float) -> float:
    """Return a polynomial of a profile, PLAIN or DIRECTED, at the excess x over the squared distance of its row."""
    c, square = column, x * x
    low = profile[row, c] + x * (profile[row, c + 1] + x * (profile[row, c + 2] + x * profile[row, c + 3]))
    high = profile[row, c + 4] + x * (profile[row, c + 5] + x * (profile[row, c + 6] + x * profile[row, c + 7]))
    return low + square * square * high


@kernel(inline="always")  # else counting references takes most of the time
def weigh_profile(dt: float, dv: float, ut: float, uv: float, profile: Any, law: Any) -> float:
    """Return the weight of an element at (dt, dv) from the press centre, of unit tangent (ut, uv), in a profile."""
    square = dt * dt + dv * dv
    if square >= law.radius * law.radius:
        return 0.0
    i = find_row(square, profile, law)
    x = square - profile[i, 0]
    weight = evaluate_row(profile, i, PLAIN, x)
    if law.directional and square > 0:
        along = dt * ut + dv * uv
        weight += evaluate_row(profile, i, DIRECTED, x) * (along * along / square)
    return weight


@kernel(_nrt=False)  # avoids counting references too, and its callers compile faster than with inlining
def weigh_element(t: float, v: float, run: float, rise: float, law: Any) -> float:
    """Return the weight of an element at (t, v) from the press centre of the direction (run, rise), by a framed law."""
    if law.weight != PROFILE:
        return weigh(t * t + v * v, law)
    norm = math.sqrt(run * run + rise * rise)
    return weigh_profile(t, v, run / norm, rise / norm, law.profile, law)


def profile_law(
    length: int, families: tuple[tuple[Array, Array, Array], ...], near: float = math.inf, edge: float = 0.0
) -> WeightLaw:
    """Return the law of profiles through weights at distances.

    Without an edge, the functions w and v are a `profile_spline`. With an edge, they are polynomials of the squared
    distance, each through DEGREE + 1 points, of which the last one is the first of the next polynomial.

    Args:
        length: MANHATTAN or EUCLIDEAN.
        families: distances, which are equal for all, weights w and weights v; once for both families, or for each.
        near: distance from which a coarse quadrature is sufficient.
        edge: distance of the edge of a contact; 0 if there is none.
    """
    fit = _fit_polynomials if edge else _fit_splines
    tables = [fit(*family) for family in families]
    profile = np.ascontiguousarray(np.stack([tables[0], tables[-1]]))
    end, starts = float(families[0][0][-1]), profile[0, :, 0]
    finest = float(np.diff(np.append(starts, end**2)).min())
    steps = min(1 << 15, math.ceil(end**2 / finest - 1e-6))
    # the factor makes a row that begins with a step, except for rounding, the row of that step
    bins = np.searchsorted(starts, np.arange(steps + 1) * (end**2 / steps) * (1 + 1e-12), side="right") - 1
    directional = any(bool(np.any(directed)) for _, _, directed in families)
    return WeightLaw(end, PROFILE, length, profile, bins.astype(np.int32), steps / end**2, directional, near, edge)


def _fit_splines(distance: Array, plain: Array, directed: Array) -> Array:
    """Return the rows (n - 1, COLUMNS) of splines through weights at distances, all (n,)."""
    rows = np.zeros((len(distance) - 1, COLUMNS))
    for column, weight in ((PLAIN, plain), (DIRECTED, directed)):
        spline = profile_spline(distance, weight)
        rows[:, 0], rows[:, column : column + 4] = spline.x[:-1], spline.c[::-1].T
    return rows


def _fit_polynomials(distance: Array, plain: Array, directed: Array) -> Array:
    """Return the rows (B, COLUMNS) of polynomials through weights at distances, all (DEGREE B + 1,)."""
    index = DEGREE * np.arange(len(distance) // DEGREE)[:, None] + np.arange(DEGREE + 1)
    squares = distance[index] ** 2
    start, width = squares[:, :1], squares[:, -1:] - squares[:, :1]
    powers = ((squares - start) / width)[..., None] ** np.arange(DEGREE + 1)
    weights = np.stack([plain[index], directed[index]], axis=-1)
    coefficients = np.linalg.solve(powers, weights) / width[..., None] ** np.arange(DEGREE + 1)[:, None]
    return np.column_stack([start, coefficients[..., 0], coefficients[..., 1]])


@lru_cache(maxsize=64)
def frame_shape(radius: float, sides: int | None) -> tuple[tuple[Array, Array], Array]:
    """Return a polygon of `sides` in a circle of `radius`, or the circle if None, in the frame of each family.

    At t a polygon extends up to the lowest line through an upper edge and down to the highest through a lower edge.
    A circle has no breakpoints.

    Returns:
        Two chains (3, B), of breakpoints t, upper v and lower v; and extents (2, 5): minimum and maximum t, minimum and
        maximum v, radius of the inscribed circle.
    """
    if sides is None:
        empty = np.empty((3, 0))
        return (empty, empty), radius * np.tile([-1.0, 1.0, -1.0, 1.0, 1.0], (2, 1))
    corner = 2 * np.pi * np.arange(sides) / sides
    normal = corner + np.pi / sides
    apothem = np.cos(np.pi / sides)
    chains, extents = [], []
    for to_frame in ((np.cos, np.sin), (np.sin, np.cos)):
        t = np.sort(to_frame[0](corner))
        t = t[np.append(True, np.diff(t) > 1e-12)]
        along, across = to_frame[0](normal), to_frame[1](normal)
        edge = (apothem - np.outer(t, along)) / np.where(np.abs(across) < 1e-12, 1, across)
        upper = np.where(across > 1e-12, edge, np.inf).min(axis=1)
        lower = np.where(across < -1e-12, edge, -np.inf).max(axis=1)
        chains.append(radius * np.stack([t, upper, lower]))
        extents.append([t[0], t[-1], lower.min(), upper.max(), apothem])
    return (chains[0], chains[1]), radius * np.array(extents)


@kernel
def select_frame(shape: Any, family: int) -> Any:
    """Return a shape (chains and extents in both frames, law) in the frame of one family."""
    chains, extents, law = shape
    table = law.profile[family], law.bins, law.bin_rate, law.directional
    framed = WeightLaw(law.radius, law.weight, law.length, *table, law.near, law.edge)
    return (chains[0] if family == 0 else chains[1]), extents[family], framed


def max_offsets(across: Array, layout: Layout) -> Array:
    """Compute the largest offset (P, 2) of the fibres of each family from their own level."""
    offsets = np.abs(across - layout.levels[:, None])
    return np.stack([offsets[:, rows].max(axis=(1, 2), initial=0.0) for rows in layout.families], axis=1)


@kernel
def find_touched_range(cv: float, extents: Any, max_offset: float, ends: Any, family: int) -> tuple[int, int]:
    """Return the range (first, last + 1) of the fibres of a family that a press at `cv` can touch.

    Their levels are within the extents (5,) of the press plus the maximum offset of a fibre from its level.
    """
    before = 0 if family == 0 else ends.horizontals
    count, spacing = (ends.horizontals, ends.spacing_y) if family == 0 else (ends.verticals, ends.spacing_x)
    tolerance = 8 * EPS * (abs(cv) + extents[3])  # includes fibres on the boundary despite rounding
    first = min(max(math.ceil((cv + extents[2] - max_offset - tolerance) / spacing) - 1, 0.0), float(count))
    end = min(max(math.floor((cv + extents[3] + max_offset + tolerance) / spacing), 0.0), float(count))
    return before + int(first), before + int(end)


_BOX_SEGMENTS = 8  # segments per bounding box


@kernel
def _clip_to_slab(
    value: float, slope: float, lower: float, upper: float, low: float, high: float
) -> tuple[float, float]:
    """Clip low..high to the t of lower <= value + t slope <= upper; low > high if there are none."""
    if slope == 0:
        return (low, high) if lower <= value <= upper else (1.0, 0.0)
    first, last = (lower - value) / slope, (upper - value) / slope
    return max(low, min(first, last)), min(high, max(first, last))


@kernel(inline="always")
def _clip_to_disc(x: float, y: float, dx: float, dy: float, radius: float) -> tuple[float, float]:
    """Clip 0..1 to the t at which (x, y) + t (dx, dy) is within `radius` of 0; low > high if there are none."""
    square, middle = dx * dx + dy * dy, x * dx + y * dy
    root = middle * middle - square * (x * x + y * y - radius * radius)
    if root < 0:
        return 1.0, 0.0
    half = math.sqrt(root)
    return max(0.0, (-middle - half) / square), min(1.0, (half - middle) / square)


@kernel(inline="always")
def _clip_to_capsule(
    x: float, y: float, dx: float, dy: float, ex: float, ey: float, width: float
) -> tuple[float, float]:
    """Clip 0..1 to the t at which (x, y) + t (dx, dy) is within `width` of the segment from 0 to (ex, ey).

    The points near a segment are a rectangle and a disc at either end. Their union is convex, so a line is inside from
    the first to the last t at which it is in one of the three.
    """
    low, high = 1.0, 0.0
    length = math.hypot(ex, ey)
    if length > 0:
        ux, uy = ex / length, ey / length
        low, high = _clip_to_slab(x * ux + y * uy, dx * ux + dy * uy, 0.0, length, 0.0, 1.0)
        low, high = _clip_to_slab(y * ux - x * uy, dy * ux - dx * uy, -width, width, low, high)
    for at in (0.0, 1.0):
        begin, end = _clip_to_disc(x - at * ex, y - at * ey, dx, dy, width)
        if begin < end:
            low, high = (min(low, begin), max(high, end)) if low < high else (begin, end)
    return low, high


@kernel
def _bound_segments(points: Any, first: Any, margin: float) -> tuple[Any, Any, Any]:
    """Bound every few segments of polylines: boxes (n, 4), first and last segment (n, 2), polyline (n,)."""
    count = 0
    for line in range(len(first) - 1):
        count += (first[line + 1] - first[line] + _BOX_SEGMENTS - 2) // _BOX_SEGMENTS
    boxes, segments, lines = np.empty((count, 4)), np.empty((count, 2), np.int64), np.empty(count, np.int64)
    box = 0
    for line in range(len(first) - 1):
        for start in range(first[line], first[line + 1] - 1, _BOX_SEGMENTS):
            end = min(start + _BOX_SEGMENTS, first[line + 1] - 1)
            boxes[box, :2], boxes[box, 2:] = np.inf, -np.inf
            for k in range(start, end + 1):
                for axis in range(2):
                    boxes[box, axis] = min(boxes[box, axis], points[k, axis] - margin)
                    boxes[box, 2 + axis] = max(boxes[box, 2 + axis], points[k, axis] + margin)
            segments[box, 0], segments[box, 1], lines[box] = start, end, line
            box += 1
    return boxes, segments, lines


@kernel
def find_near_intervals(points: Any, first: Any, others: Any, other_first: Any, width: float) -> Any:
    """Find the intervals of polylines that are nearer than `width` to segments of other polylines.

    Args:
        points: vertices of all polylines, one after the other; shape (n, 2).
        first: index of the first vertex of each, and n; shape (L + 1,).
        others: vertices of the other polylines.
        other_first: the index of their first vertices.
        width: maximum distance.

    Returns:
        Index of the polyline, index of the other one, and arc lengths of start and end; shape (k, 4).
    """
    boxes, segments, lines = _bound_segments(points, first, width)
    other_boxes, other_segments, other_lines = _bound_segments(others, other_first, 0.0)
    arcs = np.zeros(len(points))  # of each vertex along its polyline
    for line in range(len(first) - 1):
        for k in range(first[line] + 1, first[line + 1]):
            arcs[k] = arcs[k - 1] + math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
    intervals, count = np.empty((64, 4)), 0
    for box in range(len(boxes)):
        x_min, y_min, x_max, y_max = boxes[box]
        for other in range(len(other_boxes)):
            if other_boxes[other, 0] > x_max or other_boxes[other, 2] < x_min:
                continue
            if other_boxes[other, 1] > y_max or other_boxes[other, 3] < y_min:
                continue
            for i in range(segments[box, 0], segments[box, 1]):
                x, y, length = points[i, 0], points[i, 1], arcs[i + 1] - arcs[i]
                dx, dy = points[i + 1, 0] - x, points[i + 1, 1] - y
                if length == 0:
                    continue
                for j in range(other_segments[other, 0], other_segments[other, 1]):
                    ox, oy = others[j, 0] - x, others[j, 1] - y
                    ex, ey = others[j + 1, 0] - others[j, 0], others[j + 1, 1] - others[j, 1]
                    if min(ox, ox + ex) > max(0.0, dx) + width or max(ox, ox + ex) < min(0.0, dx) - width:
                        continue
                    if min(oy, oy + ey) > max(0.0, dy) + width or max(oy, oy + ey) < min(0.0, dy) - width:
                        continue
                    since, until = _clip_to_capsule(-ox, -oy, dx, dy, ex, ey, width)
                    if since >= until:
                        continue
                    if count == len(intervals):
                        intervals = np.concatenate((intervals, np.empty_like(intervals)))
                    intervals[count, 0], intervals[count, 1] = lines[box], other_lines[other]
                    intervals[count, 2], intervals[count, 3] = arcs[i] + since * length, arcs[i] + until * length
                    count += 1
    return intervals[:count]


_DEPTH = 60  # maximum halvings of (0, 1) by which a root is isolated
_MAX_DEGREE = 6  # of the polynomials whose roots are found
SCRATCH = (_DEPTH + 2, _MAX_DEGREE + 3)
"""Shape of the work array of `find_unit_roots`."""


@kernel
def shell_sort(values: Any, count: Any) -> None:
    """Sort values[:count] in place (Shell 1959), since NumPy's sort takes a second to compile."""
    gap = count
    while gap > 1:
        gap = max(gap * 5 // 11, 1)
        for i in range(gap, count):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value


@kernel
def refine_root(p: Any, degree: int, low: float, high: float, rising: bool) -> float:
    """Find the only sign change of p in (low, high) by Newton's method, safeguarded by bisection."""
    u = 0.5 * (low + high)
    for _ in range(100):
        value, slope = p[degree], 0.0
        for i in range(degree - 1, -1, -1):
            slope = slope * u + value
            value = value * u + p[i]
        if value == 0:
            return u
        if (value > 0) == rising:
            high = u
        else:
            low = u
        after = u - value / slope if slope != 0 else low
        if not low < after < high:
            after = 0.5 * (low + high)
        if abs(after - u) <= 1e-16 or not low < after < high:
            return after
        u = after
    return u


@kernel
def find_unit_roots(p: Any, degree: Any, tolerance: float, out: Any, count: Any, work: Any) -> int:
    """Append the sign changes of sum p[i] u^i on (0, 1), ascending, to out[count:]; return the new count.

    Bernstein subdivision: by Descartes' rule, coefficients without a change of sign exclude a root, and one change
    isolates one; otherwise the interval is halved by de Casteljau's algorithm. A polynomial whose coefficients are all
    within `tolerance` of 0 is assumed not to change its sign. The degree, at most `_MAX_DEGREE`, is an int64, since
    literals are types of their own to compile for. `work` is a stack of [coefficients ..., low, high] of the shape
    SCRATCH.
    """
    lo, hi = _MAX_DEGREE + 1, _MAX_DEGREE + 2
    for j in range(degree + 1):  # power to Bernstein form: b_j = sum_i C(j, i) / C(n, i) p_i
        ratio, total = 1.0, 0.0
        for i in range(j + 1):
            total += ratio * p[i]
            ratio *= (j - i) / (degree - i) if degree > i else 0.0
        work[0, j] = total
    work[0, lo], work[0, hi] = 0.0, 1.0
    top = 0
    while top >= 0:
        b = work[top]
        # a zero counts as positive, so that a root at the border of two halves is found in exactly one of them
        changes, largest = 0, abs(b[0])
        for j in range(1, degree + 1):
            largest = max(largest, abs(b[j]))
            if (b[j] < 0) != (b[j - 1] < 0):
                changes += 1
        if changes == 0 or largest <= tolerance:
            top -= 1
        elif changes == 1:
            out[count] = refine_root(p, degree, b[lo], b[hi], b[0] < 0)
            count += 1
            top -= 1
        elif top >= _DEPTH:
            top -= 1
        else:  # de Casteljau at the middle, with the lower half on top of the stack, so that roots are ascending
            lower = work[top + 1]
            for j in range(degree + 1):
                lower[j] = b[0]
                for i in range(degree - j):
                    b[i] = 0.5 * (b[i] + b[i + 1])
            # b now has the coefficients of the upper half
            middle = 0.5 * (b[lo] + b[hi])
            lower[lo], lower[hi] = b[lo], middle
            b[lo] = middle
            top += 1
    return count


@kernel
def sum_overlaps(
    samples: Any, slope: Any, arc: Any, pairs: Any, middles: Any, half: float, width: float, gradient: Any
) -> float:
    """Sum the overlap, 1 - distance / width if positive, of points of fibres with tracks of the other family.

    Args:
        samples: samples of the fibres along and across their axis; shape (F, P, 2).
        slope: slopes at the samples; shape (F, P).
        arc: arc lengths of the samples; shape (F, P).
        pairs: fibre of each of K stretches, and the near fibre of the other family; each of shape (K,).
        middles: arc lengths of the middles of the stretches; shape (K,).
        half: distance along the fibre of the two points of a stretch from its middle.
        width: distance to the tangent of the other fibre at which the overlap is 0.
        gradient: receives the gradient by `samples`, for points at fixed arc lengths; shape (F, P, 2).
    """
    (fibres, neighbours), n_samples, total = pairs, samples.shape[1], 0.0
    for k in range(len(fibres)):
        f, g = fibres[k], neighbours[k]
        for side in (-half, half):
            # 1. position of the point, between two samples of its fibre, in the axes of the other fibre
            after = piece_of(middles[k] + side, arc[f], n_samples - 1) + 1
            share = (middles[k] + side - arc[f, after - 1]) / (arc[f, after] - arc[f, after - 1])
            dx, dy = samples[f, after, 1] - samples[f, after - 1, 1], samples[f, after, 0] - samples[f, after - 1, 0]
            x, y = samples[f, after - 1, 1] + share * dx, samples[f, after - 1, 0] + share * dy
            # 2. its distance to the tangent at the nearest sample of the other fibre
            nearest, min_square = 0, np.inf
            for i in range(n_samples):
                square = (samples[g, i, 0] - x) ** 2 + (samples[g, i, 1] - y) ** 2
                if square < min_square:
                    nearest, min_square = i, square
            norm_slope = math.hypot(1.0, slope[g, nearest])
            nx, ny = -slope[g, nearest] / norm_slope, 1.0 / norm_slope
            distance = (x - samples[g, nearest, 0]) * nx + (y - samples[g, nearest, 1]) * ny
            overlap = 1.0 - abs(distance) / width
            if overlap <= 0:
                continue
            total += overlap
            grad_distance = -math.copysign(1.0, distance) / width
            # the tangent also turns with the sample on the other side of the foot point
            beyond = (x - samples[g, nearest, 0]) * ny - (y - samples[g, nearest, 1]) * nx
            behind = min(max(nearest + (1 if beyond > 0 else -1), 0), n_samples - 1)
            step = abs(arc[g, behind] - arc[g, nearest])
            foot = min(abs(beyond) / step, 1.0) if step > 0 else 0.0
            for i, weight in ((nearest, 1.0 - foot), (behind, foot)):
                gradient[g, i, 0] -= weight * grad_distance * nx
                gradient[g, i, 1] -= weight * grad_distance * ny
            # 3. gradient of the fibre of the point, without its part along the fibre, since arc lengths are fixed
            norm = math.hypot(dx, dy)
            along = (nx * dx + ny * dy) / norm
            px, py = grad_distance * (nx - along * dx / norm), grad_distance * (ny - along * dy / norm)
            for i, weight in ((after - 1, 1.0 - share), (after, share)):
                gradient[f, i, 1] += weight * px
                gradient[f, i, 0] += weight * py
    return total
