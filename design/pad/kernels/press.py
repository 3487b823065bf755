"""The press: its shape, what a fibre element in it weighs, and which fibres it can touch.

These are an index range, since a family's fibres keep to their levels within its stray.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from padforge.design.settings.contact import profile_spline

from .pchip import piece_of

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


class Law(NamedTuple):
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
    """Weight of a fibre element at squared distance `square` from the press centre, by a `Law`."""
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
def profile_of(reach: tuple[tuple[float, float], ...]) -> Array:
    """The profile (B, 5) of `weigh` through points (distance, weight), the last of weight 0: their `profile_spline`."""
    spline = profile_spline(reach)
    return np.ascontiguousarray(np.column_stack([spline.x[:-1], spline.c[::-1].T]))  # one order: compiled once


def profile_weights(profile: Array, end: float, distance: Array) -> Array:
    """What a profile, as `profile_of` gives it, weighs at distances of any shape; 0 from `end` on."""
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
def family_strays(cross: Any, ends: Any) -> Any:
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
