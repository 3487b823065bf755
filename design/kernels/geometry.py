"""How near places of fibres come to a fibre of the other family, with the gradient by the samples of both."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from padforge.design.kernels.pchip import piece_of
from padforge.design.settings import profile_spline

Array = NDArray[np.float64]

EPS = 2.0**-52
UNIFORM, INVERSE_SQUARE, INVERSE, PROFILE = 0, 1, 2, 3
MANHATTAN, EUCLIDEAN = 0, 1
NO_PROFILE = np.empty((0, 5))


class Ends(NamedTuple):
    """Where fibres end: horizontal i (from 0) at the height (i + 1) apart_y, vertical i at (i + 1) apart_x.

    Attributes:
        horizontals, verticals: how many there are of each family. apart_y, apart_x: grid units.
    """

    horizontals: int
    verticals: int
    apart_y: float
    apart_x: float


class WeightLaw(NamedTuple):
    """What a fibre element in a press counts.

    Attributes:
        radius: of the shape, or where a profile ends. weight, length: UNIFORM, ...; MANHATTAN, ...
        profile: (B, 5), each row a squared distance and the powers of a cubic in what lies beyond it, up to the next
            row's; NO_PROFILE for a weight with a formula.
    """

    radius: float
    weight: int
    length: int
    profile: Array = NO_PROFILE


@njit(cache=True, error_model="numpy")
def weigh(square: float, law: Any) -> float:
    """Weight of a fibre element at squared distance `square` from the press centre, by a `WeightLaw`."""
    radius, weight, profile = law.radius, law.weight, law.profile
    if weight == UNIFORM:
        return 1.0
    if weight == INVERSE_SQUARE:
        return 1 / (radius + square)
    if weight == INVERSE:
        return 1 / max(math.sqrt(square), radius / 100)
    piece = profile[piece_of(square, profile[:, 0], len(profile))]
    x = square - piece[0]
    return piece[1] + x * (piece[2] + x * (piece[3] + x * piece[4]))


@lru_cache(maxsize=64)
def profile_coefficients(reach: tuple[tuple[float, float], ...]) -> Array:
    """The profile (B, 5) of `weigh` through points (distance, weight), the last of weight 0: their `profile_spline`."""
    spline = profile_spline(reach)
    return np.ascontiguousarray(np.column_stack([spline.x[:-1], spline.c[::-1].T]))  # one order: compiled once


def profile_weights(profile: Array, end: float, distance: Array) -> Array:
    """What a profile, as `profile_coefficients` gives it, weighs at distances of any shape; 0 from `end` on."""
    square = distance**2
    piece = np.searchsorted(profile[:, 0], square, side="right") - 1
    x, c0, c1, c2, c3 = profile[piece].T
    above = square - x.T
    return np.where(distance < end, c0.T + above * (c1.T + above * (c2.T + above * c3.T)), 0.0)


@lru_cache(maxsize=64)
def frames(radius: float, sides: int | None) -> tuple[tuple[Array, Array], Array]:
    """The press's shape in the frame of each family: chains (3, B) of breakpoints t, upper v, lower v; extents (2, 5).

    A circle has no breakpoints. At t a polygon reaches up to the lowest of its upper edges' lines and down to the
    highest of its lower ones.
    """
    if sides is None:
        empty = np.empty((3, 0))
        return (empty, empty), radius * np.tile([-1.0, 1.0, -1.0, 1.0, 1.0], (2, 1))
    corner = 2 * np.pi * np.arange(sides) / sides
    normal = corner + np.pi / sides
    apothem = np.cos(np.pi / sides)
    chains, reach = [], []
    for to_frame in ((np.cos, np.sin), (np.sin, np.cos)):
        t = np.sort(to_frame[0](corner))
        t = t[np.append(True, np.diff(t) > 1e-12)]
        along, across = to_frame[0](normal), to_frame[1](normal)
        edge = (apothem - np.outer(t, along)) / np.where(np.abs(across) < 1e-12, 1, across)
        upper = np.where(across > 1e-12, edge, np.inf).min(axis=1)
        lower = np.where(across < -1e-12, edge, -np.inf).max(axis=1)
        chains.append(radius * np.stack([t, upper, lower]))
        reach.append([t[0], t[-1], lower.min(), upper.max(), apothem])
    return (chains[0], chains[1]), radius * np.array(reach)


@njit(cache=True, error_model="numpy")
def in_frame(shape: Any, family: int) -> Any:
    """A shape (chains and extents in both frames, law) in the frame of one family."""
    chains, reach, law = shape
    return (chains[0] if family == 0 else chains[1]), reach[family], law


@njit(cache=True, error_model="numpy", nogil=True)
def max_offsets(cross: Any, ends: Any) -> Any:
    """(P, 2) how far the fibres of each family stray from their own level, from knots' cross (P, F, n)."""
    population, fibres, _ = cross.shape
    out = np.zeros((population, 2))
    for p in range(population):
        for f in range(fibres):
            family, first, _, apart = family_of(f, ends)
            level = (f - first + 1) * apart
            for at in cross[p, f]:
                out[p, family] = max(out[p, family], abs(at - level))
    return out


@njit(cache=True, error_model="numpy")
def family_of(fibre: int, ends: Any) -> tuple[int, int, int, float]:
    """Family of a fibre, 0 or 1, its first fibre and the one behind its last, and how far apart their ends are."""
    if fibre < ends.horizontals:
        return 0, 0, ends.horizontals, ends.apart_y
    return 1, ends.horizontals, ends.horizontals + ends.verticals, ends.apart_x


@njit(cache=True, error_model="numpy")
def touched_range(cv: float, reach: Any, stray: float, ends: Any, family: int) -> tuple[int, int]:
    """Fibres [first, end) of a family that a press at cross coordinate cv can touch, by index among all fibres.

    Fibre i of the family (from 0) keeps to level (i + 1) apart within the family's stray.
    """
    before = 0 if family == 0 else ends.horizontals
    count, apart = (ends.horizontals, ends.apart_y) if family == 0 else (ends.verticals, ends.apart_x)
    slack = 8 * EPS * (abs(cv) + reach[3])  # a fibre on the boundary is touched, whichever way rounding goes
    first = min(max(math.ceil((cv + reach[2] - stray - slack) / apart) - 1, 0.0), float(count))
    end = min(max(math.floor((cv + reach[3] + stray + slack) / apart), 0.0), float(count))
    return before + int(first), before + int(end)


@njit(cache=True, error_model="numpy")
def count_touched(strays: Any, presses: Any, reach: Any, ends: Any) -> Any:
    """(Q + 1,) running number of fibres that presses (Q, 2) can touch on one pad with strays (2,)."""
    starts = np.zeros(len(presses) + 1, np.int64)
    for q in range(len(presses)):
        starts[q + 1] = starts[q]
        for family in range(2):
            first, end = touched_range(presses[q, 1 - family], reach[family], strays[family], ends, family)
            starts[q + 1] += max(end - first, 0)
    return starts


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


DEPTH = 60
MAX_DEGREE = 6
SCRATCH = (DEPTH + 2, MAX_DEGREE + 3)
"""Shape of the work array of `roots_in_unit`."""


@njit(cache=True, error_model="numpy")
def sort(values: Any, count: Any) -> None:
    """Sort values[:count] in place, by Shell's method: numpy's sort takes a second to compile."""
    gap = count
    while gap > 1:
        gap = max(gap * 5 // 11, 1)
        for i in range(gap, count):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value


@njit(cache=True, error_model="numpy")
def _bracketed(p: Any, degree: int, low: float, high: float, rising: bool) -> float:
    """The one sign change of p in (low, high): Newton's method, bisected where it would leave the bracket."""
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


@njit(cache=True, error_model="numpy")
def roots_in_unit(p: Any, degree: Any, tolerance: float, out: Any, count: Any, work: Any) -> int:
    """Append the sign changes of sum p[i] u^i on (0, 1), ascending, to out[count:]; return the new count.

    Bernstein coefficients with no change of sign exclude a root, with one change hold exactly one; else the interval
    is halved. Where all coefficients are within `tolerance` of 0 the polynomial only touches zero: no sign change.

    Args:
        p: (degree + 1,) power coefficients, degree <= MAX_DEGREE; no literal, for each of which it would be compiled.
        work: (SCRATCH) floats, overwritten: a stack of [coefficients ..., low, high].
    """
    lo, hi = MAX_DEGREE + 1, MAX_DEGREE + 2
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
        # a zero counts as positive, so that a root at the border of two halves shows in one of them
        changes, largest = 0, abs(b[0])
        for j in range(1, degree + 1):
            largest = max(largest, abs(b[j]))
            if (b[j] < 0) != (b[j - 1] < 0):
                changes += 1
        if changes == 0 or largest <= tolerance:
            top -= 1
        elif changes == 1:
            out[count] = _bracketed(p, degree, b[lo], b[hi], b[0] < 0)
            count += 1
            top -= 1
        elif top >= DEPTH:
            top -= 1
        else:  # de Casteljau at the middle; the left half goes on top of the stack, so roots come in order
            left = work[top + 1]
            for j in range(degree + 1):
                left[j] = b[0]
                for i in range(degree - j):
                    b[i] = 0.5 * (b[i] + b[i + 1])
            # after the sweep b holds the last diagonal reversed: the right half
            middle = 0.5 * (b[lo] + b[hi])
            left[lo], left[hi] = b[lo], middle
            b[lo] = middle
            top += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def sum_overlaps(
    place: Any, slope: Any, arc: Any, fibres: Any, beside: Any, middles: Any, half: float, width: float, gradient: Any
) -> float:
    """Return by how much places `half` before and behind middles are nearer than `width`, summed, as shares of it.

    Args:
        place: (F, P, 2) samples of fibres along their travel and cross axes.
        slope: (F, P) slopes there.
        arc: (F, P) lengths of the fibres up to there.
        fibres: (K,) index of the fibre that each middle is on.
        beside: (K,) index of the fibre, of the other family, that it lies by.
        middles: (K,) arcs of the middles.
        half: arc from a middle to either place.
        width: distance from which a place costs nothing.
        gradient: (F, P, 2) that of the sum by `place` is added to it, for places that keep their arcs.
    """
    total, samples = 0.0, place.shape[1]
    for k in range(len(fibres)):
        f, g = fibres[k], beside[k]
        for side in (-half, half):
            # 1. the place, between two samples of its fibre, in the axes of the other fibre
            after = min(max(np.searchsorted(arc[f], middles[k] + side), 1), samples - 1)
            share = (middles[k] + side - arc[f, after - 1]) / (arc[f, after] - arc[f, after - 1])
            dx, dy = place[f, after, 1] - place[f, after - 1, 1], place[f, after, 0] - place[f, after - 1, 0]
            x, y = place[f, after - 1, 1] + share * dx, place[f, after - 1, 0] + share * dy
            # 2. its distance to the tangent in the sample that is next to it
            nearest, least = 0, np.inf
            for i in range(samples):
                square = (place[g, i, 0] - x) ** 2 + (place[g, i, 1] - y) ** 2
                if square < least:
                    nearest, least = i, square
            run = math.hypot(1.0, slope[g, nearest])
            nx, ny = -slope[g, nearest] / run, 1.0 / run
            away = (x - place[g, nearest, 0]) * nx + (y - place[g, nearest, 1]) * ny
            close = 1.0 - abs(away) / width
            if close <= 0:
                continue
            total += close
            push = -math.copysign(1.0, away) / width
            # the fibre beside it turns there with the sample on the other side of its foot
            beyond = (x - place[g, nearest, 0]) * ny - (y - place[g, nearest, 1]) * nx
            behind = min(max(nearest + (1 if beyond > 0 else -1), 0), samples - 1)
            step = abs(arc[g, behind] - arc[g, nearest])
            foot = min(abs(beyond) / step, 1.0) if step > 0 else 0.0
            for i, part in ((nearest, 1.0 - foot), (behind, foot)):
                gradient[g, i, 0] -= part * push * nx
                gradient[g, i, 1] -= part * push * ny
            # 3. a place keeps its arc: what moves it along its own fibre does not count
            length = math.hypot(dx, dy)
            along = (nx * dx + ny * dy) / length
            px, py = push * (nx - along * dx / length), push * (ny - along * dy / length)
            for i, part in ((after - 1, 1.0 - share), (after, share)):
                gradient[f, i, 1] += part * px
                gradient[f, i, 0] += part * py
    return total
