"""Signals of a measured reach and their gradient, as precisely as a search needs them: elements laid once a pad.

Gauss rules cut the spans of a fibre into elements, whose places and lengths do not depend on the press. A press sums
the weights of those within its reach; and what an objective gains from an element, by its place and its length, is
gathered over all presses before it goes on to knots and slopes, once for each element.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from padforge.design.kernels.exact_gradient import variations
from padforge.design.kernels.geometry import MANHATTAN, profile_coefficients, profile_weights
from padforge.design.kernels.pchip import extremes

Array = NDArray[np.float64]

PRECISION = 5e-5
"""Of signals here, as a share of the largest one: far within what was measured."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)  # fewer do not follow how a span bends
_NODES, _WEIGHTS = (1 + _NODES) / 2, _WEIGHTS / 2  # on [0, 1]
MAX_REFINEMENTS = 24
"""Times at most that elements are laid closer by a fifth, from a quarter of the reach on: a steep one asks for it."""
MAX_PIECES = 512
"""Of a span, so that memory is bounded: only a reach that is hundreds of times shorter than a span would take more."""


class Elements(NamedTuple):
    """Fibres cut into elements, E of them in the order of fibres and their travel.

    Attributes:
        horizontals: how many of the fibres, from the first, travel along x.
        starts: (F, n) the first element of each span, and behind them of the next fibre.
        travel, cross, length: (E,) where they lie and how long they are, grid units.
        share, weight: (E,) where on its span each lies, 0..1, and the share of the span that it stands for.
    """

    horizontals: int
    starts: Any
    travel: Array
    cross: Array
    length: Array
    share: Array
    weight: Array


@lru_cache(maxsize=64)
def element_spacing(reach: tuple[tuple[float, float], ...]) -> float:
    """How far apart elements may be, grid units: so that a straight fibre at any distance signals to PRECISION."""
    profile, end = profile_coefficients(reach), reach[-1][0]
    heights, shifts = end * np.arange(32)[:, None, None] / 32, np.arange(16)[:, None] / 16

    def straight(spacing: float) -> Array:
        """(heights, shifts) its signals by pieces of a span that begin in different places."""
        width = len(_NODES) * spacing
        begin = width * (np.arange(-math.ceil(end / width) - 1, math.ceil(end / width) + 1) + shifts)
        at = (begin[..., None] + width * _NODES).reshape(len(shifts), -1)
        lengths = np.tile(width * _WEIGHTS, begin.shape[-1])
        return profile_weights(profile, end, np.hypot(at, heights)) @ lengths

    spacing = end / 4
    for _ in range(MAX_REFINEMENTS):
        found = straight(spacing)
        right = found.mean(axis=1, keepdims=True)  # far more precise than any of them
        if np.abs(found - right).max() <= PRECISION * np.abs(right).max():
            break
        spacing *= 0.8
    return spacing


@njit(cache=True, error_model="numpy")
def _pieces(h: float, rise: float, d0: float, d1: float, spacing: float) -> int:
    """In how many equal pieces a span is cut so that their elements lie `spacing` apart or closer, on average."""
    # the rate at which a span rises is a quadratic, which keeps within its Bezier points
    steepest = max(abs(h * d0), abs(h * d1), abs(3 * rise - h * (d0 + d1)))
    return math.ceil(min(math.hypot(h, steepest) / (len(_NODES) * spacing), 1.0 * MAX_PIECES))


@njit(cache=True, error_model="numpy", nogil=True)
def fibre_elements(
    travel: Any, cross: Any, slope: Any, horizontals: int, presses: Any, end: float, spacing: float, length: int
) -> Any:
    """`Elements` of one pad's spans, those that none of the presses can reach left out.

    Args:
        travel, cross, slope: (F, n) knots and slopes. horizontals: how many of them. presses: (Q, 2), at least one.
        end: of the reach. spacing: of `element_spacing`.
        length: MANHATTAN or EUCLIDEAN.
    """
    fibres, n = travel.shape
    low, high = np.empty(2), np.empty(2)
    for axis in range(2):
        least, largest = extremes(presses[:, axis])
        low[axis], high[axis] = least - end, largest + end
    pieces, starts = np.zeros((fibres, n), np.int64), np.zeros((fibres, n), np.int64)
    total = 0
    for f in range(fibres):
        along = 0 if f < horizontals else 1
        for j in range(n - 1):
            starts[f, j] = total
            t0, t1, v0, v1 = travel[f, j], travel[f, j + 1], cross[f, j], cross[f, j + 1]
            is_near = t1 > low[along] and t0 < high[along]
            if is_near and max(v0, v1) > low[1 - along] and min(v0, v1) < high[1 - along]:
                pieces[f, j] = _pieces(t1 - t0, v1 - v0, slope[f, j], slope[f, j + 1], spacing)
                total += pieces[f, j] * len(_NODES)
        starts[f, n - 1] = total
    out = np.empty((5, total))
    for f in range(fibres):
        for j in range(n - 1):
            h, v0, rise = travel[f, j + 1] - travel[f, j], cross[f, j], cross[f, j + 1] - cross[f, j]
            a1 = h * slope[f, j]
            a2, a3 = 3 * rise - 2 * a1 - h * slope[f, j + 1], a1 + h * slope[f, j + 1] - 2 * rise
            k = starts[f, j]
            for piece in range(pieces[f, j]):
                for i in range(len(_NODES)):
                    s, weight = (piece + _NODES[i]) / pieces[f, j], _WEIGHTS[i] / pieces[f, j]
                    run = abs(a1 + s * (2 * a2 + 3 * a3 * s))
                    run = h + run if length == MANHATTAN else math.hypot(h, run)
                    out[0, k], out[1, k] = travel[f, j] + h * s, v0 + s * (a1 + s * (a2 + s * a3))
                    out[2, k], out[3, k], out[4, k] = weight * run, s, weight
                    k += 1
    return Elements(horizontals, starts, out[0], out[1], out[2], out[3], out[4])


@njit(cache=True, error_model="numpy")
def _is_near(t: Any, v: Any, j: int, ct: float, cv: float, end: float) -> bool:
    """Whether span j of a fibre, which lies in the box of its ends, comes within `end` of (ct, cv) along both axes."""
    along = t[j] < ct + end and t[j + 1] > ct - end
    return along and min(v[j], v[j + 1]) < cv + end and max(v[j], v[j + 1]) > cv - end


@njit(cache=True, error_model="numpy")
def _piece(square: float, profile: Any, piece: Any) -> int:
    """The row of a profile that holds at squared distance `square`, sought from the one of an element nearby."""
    while piece > 0 and square < profile[piece, 0]:
        piece -= 1
    while piece < len(profile) - 1 and square >= profile[piece + 1, 0]:
        piece += 1
    return piece


@njit(cache=True, error_model="numpy", nogil=True)
def element_signals(travel: Any, cross: Any, elements: Any, presses: Any, end: float, profile: Any, out: Any) -> int:
    """Signals of one pad for presses (Q, 2) into out (Q, F); returns how many spans were looked at.

    Args:
        travel, cross: (F, n) knots. elements: of `fibre_elements`. end, profile: of the reach.
    """
    fibres, n = travel.shape
    looked_at, piece = 0, np.int64(0)
    for f in range(fibres):
        t, v, first, along = travel[f], cross[f], elements.starts[f], 0 if f < elements.horizontals else 1
        bottom, top = extremes(v)
        for q in range(len(presses)):
            ct, cv, total = presses[q, along], presses[q, 1 - along], 0.0
            for j in range(n - 1 if bottom - end < cv < top + end else 0):
                if not _is_near(t, v, j, ct, cv, end):
                    continue
                looked_at += 1
                for k in range(first[j], first[j + 1]):
                    dt, dv = elements.travel[k] - ct, elements.cross[k] - cv
                    square = dt * dt + dv * dv
                    if square < end * end:
                        piece = _piece(square, profile, piece)
                        start, c0, c1, c2, c3 = profile[piece]
                        x = square - start
                        total += elements.length[k] * (c0 + x * (c1 + x * (c2 + x * c3)))
            out[q, f] = total
    return looked_at


@njit(cache=True, error_model="numpy")
def _gains(
    travel: Any, cross: Any, elements: Any, presses: Any, upstream: Any, end: float, profile: Any, out: Any
) -> None:
    """How sum(upstream * signals) changes with each element's travel, cross and length, into out (3, E), 0 before."""
    fibres, n = travel.shape
    piece = np.int64(0)
    for f in range(fibres):
        t, v, first, along = travel[f], cross[f], elements.starts[f], 0 if f < elements.horizontals else 1
        bottom, top = extremes(v)
        for q in range(len(presses)):
            ct, cv, up = presses[q, along], presses[q, 1 - along], upstream[q, f]
            for j in range(n - 1 if bottom - end < cv < top + end else 0):
                if not _is_near(t, v, j, ct, cv, end):
                    continue
                for k in range(first[j], first[j + 1]):
                    dt, dv = elements.travel[k] - ct, elements.cross[k] - cv
                    square = dt * dt + dv * dv
                    if square < end * end:
                        piece = _piece(square, profile, piece)
                        start, c0, c1, c2, c3 = profile[piece]
                        x = square - start
                        nearer = 2 * up * elements.length[k] * (c1 + x * (2 * c2 + 3 * x * c3))
                        out[0, k] += nearer * dt
                        out[1, k] += nearer * dv
                        out[2, k] += up * (c0 + x * (c1 + x * (c2 + x * c3)))


@njit(cache=True, error_model="numpy", nogil=True)
def elements_gradient(
    travel: Any,
    cross: Any,
    slope: Any,
    elements: Any,
    presses: Any,
    upstream: Any,
    end: float,
    profile: Any,
    length: int,
) -> Any:
    """Gradient (3, F, n) of sum(upstream * signals) by knots' travel and cross coordinates and slopes, one pad.

    Args:
        travel, cross, slope, presses, end, length: as `fibre_elements` takes them, which gave `elements`.
        upstream: (Q, F). profile: of the reach.
    """
    fibres, n = travel.shape
    out, gains = np.zeros((3, fibres, n)), np.zeros((3, len(elements.length)))
    _gains(travel, cross, elements, presses, upstream, end, profile, gains)
    place, rate = np.empty((6, 2)), np.empty((6, 2))
    for f in range(fibres):
        for j in range(n - 1):
            h, d0, d1 = travel[f, j + 1] - travel[f, j], slope[f, j], slope[f, j + 1]
            m = (cross[f, j + 1] - cross[f, j]) / h
            for k in range(elements.starts[f, j], elements.starts[f, j + 1]):
                s = elements.share[k]
                along = h * (d0 + s * (2 * (3 * m - 2 * d0 - d1) + 3 * s * (d0 + d1 - 2 * m)))
                run = h + abs(along) if length == MANHATTAN else math.hypot(h, along)
                run_t = 1.0 if length == MANHATTAN else h / run
                run_v = math.copysign(1.0, along) if length == MANHATTAN else along / run
                longer = gains[2, k] * elements.weight[k]
                variations(s, h, d0, d1, place, rate)
                for x in range(6):
                    moved = gains[0, k] * place[x, 0] + gains[1, k] * place[x, 1]
                    out[x // 2, f, j + x % 2] += moved + longer * (run_t * rate[x, 0] + run_v * rate[x, 1])
    return out
