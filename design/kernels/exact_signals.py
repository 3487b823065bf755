"""Exact signals of a shape: line integrals along PCHIP spans inside the press, without sampling.

A fibre runs along t and deviates from its axis by v; both are relative to the press centre. A span is the cubic
t = r + h s, v = e0 + e1 s + e2 s^2 + e3 s^3. The parameter s is zero at the point of the span nearest to the centre
along t, so that the signals of small presses have a small relative error.

A polygon is bounded by two chains over t, upper and lower, linear between common breakpoints; a circle has no
breakpoints. PCHIP spans are monotone, so most pieces are accepted or rejected by comparing their ends; roots are
computed only if the fibre may intersect a chain.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.design.kernels.geometry import (
    EPS,
    INVERSE,
    MANHATTAN,
    SCRATCH,
    UNIFORM,
    find_touched_range,
    find_unit_roots,
    select_frame,
    shell_sort,
    weigh,
)
from padforge.design.kernels.pchip import piece_of

# G7-K15 rule on [-1, 1]: nodes and Kronrod weights from 1 to 0, and Gauss weights of every second of these nodes
NODES, KRONROD = np.ascontiguousarray(
    np.array(
        [
            (0.991455371120812639206854697526329, 0.022935322010529224963732008058970),
            (0.949107912342758524526189684047851, 0.063092092629978553290700663189204),
            (0.864864423359769072789712788640926, 0.104790010322250183839876322541518),
            (0.741531185599394439863864773280788, 0.140653259715525918745189590510238),
            (0.586087235467691130294144691693013, 0.169004726639267902826583426598550),
            (0.405845151377397166906606412076961, 0.190350578064785409913256402421014),
            (0.207784955007898467600689403773245, 0.204432940075298892414161999234649),
            (0.0, 0.209482141084727828012999174891714),
        ]
    ).T
)
GAUSS = np.array(
    [
        0.129484966168869693270611432679082,
        0.279705391489276667901467771423780,
        0.381830050505118944950369775488975,
        0.417959183673469387755102040816327,
    ]
)
MAX_HALVINGS = 48  # maximum depth of the halved intervals of a quadrature
PRECISION = 1e-11  # maximum relative error of a piece without a closed form


@kernel
def evaluate_cubic(span: Any, s: float) -> float:
    """Return v at s."""
    return span[2] + s * (span[3] + s * (span[4] + s * span[5]))


@kernel
def _rise(span: Any, s: float) -> float:
    """Return dv/ds."""
    return span[3] + s * (2 * span[4] + 3 * s * span[5])


@kernel(inline="always")  # else counting references takes most of the time
def _density(span: Any, s: float, law: Any) -> float:
    """Return the weighted length per unit of s."""
    rise = _rise(span, s)
    run = span[1] + abs(rise) if law.length == MANHATTAN else math.sqrt(span[1] ** 2 + rise**2)
    if law.weight == UNIFORM:
        return run
    t, v = span[0] + span[1] * s, evaluate_cubic(span, s)
    return run * weigh(t * t + v * v, law)


@kernel
def integrate_kronrod(span: Any, a: float, b: float, law: Any) -> tuple[float, float]:
    """Integrate over [a, b] by the 15-point Kronrod rule and estimate the relative error by the 7-point Gauss rule."""
    middle, half = 0.5 * (a + b), 0.5 * (b - a)
    fine, coarse = 0.0, 0.0
    for i in range(15):
        k = min(i, 14 - i)
        value = _density(span, middle + half * (NODES[k] if i > 7 else -NODES[k]), law)
        fine += KRONROD[k] * value
        if k % 2 == 1:
            coarse += GAUSS[k // 2] * value
    gap = abs(fine - coarse) / fine if fine > 0 else 0.0
    return fine * half, min(1.0, (200 * gap) ** 1.5)


@kernel
def is_precise(error: float, pieces: int) -> bool:
    """Return whether the relative error of the `pieces`-th integrated piece is acceptable.

    After 500 pieces the tolerance doubles with every 100 more, since halving does not reduce rounding errors. The error
    of a piece without length is NaN, which is acceptable.
    """
    return not error > PRECISION * 2.0 ** (max(pieces - 500, 0) / 100)


@kernel
def _has_turn(span: Any, a: float, b: float, law: Any) -> bool:
    """Return whether a fibre turns from its axis to a steep rise within [a, b] so sharply that quadrature may miss it.

    The turn is where the rise dv/ds is about as large as the run dt/ds. It takes a fraction of about run / max_rise of
    [a, b]; nodes that miss it misjudge the length per s there by about the run. Quadrature converges fast if max_rise
    is at most 8 times the smallest rise or the run.
    """
    if law.length == MANHATTAN:
        return False
    first, last = abs(_rise(span, a)), abs(_rise(span, b))
    min_rise, max_rise = min(first, last), max(first, last)
    vertex = -span[4] / (3 * span[5]) if span[5] != 0 else a  # of the rise, which does not change its sign
    if a < vertex < b:
        min_rise, max_rise = min(min_rise, abs(_rise(span, vertex))), max(max_rise, abs(_rise(span, vertex)))
    return max_rise > 8.0 * max(min_rise, span[1]) and span[1] ** 2 * (b - a) > PRECISION * max_rise


@kernel
def _manhattan_length(span: Any, a: float, b: float) -> float:
    """Return the Manhattan length of [a, b], in closed form as spans are monotone."""
    mean_rise = span[3] + span[4] * (a + b) + span[5] * (a * a + a * b + b * b)
    return (b - a) * (span[1] + abs(mean_rise))


@kernel
def _integrate_stretch(span: Any, a: float, b: float, law: Any, stack: Any) -> float:
    """Integrate the density over [a, b] by adaptive Gauss-Kronrod on a stack of intervals."""
    total, pieces = 0.0, 0
    stack[0, 0], stack[0, 1] = a, b
    top = 0
    while top >= 0:
        low, high = stack[top]
        if top >= MAX_HALVINGS or not _has_turn(span, low, high, law):
            part, error = integrate_kronrod(span, low, high, law)
            pieces += 1
            if top >= MAX_HALVINGS or is_precise(error, pieces):
                total += part
                top -= 1
                continue
        middle = 0.5 * (low + high)
        stack[top, 1] = middle
        top += 1
        stack[top, 0], stack[top, 1] = middle, high
    return total


_PROBES = (0.5, 0.22, 0.78)  # positions between two roots at which a sign is determined
_SIGN_CERTAIN_FACTOR = 1e6  # the sign of a value is certain if it is this many tolerances


@kernel
def _expand_square(span: Any, a: float, b: float, radius: float, p: Any) -> None:
    """Expand t^2 + v^2 - radius^2 in powers of u, with s = a + (b - a) u, into the coefficients p (7,)."""
    w = b - a
    t0, t1 = span[0] + span[1] * a, span[1] * w
    v0, v3 = evaluate_cubic(span, a), span[5] * w**3
    v1, v2 = (span[3] + a * (2 * span[4] + 3 * a * span[5])) * w, (span[4] + 3 * a * span[5]) * w * w
    p[0] = (t0 - radius) * (t0 + radius) + v0 * v0
    p[1] = 2 * (t0 * t1 + v0 * v1)
    p[2] = t1 * t1 + v1 * v1 + 2 * v0 * v2
    p[3] = 2 * (v0 * v3 + v1 * v2)
    p[4] = v2 * v2 + 2 * v1 * v3
    p[5] = 2 * v2 * v3
    p[6] = v3 * v3


@kernel
def find_circle_roots(span: Any, a: float, b: float, radius: float, out: Any, count: Any, work: Any, p: Any) -> int:
    """Append to out[count:] the s in (a, b) at which the span crosses the circle of `radius`; return the count."""
    w = b - a
    _expand_square(span, a, b, radius, p)
    end = find_unit_roots(p, np.int64(6), 16 * EPS * radius * radius, out, count, work)
    for i in range(count, end):
        out[i] = a + w * out[i]
    return end


@kernel
def _find_line_roots(
    span: Any, a: float, b: float, at_a: float, at_b: float, tolerance: float, out: Any, count: Any, work: Any, p: Any
) -> int:
    """Append to out[count:] the s at which the span crosses the line from `at_a` at s = a to `at_b` at s = b."""
    w = b - a
    p[0] = evaluate_cubic(span, a) - at_a
    p[1] = (span[3] + a * (2 * span[4] + 3 * a * span[5])) * w - (at_b - at_a)
    p[2] = (span[4] + 3 * a * span[5]) * w * w
    p[3] = span[5] * w**3
    end = find_unit_roots(p, np.int64(3), tolerance, out, count, work)
    for i in range(count, end):
        out[i] = a + w * out[i]
    return end


@kernel
def _append_stretch(stretches: Any, count: Any, begin: float, end: float) -> int:
    """Append [begin, end] to stretches[:count], merged with the last one if they touch; return the new count."""
    if count > 0 and stretches[count - 1, 1] == begin:
        stretches[count - 1, 1] = end
        return count
    stretches[count, 0], stretches[count, 1] = begin, end
    return count + 1


@kernel
def _find_inside_circle(
    span: Any, a: float, b: float, radius: float, tolerance: float, scratch: Any, stretches: Any
) -> Any:
    """Find the stretches inside a circle, as `find_stretches_inside`."""
    roots, work, p, _ = scratch
    count = find_circle_roots(span, a, b, radius, roots, np.int64(0), work, p)
    count_inside, begin = np.int64(0), a
    for i in range(count + 1):
        end = b if i == count else roots[i]
        # the sign does not change between roots, but the span may touch the circle: take the largest of three values
        largest = 0.0
        for share in _PROBES:
            s = begin + share * (end - begin)
            t, v = span[0] + span[1] * s, evaluate_cubic(span, s)
            depth = radius * radius - t * t - v * v
            if abs(depth) > abs(largest):
                largest = depth
            if abs(largest) > _SIGN_CERTAIN_FACTOR * radius * tolerance:
                break
        if largest >= -2 * radius * tolerance:
            count_inside = _append_stretch(stretches, count_inside, begin, end)
        begin = end
    return count_inside


@kernel
def _find_between_lines(
    span: Any,
    start: float,
    after: float,
    lines: Any,
    may_cross: Any,
    tolerance: float,
    scratch: Any,
    stretches: Any,
    count_inside: Any,
) -> Any:
    """Append the stretches of [start, after] on which the span, which `may_cross` either line, is between both."""
    roots, work, p, _ = scratch
    (upper_start, upper_end, lower_start, lower_end), count = lines, np.int64(0)
    if may_cross[0]:
        count = _find_line_roots(span, start, after, upper_start, upper_end, tolerance, roots, count, work, p)
    if may_cross[1]:
        count = _find_line_roots(span, start, after, lower_start, lower_end, tolerance, roots, count, work, p)
    shell_sort(roots, count)
    begin = start
    for i in range(count + 1):
        end = after if i == count else roots[i]
        above, below = 0.0, 0.0
        for share in _PROBES:
            s = begin + share * (end - begin)
            x, v = (s - start) / (after - start), evaluate_cubic(span, s)
            to_upper = upper_start + (upper_end - upper_start) * x - v
            to_lower = v - lower_start - (lower_end - lower_start) * x
            above = to_upper if abs(to_upper) > abs(above) else above
            below = to_lower if abs(to_lower) > abs(below) else below
            if min(abs(above), abs(below)) > _SIGN_CERTAIN_FACTOR * tolerance:
                break
        if above >= -tolerance and below >= -tolerance:
            count_inside = _append_stretch(stretches, count_inside, begin, end)
        begin = end
    return count_inside


@kernel
def find_one_crossing(
    span: Any, a: float, b: float, from_a: float, from_b: float, rise: float, tolerance: float
) -> float:
    """Return the fraction of [a, b] at which a span crosses a line once: 0 if it never does, NaN if that is not clear.

    Args:
        span: coefficients of the span; shape (6,).
        a: start of the interval of s.
        b: end of it.
        from_a: height of the span above the line at a.
        from_b: height of the span above the line at b.
        rise: rise of the line from a to b.
        tolerance: height that counts as 0.
    """
    w = b - a
    p1, p2, p3 = _rise(span, a) * w - rise, (span[4] + 3 * a * span[5]) * w * w, span[5] * w**3
    # the inner Bernstein coefficients, whose signs bound the number of crossings (Descartes' rule)
    first, second = from_a + p1 / 3, from_b - (p1 + 2 * p2 + 3 * p3) / 3
    if not min(abs(from_a), abs(from_b)) > tolerance:
        return math.nan
    if (from_a > 0) == (from_b > 0):
        return 0.0 if (first > 0) == (second > 0) == (from_a > 0) else math.nan
    if (first > 0) == (from_b > 0) and (second > 0) == (from_a > 0):
        return math.nan
    low, high, u = 0.0, 1.0, from_a / (from_a - from_b)
    for _ in range(100):
        value, slope = from_a + u * (p1 + u * (p2 + u * p3)), p1 + u * (2 * p2 + 3 * u * p3)
        if value == 0:
            break
        if (value > 0) == (from_b > 0):
            high = u
        else:
            low = u
        step = value / slope if slope != 0 else math.inf
        if (abs(p2) + 3 * abs(p3)) * step * step <= EPS / 4 * abs(slope):  # a bound of the error after the step
            u = min(max(u - step, 0.0), 1.0)
            break
        u -= step
        if not low < u < high:
            u = 0.5 * (low + high)
            if not low < u < high:
                break
    return u


@kernel
def _find_beside_line(
    span: Any, a: float, b: float, from_a: float, from_b: float, rise: float, is_upper: bool, tolerance: float
) -> tuple[float, float]:
    """Return the stretch of [a, b] below an upper line, or above a lower one; NaN unless `find_one_crossing` is clear.

    If there is none, the stretch begins at b.
    """
    share = find_one_crossing(span, a, b, from_a, from_b, rise, tolerance)
    if math.isnan(share):
        return math.nan, math.nan
    cut = a + share * (b - a) if share > 0 else b
    return (a, cut) if (from_a < 0) == is_upper else (cut, b)


@kernel(inline="always")  # as `_density`
def find_stretches_inside(
    span: Any, a: float, b: float, chains: Any, extents: Any, radius: float, tolerance: float, scratch: Any, out: Any
) -> Any:
    """Find the stretches of [a, b] inside a press, and return their number.

    Arrays are separate arguments, since taking one out of a tuple costs as much as all other steps.

    Args:
        span: coefficients r, h, e0, e1, e2, e3 of the span; shape (6,).
        a: start of the interval of s.
        b: end of it.
        chains: breakpoints t, and v of the upper and of the lower chain there; shape (3, B), B = 0 for a circle.
        extents: box of the press and radius of its inscribed circle, as `frame_shape` returns; shape (5,).
        radius: radius of the press.
        tolerance: distance outside up to which a point counts as on the boundary.
        scratch: work arrays of `make_scratch`.
        out: receives begin and end of each stretch.
    """
    r, h, inner = span[0], span[1], extents[4]
    # 1. Most spans lie wholly inside or outside, and so does the box of their ends, since spans are monotone.
    t_start, t_end, v_start, v_end = r + h * a, r + h * b, evaluate_cubic(span, a), evaluate_cubic(span, b)
    far_t, far_v = max(abs(t_start), abs(t_end)), max(abs(v_start), abs(v_end))
    if far_t * far_t + far_v * far_v < inner * inner:
        return _append_stretch(out, np.int64(0), a, b)
    near_t, near_v = max(t_start, -t_end, 0.0), max(min(v_start, v_end), -max(v_start, v_end), 0.0)
    if near_t * near_t + near_v * near_v > (radius + tolerance) * (radius + tolerance):
        return 0
    # 2. Clip [a, b] to the extent of the press along t.
    last = chains.shape[1] - 1
    a = max(a, ((-radius if last < 0 else chains[0, 0]) - r) / h)
    b = min(b, ((radius if last < 0 else chains[0, last]) - r) / h)
    if b <= a:
        return 0
    if last < 0:
        return _find_inside_circle(span, a, b, radius, tolerance, scratch, out)
    # 3. For a polygon, compare each piece [start, after] between two breakpoints with a line above and a line below.
    count, start, t_last, per_h = np.int64(0), a, r + h * b, 1 / h
    t_start, v_start, k = r + h * a, evaluate_cubic(span, a), piece_of(r + h * a, chains[0], last)
    while start < b:
        if k == last - 1 or chains[0, k + 1] >= t_last:
            after, t_end = b, t_last
        else:
            t_end = chains[0, k + 1]
            after = (t_end - r) * per_h
        if after <= start:
            k += 1
            continue
        v_end = evaluate_cubic(span, after)
        far_t, far_v = max(abs(t_start), abs(t_end)), max(abs(v_start), abs(v_end))
        if far_t * far_t + far_v * far_v < inner * inner:
            count = _append_stretch(out, count, start, after)
            start, t_start, v_start, k = after, t_end, v_end, k + 1
            continue
        width = chains[0, k + 1] - chains[0, k]
        x0 = 0.0 if t_start == chains[0, k] else (t_start - chains[0, k]) / width
        x1 = 1.0 if t_end == chains[0, k + 1] else (t_end - chains[0, k]) / width
        upper_start = chains[1, k] * (1 - x0) + chains[1, k + 1] * x0
        upper_end = chains[1, k] * (1 - x1) + chains[1, k + 1] * x1
        lower_start = chains[2, k] * (1 - x0) + chains[2, k + 1] * x0
        lower_end = chains[2, k] * (1 - x1) + chains[2, k + 1] * x1
        min_v, max_v = min(v_start, v_end), max(v_start, v_end)
        may_cross = max_v >= min(upper_start, upper_end), min_v <= max(lower_start, lower_end)
        if max_v <= min(upper_start, upper_end) and min_v >= max(lower_start, lower_end):
            count = _append_stretch(out, count, start, after)
        elif min_v <= max(upper_start, upper_end) + tolerance and max_v >= min(lower_start, lower_end) - tolerance:
            begin = end = math.nan
            if may_cross[0] != may_cross[1]:  # usually the span crosses this line once
                y0, y1 = (upper_start, upper_end) if may_cross[0] else (lower_start, lower_end)
                begin, end = _find_beside_line(
                    span, start, after, v_start - y0, v_end - y1, y1 - y0, may_cross[0], tolerance
                )
            if math.isnan(begin):
                lines = upper_start, upper_end, lower_start, lower_end
                count = _find_between_lines(span, start, after, lines, may_cross, tolerance, scratch, out, count)
            elif begin < after:
                count = _append_stretch(out, count, begin, end)
        start, t_start, v_start, k = after, t_end, v_end, k + 1
    return count


@kernel
def _compute_stretch_signal(span: Any, a: float, b: float, law: Any, scratch: Any) -> float:
    """Return the signal of a stretch inside the press, split where the weight is not smooth."""
    roots, work, p, stack = scratch
    count = np.int64(0)
    if law.weight == INVERSE:
        count = find_circle_roots(span, a, b, law.radius / 100, roots, count, work, p)
    total, begin = 0.0, a
    for i in range(count):
        total += _integrate_stretch(span, begin, roots[i], law, stack)
        begin = roots[i]
    return total + _integrate_stretch(span, begin, b, law, stack)


@kernel
def centre_cubic(
    t0: float, t1: float, v0: float, v1: float, d0: float, d1: float, ct: float, cv: float, out: Any
) -> float:
    """Expand the span between two knots about its point nearest to the press centre along t, into `out` (6,).

    Returns:
        Fraction s0 of the span before that point; s runs from -s0 to 1 - s0.
    """
    h, rise = t1 - t0, v1 - v0
    s0 = min(max((ct - t0) / h, 0.0), 1.0)
    a1, a2, a3 = h * d0, 3 * rise - h * (2 * d0 + d1), h * (d0 + d1) - 2 * rise
    out[0] = 0.0 if 0 < s0 < 1 else (t0 - ct if s0 == 0 else t1 - ct)
    out[1] = h
    out[2] = (v0 - cv) + s0 * (a1 + s0 * (a2 + s0 * a3)) if s0 < 1 else v1 - cv
    out[3] = a1 + s0 * (2 * a2 + 3 * s0 * a3)
    out[4] = a2 + 3 * s0 * a3
    out[5] = a3
    return s0


@kernel(inline="always")  # as `_density`
def _compute_fibre_signal(
    t: Any,
    v: Any,
    d: Any,
    ct: float,
    cv: float,
    chains: Any,
    extents: Any,
    law: Any,
    span: Any,
    scratch: Any,
    stretches: Any,
) -> float:
    """Return the signal of one fibre for the press at (ct, cv)."""
    n, begin, end = len(t), ct + extents[0], ct + extents[1]
    if end <= t[0] or begin >= t[n - 1]:
        return 0.0
    tolerance, is_plain = 4 * EPS * (abs(cv) + law.radius), law.weight == UNIFORM and law.length == MANHATTAN
    total, j = 0.0, piece_of(begin, t, n)
    while j < n - 1 and t[j] < end:
        if min(v[j], v[j + 1]) <= cv + extents[3] + tolerance and max(v[j], v[j + 1]) >= cv + extents[2] - tolerance:
            s0 = centre_cubic(t[j], t[j + 1], v[j], v[j + 1], d[j], d[j + 1], ct, cv, span)
            count = find_stretches_inside(span, -s0, 1 - s0, chains, extents, law.radius, tolerance, scratch, stretches)
            for i in range(count):
                if is_plain:
                    total += _manhattan_length(span, stretches[i, 0], stretches[i, 1])
                else:
                    total += _compute_stretch_signal(span, stretches[i, 0], stretches[i, 1], law, scratch)
        j += 1
    return total


@kernel
def make_scratch(breaks: int) -> Any:
    """Allocate the work arrays of a thread: stretches, and (roots, their stack, a polynomial, intervals of quadrature).

    A piece between two of the `breaks` breakpoints has at most 4 stretches, since 6 roots cut it into 7 parts.
    """
    scratch = np.empty(16), np.empty(SCRATCH), np.empty(7), np.empty((MAX_HALVINGS + 2, 2))
    return np.empty((4 * breaks + 8, 2)), scratch


@kernel
def exact_signals(
    curves: Any, max_offsets: Any, ends: Any, presses: Any, shape: Any, begin: int, end: int, out: Any
) -> None:
    """Compute signals of pads for some presses, only of the fibres that a press can touch.

    Args:
        curves: along, across and slope of the knots; each of shape (P, F, n).
        max_offsets: maximum offsets of the fibres of each family; shape (P, 2).
        ends: positions at which the fibres end.
        presses: shape (Q, 2).
        shape: chains, extents and law of the press.
        begin: first of the P Q presses.
        end: index after the last one.
        out: receives the signals; shape (P, Q, F), zeros.
    """
    chains = shape[0]
    stretches, scratch = make_scratch(max(chains[0].shape[1], chains[1].shape[1]))
    frames, span = (select_frame(shape, 0), select_frame(shape, 1)), np.empty(6)
    _compute_signals(curves, max_offsets, ends, presses, frames, begin, end, span, stretches, scratch, out)


@kernel(_nrt=False)  # else counting references takes most of the time
def _compute_signals(
    curves: Any,
    max_offsets: Any,
    ends: Any,
    presses: Any,
    frames: Any,
    begin: int,
    end: int,
    span: Any,
    stretches: Any,
    scratch: Any,
    out: Any,
) -> None:
    """Compute `exact_signals` from the shape in both frames, with work arrays, since no array may be allocated here."""
    along, across, slope = curves
    for index in range(begin, end):
        p, q = index // len(presses), index % len(presses)
        for family in range(2):
            ct, cv = presses[q, family], presses[q, 1 - family]
            chains, extents, law = frames[0] if family == 0 else frames[1]
            first, last = find_touched_range(cv, extents, max_offsets[p, family], ends, family)
            for f in range(first, last):
                t, v, d = along[p, f], across[p, f], slope[p, f]
                out[p, q, f] = _compute_fibre_signal(t, v, d, ct, cv, chains, extents, law, span, scratch, stretches)
