"""Fibres through curves that somebody has drawn: PCHIP knots, as few as keep within a tolerance.

Knots are put where a curve turns and where it is missed most, then all of them are moved along and across by
least squares (K. Levenberg 1944, D. Marquardt 1963), and left out one by one while the others can do without.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from padforge.design.kernels.pchip import pchip_slopes
from padforge.design.morphology import Array, Ints
from padforge.design.settings import Layout

HAIR = 1e-4
"""Length of all spare knots of a fibre together, grid units: far below what can be printed."""
_SHARES = np.array([0.15, 0.3, 0.5, 0.7, 0.85])
"""Where on a span a knot is tried."""
_LEVEL = 1e-9
"""Heights that differ by less are one: a file in pitches is right to rounding."""


def add_spare_knots(courses: Sequence[Array], layout: Layout) -> Array:
    """(F, n, 2) knots of all fibres, n of the one that has most; those of others are filled up with spare ones.

    Args:
        courses: of every fibre its knots (n, 2), as a morphology has them.
    """
    most = max(map(len, courses))
    return np.stack([_filled(course, layout.family(fibre), most - len(course)) for fibre, course in enumerate(courses)])


def remove_spare_knots(knots: Array, layout: Layout) -> list[Array]:
    """Of every fibre its knots (n, 2) but the spare ones, of knots (F, n, 2)."""
    courses = []
    for fibre, line in enumerate(knots):
        step = np.abs(np.diff(line, axis=0))
        axis = layout.family(fibre)
        spare = (step[:, axis] <= HAIR * (1 + _LEVEL)) & (step[:, 1 - axis] <= _LEVEL)
        spare[-1] = False
        courses.append(line[np.append(True, ~spare)])
    return courses


def _filled(course: Array, axis: int, count: int) -> Array:
    """A fibre with so many more knots."""
    if not count:
        return course
    at = _level_knot(course[:, axis], course[:, 1 - axis])
    if at is None:
        return _filled(_with_knot_on_curve(course.tobytes(), axis), axis, count - 1)
    step = min(HAIR, (course[at + 1, axis] - course[at, axis]) / 4) / count
    spares = np.repeat(course[at : at + 1], count, axis=0)
    spares[:, axis] += step * np.arange(1, count + 1)
    return np.insert(course, at + 1, spares, axis=0)


def _level_knot(travel: Array, cross: Array) -> int | None:
    """The knot where a course is level, not next to an end, that has most room behind it; None where there is none."""
    rise, room = np.diff(cross), np.diff(travel)
    if not rise.any():
        return int(np.argmax(room))
    level = np.append(rise[0] == 0, rise[:-1] * rise[1:] <= 0)
    level[[1, -1]] = False
    return int(np.argmax(np.where(level, room, -1))) if level.any() else None


@lru_cache(maxsize=256)  # whoever edits a fibre leaves all others as they are
def _with_knot_on_curve(course: bytes, axis: int) -> Array:
    """A fibre, knots (n, 2) as bytes, with one more knot on its curve near an end, where that moves it least."""
    from scipy.interpolate import PchipInterpolator

    knots = np.frombuffer(course).reshape(-1, 2)
    travel, cross = knots[:, axis], knots[:, 1 - axis]
    curve = PchipInterpolator(travel, cross)
    spans = sorted({0, 1, len(travel) - 3, len(travel) - 2} & set(range(len(travel) - 1)))
    places = np.concatenate([travel[k] + (travel[k + 1] - travel[k]) * _SHARES for k in spans])
    dense = np.concatenate([np.linspace(travel[k], travel[k + 1], 33) for k in spans])
    best, least = travel, np.inf
    for place in places:
        more = np.sort(np.append(travel, place))
        moved = float(np.abs(PchipInterpolator(more, curve(more))(dense) - curve(dense)).max())
        if moved < least:
            best, least = more, moved
    found = np.empty((len(best), 2))
    found[:, axis], found[:, 1 - axis] = best, curve(best)
    found[[0, -1]] = knots[[0, -1]]
    return found


SAMPLES = 700
"""Points of a curve that are looked at."""
_ROUNDS = 40
"""Steps of least squares at most."""
_SHARE = 0.4
"""Of the way to its neighbour by which a knot moves at once at most."""
_LEFT_OUT = 4
"""Knots that are tried to be done without, those first that are missed least."""
_TRIES = 15
"""Steps of ever shorter length that are tried for one."""
_REACH = 4
"""Spans that move with a knot, from two before it."""
_NEAREST = 2e-3
"""Least distance of knots along the curve, of its length."""


def fit_knots(points: Array, tolerance: float, most: int = 64) -> Array:
    """(n, 2) knots of a PCHIP curve through `points` that keeps within `tolerance` of it, from its first to its last.

    What is missed is measured along the normal of the curve.

    Args:
        points: (m, 2) travel, strictly ascending, and cross coordinate of a polyline.
        most: inner knots; with so many the tolerance may be missed.
    """
    samples, weight = _sampled(points)
    knots = samples[_turns(samples, tolerance)]
    if len(knots) > most + 2:  # which no choice of knots can follow
        return np.vstack([knots[: most + 1], knots[-1:]])
    while True:
        knots = _polished(samples, weight, knots)
        missed = _missed(samples, weight, knots)
        if missed.max() <= tolerance or len(knots) >= most + 2:
            break
        knots = _with_more(samples, knots, missed, tolerance, most + 2 - len(knots))
    return _thinned(samples, weight, knots, tolerance)


def _sampled(points: Array) -> tuple[Array, Array]:
    """Samples (m, 2) evenly along a polyline, and by how much less than across each is missed along the normal."""
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0, arc[-1], SAMPLES)
    samples = np.stack([np.interp(at, arc, points[:, axis]) for axis in (0, 1)], axis=1)
    samples[-1] = points[-1]
    samples = samples[np.append(True, samples[1:, 0] > np.maximum.accumulate(samples[:, 0])[:-1])]
    slope = np.gradient(samples[:, 1], samples[:, 0]) if len(samples) > 1 else np.zeros(1)
    return samples, 1 / np.sqrt(1 + slope**2)


def _turns(samples: Array, tolerance: float) -> Ints:
    """Samples at which a curve turns back by more than a tolerance, and its ends: no PCHIP curve turns elsewhere."""
    cross, turns, way = samples[:, 1], [0], 0
    extreme = 0
    for k, value in enumerate(cross):
        further = value - cross[extreme]
        if way == 0 and abs(value - cross[0]) > tolerance:
            way, extreme = (1 if value > cross[0] else -1), k
        elif way and further * way >= 0:
            extreme = k
        elif way and -further * way > tolerance:
            turns.append(extreme)
            way, extreme = -way, k
    return np.unique([*turns, len(samples) - 1])


def _values(knots: Array, travel: Array) -> Array:
    """The PCHIP curve through knots at `travel`, ascending."""
    t, v = np.ascontiguousarray(knots[:, 0]), np.ascontiguousarray(knots[:, 1])
    d = np.empty(len(t))
    pchip_slopes(t, v, d)
    span = np.clip(np.searchsorted(t, travel, side="right") - 1, 0, len(t) - 2)
    h = t[span + 1] - t[span]
    s, rise = (travel - t[span]) / h, v[span + 1] - v[span]
    a, b = h * d[span], h * d[span + 1]
    return v[span] + s * (a + s * (3 * rise - 2 * a - b + s * (a + b - 2 * rise)))


def _missed(samples: Array, weight: Array, knots: Array) -> Array:
    return np.abs(_values(knots, samples[:, 0]) - samples[:, 1]) * weight


def _with_more(samples: Array, knots: Array, missed: Array, tolerance: float, most: int) -> Array:
    """With a knot in every span that misses the tolerance, where it misses most; at most so many, the worst first."""
    span = np.clip(np.searchsorted(knots[:, 0], samples[:, 0], side="right") - 1, 0, len(knots) - 2)
    worst = []
    for k in range(len(knots) - 1):
        inside = np.flatnonzero(span == k)[1:]
        if len(inside) and missed[inside].max() > tolerance:
            worst.append(int(inside[np.argmax(missed[inside])]))
    worst.sort(key=lambda at: -missed[at])
    new = samples[worst[:most]]
    if not len(new):  # spans are shorter than samples are apart
        longest = int(np.argmax(np.diff(knots[:, 0])))
        new = knots[longest : longest + 2].mean(axis=0, keepdims=True)
    together = np.vstack([knots, new])
    return together[np.argsort(together[:, 0], kind="stable")]


def _polished(samples: Array, weight: Array, knots: Array) -> Array:
    """Inner knots moved along and across by least squares."""
    if len(knots) == 2:
        return knots
    travel, cross = samples.T
    apart = _NEAREST * (knots[-1, 0] - knots[0, 0])

    def residual(tried: Array) -> Array:
        return (_values(tried, travel) - cross) * weight

    damping, now = 1e-2, residual(knots)
    for _ in range(_ROUNDS):
        jacobian = _jacobian(travel, weight, knots, now + cross * weight)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ now
        room = _SHARE * np.maximum(np.diff(knots[:, 0]) - apart, 0)
        scale = np.diag(normal) + 1e-12 * max(np.trace(normal), 1e-300)
        for _ in range(_TRIES):
            step = np.linalg.solve(normal + damping * np.diag(scale), -gradient).reshape(-1, 2)
            step[:, 0] = np.clip(step[:, 0], -room[:-1], room[1:])
            tried = knots.copy()
            tried[1:-1] += step
            if ((found := residual(tried)) ** 2).sum() < (now**2).sum():
                break
            damping *= 5
        else:
            return knots
        gained = 1 - (found**2).sum() / (now**2).sum()
        knots, now, damping = tried, found, damping / 5
        if gained < 1e-3:
            break
    return knots


def _jacobian(travel: Array, weight: Array, knots: Array, values: Array) -> Array:
    """(m, 2 (n - 2)) change of weighted values with travel and cross of every inner knot, by differences.

    Knots so far apart that no span moves with two of them are tried at once.
    """
    count = len(knots)
    out = np.zeros((len(travel), count - 2, 2))
    span = np.clip(np.searchsorted(knots[:, 0], travel, side="right") - 1, 0, count - 2)
    step = 1e-4 * np.diff(knots[:, 0]).min()
    for first in range(1, min(_REACH + 1, count - 1)):
        group = np.arange(first, count - 1, _REACH)
        owner = (span + 2 - first) // _REACH  # of its spans, from two before to one behind
        owned = (owner >= 0) & (owner < len(group))
        rows = np.flatnonzero(owned)
        for axis in (0, 1):
            tried = knots.copy()
            tried[group, axis] += step
            change = (_values(tried, travel) * weight - values) / step
            out[rows, group[owner[rows]] - 1, axis] = change[rows]
    return out.reshape(len(travel), -1)


def _thinned(samples: Array, weight: Array, knots: Array, tolerance: float) -> Array:
    """Without knots that the others can do without."""
    while len(knots) > 2:
        fewer = [np.delete(knots, k, axis=0) for k in range(1, len(knots) - 1)]
        fewer.sort(key=lambda each: _missed(samples, weight, each).max())
        for tried in fewer[:_LEFT_OUT]:
            polished = _polished(samples, weight, tried)
            if _missed(samples, weight, polished).max() <= tolerance:
                knots = polished
                break
        else:
            break
    return knots
