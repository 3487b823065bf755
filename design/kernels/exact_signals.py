"""Exact signals of a shape: line integrals along PCHIP spans inside the press, without sampling.

Frame: a fibre runs along t and deviates across it, v; both are measured from the press centre. A span is the cubic
t = r + h s, v = e0 + e1 s + e2 s^2 + e3 s^3 in a parameter s whose zero is the point of the span abreast of the
centre, so that small presses keep their relative accuracy.

A polygon is two chains over t, upper and lower, linear between shared breakpoints; a circle has none. PCHIP spans are
monotone, so most pieces are accepted or rejected by comparing ends; roots are computed only where the fibre and a chain
may intersect.
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

# G7-K15 rule on [-1, 1]: nodes and Kronrod weights of the positive half, the centre last; Gauss weights of every second
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
MAX_HALVINGS = 48
PRECISION = 1e-11
"""Relative error of a piece without a closed form."""
MAX_TURN = 8.0
"""Ratio of the steepest rise of a piece to its least one, or to its run, up to which the quadrature converges fast."""
PIECES, PATIENCE = 500, 100
"""Beyond PIECES the tolerance doubles with every PATIENCE more pieces: halving pure rounding errors would not end."""


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
    """Whether the error of a piece, the `pieces`-th that was integrated, is acceptable."""
    return not error > PRECISION * 2.0 ** (max(pieces - PIECES, 0) / PATIENCE)  # that of a piece without length is NaN


@kernel
def _has_turn(span: Any, a: float, b: float, law: Any) -> bool:
    """Whether a fibre turns from its axis to a steep rise within [a, b] so sharply that the quadrature may miss it.

    It turns where the rise is about the run, and both add up to the length there: a share of about run / steepest rise
    of [a, b], on which the length differs by about the run.
    """
    if law.length == MANHATTAN:
        return False
    first, last = abs(_rise(span, a)), abs(_rise(span, b))
    least, most = min(first, last), max(first, last)
    vertex = -span[4] / (3 * span[5]) if span[5] != 0 else a  # of the rise, which has one sign
    if a < vertex < b:
        least, most = min(least, abs(_rise(span, vertex))), max(most, abs(_rise(span, vertex)))
    return most > MAX_TURN * max(least, span[1]) and span[1] ** 2 * (b - a) > PRECISION * most


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


_PROBES = (0.5, 0.22, 0.78)
_CLEAR = 1e6  # a value this many tolerances from zero has a certain sign


@kernel
def _expand_square(span: Any, a: float, b: float, radius: float, p: Any) -> None:
    """Expand the squared distance less that of a circle in u, for s = a + (b - a) u, into the coefficients p (7,)."""
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
        # no sign changes between roots, but a touch may lie there: the largest of three values has the sign
        largest = 0.0
        for share in _PROBES:
            s = begin + share * (end - begin)
            t, v = span[0] + span[1] * s, evaluate_cubic(span, s)
            depth = radius * radius - t * t - v * v
            if abs(depth) > abs(largest):
                largest = depth
            if abs(largest) > _CLEAR * radius * tolerance:
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
    near: Any,
    tolerance: float,
    scratch: Any,
    stretches: Any,
    count_inside: Any,
) -> Any:
    """Append the stretches on which the span is between two lines of which `near` ones may cross it."""
    roots, work, p, _ = scratch
    (u0, u1, l0, l1), count = lines, np.int64(0)
    if near[0]:
        count = _find_line_roots(span, start, after, u0, u1, tolerance, roots, count, work, p)
    if near[1]:
        count = _find_line_roots(span, start, after, l0, l1, tolerance, roots, count, work, p)
    shell_sort(roots, count)
    begin = start
    for i in range(count + 1):
        end = after if i == count else roots[i]
        above, below = 0.0, 0.0
        for share in _PROBES:
            s = begin + share * (end - begin)
            x, at = (s - start) / (after - start), evaluate_cubic(span, s)
            to_upper, to_lower = u0 + (u1 - u0) * x - at, at - l0 - (l1 - l0) * x
            above = to_upper if abs(to_upper) > abs(above) else above
            below = to_lower if abs(to_lower) > abs(below) else below
            if min(abs(above), abs(below)) > _CLEAR * tolerance:
                break
        if above >= -tolerance and below >= -tolerance:
            count_inside = _append_stretch(stretches, count_inside, begin, end)
        begin = end
    return count_inside


@kernel
def find_one_crossing(
    span: Any, a: float, b: float, from_a: float, from_b: float, rise: float, tolerance: float
) -> float:
    """Return the share of [a, b] after which a span crosses a line once: 0 if it never does, NaN if that is not clear.

    The line has a `rise`; the span ends at the distances `from_a` and `from_b` from it, above it if they are positive.
    """
    w = b - a
    p1, p2, p3 = _rise(span, a) * w - rise, (span[4] + 3 * a * span[5]) * w * w, span[5] * w**3
    # between both ends in Bernstein form, which tells the number of crossings
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
        if (abs(p2) + 3 * abs(p3)) * step * step <= EPS / 4 * abs(slope):  # a bound of what the step leaves
            u = min(max(u - step, 0.0), 1.0)
            break
        u -= step
        if not low < u < high:
            u = 0.5 * (low + high)
            if not low < u < high:
                break
    return u


@kernel(inline="always")  # as `_density`
def find_stretches_inside(
    span: Any, a: float, b: float, chains: Any, extents: Any, radius: float, tolerance: float, scratch: Any, out: Any
) -> Any:
    """Find the stretches of [a, b] inside a press of a radius, into `out`; return their number.

    What is outside by up to `tolerance` counts as on the boundary. The chains of a circle have no breakpoints. What all
    spans need is given by itself: to take an array out of a tuple costs as much as the rest.
    """
    r, h, inner = span[0], span[1], extents[4]
    # a span lies in the box of its ends, since it is monotone: most boxes are wholly inside or wholly outside
    t0, t1, v, v1 = r + h * a, r + h * b, evaluate_cubic(span, a), evaluate_cubic(span, b)
    far_t, far_v = max(abs(t0), abs(t1)), max(abs(v), abs(v1))
    if far_t * far_t + far_v * far_v < inner * inner:
        return _append_stretch(out, np.int64(0), a, b)
    near_t, near_v = max(t0, -t1, 0.0), max(min(v, v1), -max(v, v1), 0.0)
    if near_t * near_t + near_v * near_v > (radius + tolerance) * (radius + tolerance):
        return 0
    last = chains.shape[1] - 1
    a = max(a, ((-radius if last < 0 else chains[0, 0]) - r) / h)
    b = min(b, ((radius if last < 0 else chains[0, last]) - r) / h)
    if b <= a:
        return 0
    if last < 0:
        return _find_inside_circle(span, a, b, radius, tolerance, scratch, out)
    count_inside, start, end, per_h = np.int64(0), a, r + h * b, 1 / h
    t0, v, k = r + h * a, evaluate_cubic(span, a), piece_of(r + h * a, chains[0], last)
    while start < b:
        if k == last - 1 or chains[0, k + 1] >= end:
            after, t1 = b, end
        else:
            t1 = chains[0, k + 1]
            after = (t1 - r) * per_h
        if after <= start:
            k += 1
            continue
        v_after = evaluate_cubic(span, after)
        far_t, far_v = max(abs(t0), abs(t1)), max(abs(v), abs(v_after))
        if far_t * far_t + far_v * far_v < inner * inner:  # as for the whole span: no chain is near
            count_inside = _append_stretch(out, count_inside, start, after)
            start, t0, v, k = after, t1, v_after, k + 1
            continue
        width = chains[0, k + 1] - chains[0, k]
        x0 = 0.0 if t0 == chains[0, k] else (t0 - chains[0, k]) / width
        x1 = 1.0 if t1 == chains[0, k + 1] else (t1 - chains[0, k]) / width
        u0, u1 = chains[1, k] * (1 - x0) + chains[1, k + 1] * x0, chains[1, k] * (1 - x1) + chains[1, k + 1] * x1
        l0, l1 = chains[2, k] * (1 - x0) + chains[2, k + 1] * x0, chains[2, k] * (1 - x1) + chains[2, k + 1] * x1
        least, most = min(v, v_after), max(v, v_after)
        if most <= min(u0, u1) and least >= max(l0, l1):
            count_inside = _append_stretch(out, count_inside, start, after)
        elif least <= max(u0, u1) + tolerance and most >= min(l0, l1) - tolerance:
            near = most >= min(u0, u1), least <= max(l0, l1)
            if near[0] != near[1]:  # mostly one line is crossed, once
                y0, y1 = (u0, u1) if near[0] else (l0, l1)
                share = find_one_crossing(span, start, after, v - y0, v_after - y1, y1 - y0, tolerance)
                if not math.isnan(share):
                    begins_inside = (v < y0) == near[0]
                    cut = start + share * (after - start) if share > 0 else after
                    if begins_inside:
                        count_inside = _append_stretch(out, count_inside, start, cut)
                    elif cut < after:
                        count_inside = _append_stretch(out, count_inside, cut, after)
                    start, t0, v, k = after, t1, v_after, k + 1
                    continue
            count_inside = _find_between_lines(
                span, start, after, (u0, u1, l0, l1), near, tolerance, scratch, out, count_inside
            )
        start, t0, v, k = after, t1, v_after, k + 1
    return count_inside


@kernel
def _compute_stretch_signal(span: Any, a: float, b: float, law: Any, scratch: Any) -> float:
    """Return the signal of a stretch inside the press, split where the weight bends."""
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
    """Expand the span between two knots about its point abreast of the press centre, into `out` (6,).

    Returns:
        Share s0 of the span before that point; s runs from -s0 to 1 - s0.
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
) -> tuple[float, int]:
    """Return the signal of one fibre for the press at (ct, cv), and the number of spans visited."""
    n, begin, end = len(t), ct + extents[0], ct + extents[1]
    if end <= t[0] or begin >= t[n - 1]:
        return 0.0, 0
    tolerance, is_plain = 4 * EPS * (abs(cv) + law.radius), law.weight == UNIFORM and law.length == MANHATTAN
    total, visited, j = 0.0, 0, piece_of(begin, t, n)
    while j < n - 1 and t[j] < end:
        if min(v[j], v[j + 1]) <= cv + extents[3] + tolerance and max(v[j], v[j + 1]) >= cv + extents[2] - tolerance:
            s0 = centre_cubic(t[j], t[j + 1], v[j], v[j + 1], d[j], d[j + 1], ct, cv, span)
            count = find_stretches_inside(span, -s0, 1 - s0, chains, extents, law.radius, tolerance, scratch, stretches)
            for i in range(count):
                if is_plain:
                    total += _manhattan_length(span, stretches[i, 0], stretches[i, 1])
                else:
                    total += _compute_stretch_signal(span, stretches[i, 0], stretches[i, 1], law, scratch)
            visited += 1
        j += 1
    return total, visited


@kernel
def make_scratch(breaks: int) -> Any:
    """Allocate one thread's work arrays, for stretches inside, and for roots, their stack, a polynomial, a quadrature.

    Each piece between `breaks` breakpoints holds at most 4 stretches: 6 roots cut it into 7 parts.
    """
    scratch = np.empty(16), np.empty(SCRATCH), np.empty(7), np.empty((MAX_HALVINGS + 2, 2))
    return np.empty((4 * breaks + 8, 2)), scratch


@kernel
def exact_signals(
    curves: Any, max_offsets: Any, ends: Any, presses: Any, shape: Any, begin: int, end: int, sparse: Any, signal: Any
) -> int:
    """Compute signals of pads, only for fibres that a press can touch, for presses `begin` to `end` of all P Q.

    They go into `signal` (P Q F,), zeros before. Or, for one pad, as a sparse matrix into the fibre indices of `sparse`
    and into `signal`, if the former's starts (Q + 1,), from `count_touched`, are not empty.

    Returns:
        Number of spans visited.
    """
    chains = shape[0]
    stretches, scratch = make_scratch(max(chains[0].shape[1], chains[1].shape[1]))
    frames, span = (select_frame(shape, 0), select_frame(shape, 1)), np.empty(6)
    return _compute_signals(
        curves, max_offsets, ends, presses, frames, begin, end, sparse, signal, span, stretches, scratch
    )


@kernel(_nrt=False)  # else counting references takes most of the time
def _compute_signals(
    curves: Any,
    max_offsets: Any,
    ends: Any,
    presses: Any,
    frames: Any,
    begin: int,
    end: int,
    sparse: Any,
    signal: Any,
    span: Any,
    stretches: Any,
    scratch: Any,
) -> int:
    """Compute `exact_signals` with the shape in both frames and work arrays given: no array may be made here."""
    (along, across, slope), (starts, fibre) = curves, sparse
    fibres, visited = along.shape[1], 0
    for index in range(begin, end):
        p, q = index // len(presses), index % len(presses)
        slot = starts[q] if len(starts) else 0
        for family in range(2):
            ct, cv = presses[q, family], presses[q, 1 - family]
            chains, extents, law = frames[0] if family == 0 else frames[1]
            first, last = find_touched_range(cv, extents, max_offsets[p, family], ends, family)
            for f in range(first, last):
                t, v, d = along[p, f], across[p, f], slope[p, f]
                value, spans = _compute_fibre_signal(t, v, d, ct, cv, chains, extents, law, span, scratch, stretches)
                visited += spans
                if len(starts):
                    fibre[slot], signal[slot] = f, value
                    slot += 1
                else:
                    signal[index * fibres + f] = value
    return visited
