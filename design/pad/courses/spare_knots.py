"""Fibres of unlike numbers of knots in one morphology, where all have as many: spare knots that move nothing.

A PCHIP curve is level at a knot where it turns back. A second knot there, of the same height and a hair further on,
lies on it and leaves it level: nothing moves by more than a hair. Near an end, whose slope hangs on two spans, that is
not so: a fibre that turns only there first gets knots on its curve, where they move it least.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from padforge.design.pad.knots import Array
from padforge.design.settings import Layout

HAIR = 1e-4
"""Length of all spare knots of a fibre together, grid units: far below what can be printed."""
_SHARES = np.array([0.15, 0.3, 0.5, 0.7, 0.85])
"""Where on a span a knot is tried."""
_LEVEL = 1e-9
"""Heights that differ by less are one: a file in pitches is right to rounding."""


def with_spares(courses: Sequence[Array], layout: Layout) -> Array:
    """(F, n, 2) knots of all fibres, n of the one that has most; those of others are filled up with spare ones.

    Args:
        courses: of every fibre its knots (n, 2), as a morphology has them.
    """
    most = max(map(len, courses))
    return np.stack([_filled(course, layout.family(fibre), most - len(course)) for fibre, course in enumerate(courses)])


def without_spares(knots: Array, layout: Layout) -> list[Array]:
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
