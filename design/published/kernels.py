"""The published method: signals of sampled fibres, and the terms of the published objective, for whole populations."""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.design.kernels.geometry import MANHATTAN, UNIFORM, select_frame, shell_sort, weigh_element
from padforge.design.kernels.pchip import extremes, pchip_sample, piece_of


@kernel
def _bisect_monotone(curve: Any, low: int, high: int, value: float, rising: bool) -> int:
    """Find the first index in [low, high) at which a monotone stretch of `curve` reaches `value`; high if none."""
    while low < high:
        middle = (low + high) // 2
        if (curve[middle] >= value) if rising else (curve[middle] <= value):
            high = middle
        else:
            low = middle + 1
    return low


@kernel
def _is_between_chains(dt: float, dv: float, chains: Any) -> bool:
    """Return whether (dt, dv) from the centre lies between the lower and the upper chain of a polygon."""
    breaks, upper, lower = chains
    if not breaks[0] <= dt <= breaks[-1]:
        return False
    k = piece_of(dt, breaks, len(breaks) - 1)
    x = (dt - breaks[k]) / (breaks[k + 1] - breaks[k])
    return lower[k] + x * (lower[k + 1] - lower[k]) <= dv <= upper[k] + x * (upper[k + 1] - upper[k])


@kernel(fastmath={"reassoc", "nsz"})
def _sum_uniform(
    curve: Any,
    segment_lengths: Any,
    low: int,
    high: int,
    step: float,
    ct: float,
    cv: float,
    chains: Any,
    outer: float,
    inner: float,
) -> float:
    """Compute `_sum_stretch` for weight 1: samples in the inscribed circle without branches, those around it singly.

    The squared radii of the polygon and of its inscribed circle are arguments, since the loop is not vectorised if they
    are taken from the shape here.
    """
    values, weights, start = curve[low:high], segment_lengths[low:high], low * step - ct
    total, ring = 0.0, 0
    for i in range(len(values)):
        dt, dv = start + i * step, values[i] - cv
        square = dt * dt + dv * dv
        total += weights[i] if square <= inner else 0.0
        ring += 1 if inner < square <= outer else 0
    # samples in the ring are mostly near the ends: scan from both, and the middle only if some remain
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
                if _is_between_chains(dt, dv, chains):
                    total += weights[i]
            if sweep == 1:
                last -= 1
            else:
                first += 1
    return total


@kernel
def _sum_stretch(
    curve: Any, segment_lengths: Any, low: int, high: int, step: float, ct: float, cv: float, shape: Any
) -> float:
    """Sum the segments of samples [low, high) that start inside the press at (ct, cv)."""
    chains, extents, law = shape
    outer, inner = law.radius * law.radius, extents[4] * extents[4]
    if law.weight == UNIFORM:
        return _sum_uniform(curve, segment_lengths, low, high, step, ct, cv, chains, outer, inner)
    total = 0.0
    for i in range(low, high):
        dt, dv = i * step - ct, curve[i] - cv
        square = dt * dt + dv * dv
        if square <= inner or (square <= outer and _is_between_chains(dt, dv, chains)):
            total += segment_lengths[i] * weigh_element(dt, dv, step, curve[i + 1] - curve[i], law)
    return total


@kernel
def _sample_fibre_signals(
    t: Any, v: Any, curve: Any, step: float, presses: Any, family: int, shape: Any, out: Any
) -> None:
    """Compute the signals (Q,) of one fibre sampled at 0, step, ...

    Fibres are monotone between knots, so the samples that a press can touch are index ranges: by its extent along the
    axis, then by bisection across it.
    """
    extents, length = shape[1], shape[2].length
    n, segments = len(t), len(curve) - 1
    segment_lengths = np.empty(segments)
    start, ahead = curve[:-1], curve[1:]
    for i in range(segments):
        rise = abs(ahead[i] - start[i])
        segment_lengths[i] = step + rise if length == MANHATTAN else math.sqrt(step * step + rise * rise)
    starts = np.empty(n, np.int64)
    for j in range(n - 1):
        starts[j] = math.ceil(t[j] / step)
    starts[n - 1] = segments
    low, high = extremes(v)
    bottom, top = low - extents[3], high - extents[2]
    for q in range(len(presses)):
        ct, cv = presses[q, family], presses[q, 1 - family]
        out[q] = 0.0
        if not bottom <= cv <= top:
            continue
        first = max(0, math.ceil((ct + extents[0]) / step) - 1)
        last = min(segments, math.floor((ct + extents[1]) / step) + 2)
        low, high = cv + extents[2], cv + extents[3]
        j = max(piece_of(first * step, t, n) - 1, 0)
        while j < n - 1 and starts[j] < last:
            a, b = max(first, starts[j]), min(last, starts[j + 1])
            if a < b and min(v[j], v[j + 1]) <= high and max(v[j], v[j + 1]) >= low:
                if v[j + 1] >= v[j]:
                    a, b = _bisect_monotone(curve, a, b, low, True), _bisect_monotone(curve, a, b, high, True)
                else:
                    a, b = _bisect_monotone(curve, a, b, high, False), _bisect_monotone(curve, a, b, low, False)
                # one more on either side: rounding may break the order of sampled values that bisection relies on
                a, b = max(a - 1, first, starts[j]), min(b + 1, last, starts[j + 1])
                out[q] += _sum_stretch(curve, segment_lengths, a, b, step, ct, cv, shape)
            j += 1


@kernel
def quantized_signals(
    along: Any, across: Any, horizontals: int, presses: Any, shape: Any, samples: int, begin: int, end: int, out: Any
) -> None:
    """Compute the signals of fibres `begin` to `end` of all P F into out (P, Q, F), from `samples` points per fibre.

    A signal is the sum of the segments that start inside the shape, which is (chains, extents, law).
    """
    fibres = along.shape[1]
    curve, column = np.empty(samples), np.empty(len(presses))
    for index in range(begin, end):
        p, f = index // fibres, index % fibres
        family = 0 if f < horizontals else 1
        t, v = along[p, f], across[p, f]
        step = t[-1] / (samples - 1)
        pchip_sample(t, v, step, curve)
        _sample_fibre_signals(t, v, curve, step, presses, family, select_frame(shape, family), column)
        for q in range(len(presses)):
            out[p, q, f] = column[q]


@kernel
def quantize(signals: Any, levels: int, out: Any) -> None:
    """Scale each column of signals (Q, C) to 0..levels, rounded up, into out; 0 for a constant column."""
    for c in range(signals.shape[1]):
        low, high = signals[0, c], signals[0, c]
        for q in range(len(signals)):
            low, high = min(low, signals[q, c]), max(high, signals[q, c])
        span = high - low
        for q in range(len(signals)):
            out[q, c] = math.ceil((signals[q, c] - low) / span * levels) if span > 0 else 0.0


@kernel
def compute_row_entropy(rows: Any, first: Any, end: int) -> float:
    """Compute the joint entropy, bits, of rows in columns first..end by counting equal sorted hashes (FNV-1a)."""
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
    shell_sort(hashes, count)
    entropy, run = 0.0, 0
    for q in range(count):
        run += 1
        if q == count - 1 or hashes[q + 1] != hashes[q]:
            entropy += run * math.log2(count / run)
            run = 0
    return entropy / count


@kernel
def sum_second_differences(levels: Any) -> float:
    """Sum |second difference| over the columns of (Q, C)."""
    total = 0.0
    for q in range(1, len(levels) - 1):
        for c in range(levels.shape[1]):
            total += abs(levels[q + 1, c] - 2 * levels[q, c] + levels[q - 1, c])
    return total


@kernel(fastmath={"reassoc", "nsz"})
def _sum_disorder(curves: Any, horizontals: int) -> float:
    """Sum the negative parts of curve_j - curve_i over pairs i < j of each family; curves are (F, samples)."""
    total = 0.0
    for i in range(len(curves)):
        for j in range(i + 1, horizontals if i < horizontals else len(curves)):
            upper, lower = curves[i], curves[j]
            for k in range(len(upper)):
                gap = upper[k] - lower[k]
                total += gap if gap > 0 else 0.0
    return total


@kernel
def published_terms(
    along: Any,
    across: Any,
    horizontals: int,
    presses: Any,
    shape: Any,
    samples: int,
    levels: int,
    begin: int,
    end: int,
    out: Any,
) -> None:
    """Compute four terms of pads `begin` to `end` into `out` (P, 4).

    The terms are the sum of the joint entropies of both families, sharpness, disorder, and the joint entropy of all
    fibres.
    """
    fibres = along.shape[1]
    curves = np.empty((fibres, samples))
    signals, column = np.empty((len(presses), fibres)), np.empty(len(presses))
    scaled = np.empty((len(presses), fibres))
    for p in range(begin, end):
        for f in range(fibres):
            family = 0 if f < horizontals else 1
            t, v, framed = along[p, f], across[p, f], select_frame(shape, family)
            step = t[-1] / (samples - 1)
            pchip_sample(t, v, step, curves[f])
            # a strided column of `signals` as argument, or an assignment to a slice, would take long to compile
            _sample_fibre_signals(t, v, curves[f], step, presses, family, framed, column)
            for q in range(len(presses)):
                signals[q, f] = column[q]
        quantize(signals, levels, scaled)
        zero = np.int64(0)  # kernels are compiled anew for each literal
        out[p, 0] = compute_row_entropy(scaled, zero, horizontals) + compute_row_entropy(scaled, horizontals, fibres)
        out[p, 1] = sum_second_differences(scaled)
        out[p, 2] = _sum_disorder(curves, horizontals)
        out[p, 3] = compute_row_entropy(scaled, zero, fibres)
