"""The published contact rule: segments of a sampled fibre count whole if they start inside the press."""

import math
from typing import Any

import numpy as np
from numba import njit

from ..pchip import extremes, pchip_sample, piece_of
from ..press import MANHATTAN, UNIFORM, in_frame, weigh


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
