"""Information measures on a pad's signals, and the published objective made of them, for whole populations."""

import math
from typing import Any

import numpy as np
from numba import njit

from padforge.design.kernels.geometry import MANHATTAN, SCRATCH, UNIFORM, in_frame, roots_in_unit, sort, weigh
from padforge.design.kernels.pchip import extremes, pchip_sample, piece_of


@njit(cache=True, error_model="numpy")
def _first_at_least(curve: Any, low: int, high: int, value: float, rising: bool) -> int:
    """First index in [low, high) at which a monotone stretch of `curve` has reached `value`; high if none has."""
    while low < high:
        middle = (low + high) // 2
        if (curve[middle] >= value) if rising else (curve[middle] <= value):
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True, error_model="numpy")
def _between_chains(dt: float, dv: float, chains: Any) -> bool:
    """Whether (dt, dv) from the centre lies between the lower and the upper chain of a polygon."""
    breaks, upper, lower = chains
    if not breaks[0] <= dt <= breaks[-1]:
        return False
    k = piece_of(dt, breaks, len(breaks) - 1)
    x = (dt - breaks[k]) / (breaks[k + 1] - breaks[k])
    return lower[k] + x * (lower[k + 1] - lower[k]) <= dv <= upper[k] + x * (upper[k + 1] - upper[k])


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "nsz"})
def _uniform_sum(
    curve: Any,
    runs: Any,
    low: int,
    high: int,
    step: float,
    ct: float,
    cv: float,
    chains: Any,
    outer: float,
    inner: float,
) -> float:
    """`_stretch_sum` with weight 1: the circle inside the shape without a branch, the ring around it one by one.

    outer, inner: squared radii of the circles around and inside the shape.
    """
    values, weights, start = curve[low:high], runs[low:high], low * step - ct
    total, ring = 0.0, 0
    for i in range(len(values)):
        dt, dv = start + i * step, values[i] - cv
        square = dt * dt + dv * dv
        total += weights[i] if square <= inner else 0.0
        ring += 1 if inner < square <= outer else 0
    # the ring is met near the ends first; what lies between them is walked only if some of it is left
    first, last = 0, len(values) - 1
    for sweep in range(3):
        while ring > 0 and first <= last:
            i = last if sweep == 1 else first
            dt, dv = start + i * step, values[i] - cv
            square = dt * dt + dv * dv
            if square <= inner and sweep < 2:
                break
            if inner < square <= outer:
                ring -= 1
                if _between_chains(dt, dv, chains):
                    total += weights[i]
            if sweep == 1:
                last -= 1
            else:
                first += 1
    return total


@njit(cache=True, error_model="numpy")
def _stretch_sum(curve: Any, runs: Any, low: int, high: int, step: float, ct: float, cv: float, shape: Any) -> float:
    """Sum over the samples [low, high) that start inside the press at (ct, cv)."""
    chains, reach, law = shape
    outer, inner = law.radius * law.radius, reach[4] * reach[4]
    if law.weight == UNIFORM:
        return _uniform_sum(curve, runs, low, high, step, ct, cv, chains, outer, inner)
    total = 0.0
    for i in range(low, high):
        dt, dv = i * step - ct, curve[i] - cv
        square = dt * dt + dv * dv
        if square <= inner or (square <= outer and _between_chains(dt, dv, chains)):
            total += runs[i] * weigh(square, law)
    return total


@njit(cache=True, error_model="numpy")
def fibre_quantized(t: Any, v: Any, curve: Any, step: float, presses: Any, family: int, shape: Any, out: Any) -> int:
    """Signals of one sampled fibre for presses (Q, 2) into out (Q,); returns how many samples were looked at.

    Between knots a fibre is monotone, so the samples a press can touch are index ranges: by its extent along the
    travel axis, then by bisection across it.

    Args:
        t, v: (n,) knots. curve: samples of the fibre at 0, step, ... shape: of `in_frame`; its extents (5,) are least
            and greatest t, least and greatest v, radius of the circle inside.
    """
    reach, length = shape[1], shape[2].length
    n, segments = len(t), len(curve) - 1
    runs = np.empty(segments)
    here, ahead = curve[:-1], curve[1:]
    for i in range(segments):
        rise = abs(ahead[i] - here[i])
        runs[i] = step + rise if length == MANHATTAN else math.sqrt(step * step + rise * rise)
    starts = np.empty(n, np.int64)
    for j in range(n - 1):
        starts[j] = math.ceil(t[j] / step)
    starts[n - 1] = segments
    low, high = extremes(v)
    bottom, top = low - reach[3], high - reach[2]
    looked_at = 0
    for q in range(len(presses)):
        ct, cv = presses[q, family], presses[q, 1 - family]
        out[q] = 0.0
        if not bottom <= cv <= top:
            continue
        first = max(0, math.ceil((ct + reach[0]) / step) - 1)
        last = min(segments, math.floor((ct + reach[1]) / step) + 2)
        low, high = cv + reach[2], cv + reach[3]
        j = max(piece_of(first * step, t, n) - 1, 0)
        while j < n - 1 and starts[j] < last:
            a, b = max(first, starts[j]), min(last, starts[j + 1])
            if a < b and min(v[j], v[j + 1]) <= high and max(v[j], v[j + 1]) >= low:
                if v[j + 1] >= v[j]:
                    a, b = _first_at_least(curve, a, b, low, True), _first_at_least(curve, a, b, high, True)
                else:
                    a, b = _first_at_least(curve, a, b, high, False), _first_at_least(curve, a, b, low, False)
                # one more on either side: bisection is by sampled values, which rounding may put out of order
                a, b = max(a - 1, first, starts[j]), min(b + 1, last, starts[j + 1])
                out[q] += _stretch_sum(curve, runs, a, b, step, ct, cv, shape)
                looked_at += b - a
            j += 1
    return looked_at


@njit(cache=True, error_model="numpy", nogil=True)
def quantized_signals(
    travel: Any, cross: Any, horizontals: int, presses: Any, shape: Any, samples: int, begin: int, end: int, out: Any
) -> int:
    """The published rule: sum over sampled segments that start inside the press.

    Args:
        travel, cross: (P, F, n) knots. presses: (Q, 2) x and y. shape: as `in_frame` takes it.
        samples: points per fibre, uniform along its travel axis.
        begin, end: range of fibres to do, counted through the population, 0..F P.
        out: (P, Q, F) to fill.

    Returns:
        How many samples were looked at.
    """
    fibres = travel.shape[1]
    curve, answers = np.empty(samples), np.empty(len(presses))
    looked_at = 0
    for index in range(begin, end):
        p, f = index // fibres, index % fibres
        family = 0 if f < horizontals else 1
        t, v = travel[p, f], cross[p, f]
        step = t[-1] / (samples - 1)
        pchip_sample(t, v, step, curve)
        looked_at += fibre_quantized(t, v, curve, step, presses, family, in_frame(shape, family), answers)
        for q in range(len(presses)):
            out[p, q, f] = answers[q]
    return looked_at


@njit(cache=True, error_model="numpy")
def to_levels(signals: Any, levels: int, out: Any) -> None:
    """Converter levels of signals (Q, C) into out: each column scaled to 0..levels, rounded up; 0 without range."""
    for c in range(signals.shape[1]):
        low, high = signals[0, c], signals[0, c]
        for q in range(len(signals)):
            low, high = min(low, signals[q, c]), max(high, signals[q, c])
        span = high - low
        for q in range(len(signals)):
            out[q, c] = math.ceil((signals[q, c] - low) / span * levels) if span > 0 else 0.0


@njit(cache=True, error_model="numpy")
def row_entropy(rows: Any, first: Any, end: int) -> float:
    """Joint entropy in bits of the rows of (Q, C), columns first..end: equal rows are counted by sorted hash."""
    count = len(rows)
    if count == 0:
        return 0.0
    hashes = np.empty(count, np.uint64)
    for q in range(count):
        code = np.uint64(1469598103934665603)
        for c in range(first, end):
            code = (code ^ np.uint64(np.int64(rows[q, c]))) * np.uint64(1099511628211)
            code ^= code >> np.uint64(29)
        hashes[q] = code
    sort(hashes, count)
    entropy, run = 0.0, 0
    for q in range(count):
        run += 1
        if q == count - 1 or hashes[q + 1] != hashes[q]:
            entropy += run * math.log2(count / run)
            run = 0
    return entropy / count


@njit(cache=True, error_model="numpy")
def second_differences(levels: Any) -> float:
    """Sum over the columns of (Q, C) of |second difference|."""
    total = 0.0
    for q in range(1, len(levels) - 1):
        for c in range(levels.shape[1]):
            total += abs(levels[q + 1, c] - 2 * levels[q, c] + levels[q - 1, c])
    return total


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "nsz"})
def disorder(curves: Any, horizontals: int) -> float:
    """Sum over pairs i < j of each family of the negative parts of curve_j - curve_i, curves (F, samples)."""
    total = 0.0
    for i in range(len(curves)):
        for j in range(i + 1, horizontals if i < horizontals else len(curves)):
            upper, lower = curves[i], curves[j]
            for k in range(len(upper)):
                gap = upper[k] - lower[k]
                total += gap if gap > 0 else 0.0
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def published_terms(
    travel: Any,
    cross: Any,
    horizontals: int,
    presses: Any,
    shape: Any,
    samples: int,
    levels: int,
    begin: int,
    end: int,
    out: Any,
) -> None:
    """Entropy (sum of the families' joint entropies), sharpness and disorder of pads begin..end into out (P, 3)."""
    fibres = travel.shape[1]
    curves = np.empty((fibres, samples))
    signals, answers = np.empty((len(presses), fibres)), np.empty(len(presses))
    scaled = np.empty((len(presses), fibres))
    for p in range(begin, end):
        for f in range(fibres):
            family = 0 if f < horizontals else 1
            t, v, own = travel[p, f], cross[p, f], in_frame(shape, family)
            step = t[-1] / (samples - 1)
            pchip_sample(t, v, step, curves[f])
            fibre_quantized(t, v, curves[f], step, presses, family, own, answers)  # for a column, compiled anew
            for q in range(len(presses)):  # an assignment to a slice takes two seconds to compile
                signals[q, f] = answers[q]
        to_levels(signals, levels, scaled)
        out[p, 0] = row_entropy(scaled, np.int64(0), horizontals) + row_entropy(scaled, horizontals, fibres)
        out[p, 1] = second_differences(scaled)
        out[p, 2] = disorder(curves, horizontals)


@njit(cache=True, error_model="numpy")
def _cubic_on(t: Any, v: Any, d: Any, k: int, a: float, width: float, sign: float, p: Any) -> None:
    """Add sign times span k of a fibre on [a, a + width] to p (4,), powers of u in [0, 1]."""
    h, rise = t[k + 1] - t[k], v[k + 1] - v[k]
    a1, a2, a3 = h * d[k], 3 * rise - h * (2 * d[k] + d[k + 1]), h * (d[k] + d[k + 1]) - 2 * rise
    s, w = (a - t[k]) / h, width / h
    p[0] += sign * (v[k] + s * (a1 + s * (a2 + s * a3)))
    p[1] += sign * w * (a1 + s * (2 * a2 + 3 * s * a3))
    p[2] += sign * w * w * (a2 + 3 * s * a3)
    p[3] += sign * w**3 * a3


@njit(cache=True, error_model="numpy")
def area_above(t: Any, v: Any, d: Any, other_t: Any, other_v: Any, other_d: Any) -> float:
    """Integral over the travel axis of max(curve - other, 0): PCHIP curves by knots and slopes, exact."""
    roots, work, p = np.empty(4), np.empty(SCRATCH), np.empty(4)
    i, j, total, a = 0, 0, 0.0, t[0]
    while i < len(t) - 1 and j < len(other_t) - 1:
        b = min(t[i + 1], other_t[j + 1])
        if b > a:
            p[:] = 0.0
            _cubic_on(t, v, d, i, a, b - a, 1.0, p)
            _cubic_on(other_t, other_v, other_d, j, a, b - a, -1.0, p)
            count = roots_in_unit(p, np.int64(3), 1e-15 * (abs(v[i]) + abs(v[i + 1])), roots, np.int64(0), work)
            roots[count] = 1.0
            start, before = 0.0, 0.0
            for r in range(count + 1):
                u = roots[r]
                after = u * (p[0] + u * (p[1] / 2 + u * (p[2] / 3 + u * p[3] / 4)))
                u = 0.5 * (start + roots[r])
                if p[0] + u * (p[1] + u * (p[2] + u * p[3])) > 0:
                    total += (b - a) * (after - before)
                start, before = roots[r], after
        a = b
        if t[i + 1] <= b:
            i += 1
        if other_t[j + 1] <= b:
            j += 1
    return total


@njit(cache=True, error_model="numpy")
def disorder_area(travel: Any, cross: Any, slope: Any, horizontals: int) -> float:
    """Sum of `area_above` over pairs i < j of each family of a pad, knots and slopes (F, n)."""
    total = 0.0
    for i in range(len(travel)):
        for j in range(i + 1, horizontals if i < horizontals else len(travel)):
            total += area_above(travel[i], cross[i], slope[i], travel[j], cross[j], slope[j])
    return total
