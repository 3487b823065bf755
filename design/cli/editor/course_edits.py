"""What a person does to fibres: pure functions on their knots, each within what a morphology allows."""

from collections.abc import Sequence

import numpy as np
from padforge.design.common.errors import InputError
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Layout

NEAREST = 1e-3
"""Least distance of two knots along a fibre, grid units."""
MOST_KNOTS = 64
"""Inner knots of a fibre at most, as of [search] knots."""
HANDLES = 5
"""Inner knots of a straight fibre, to take hold of."""

Courses = tuple[Array, ...]
"""Of every fibre its knots (n, 2), grid units."""


def straight_courses(layout: Layout) -> Courses:
    """Straight fibres with knots to take hold of."""
    share = np.linspace(0, 1, HANDLES + 2)[:, None]
    return tuple(line[0] + share * (line[-1] - line[0]) for line in Morphology.straight(layout).knots)


def moved(courses: Courses, layout: Layout, fibre: int, knot: int, place: Sequence[float]) -> Courses:
    """With an inner knot at `place`, or as near to it as it may be: between its neighbours, on the pad."""
    course, axis = courses[fibre].copy(), layout.family(fibre)
    low, high = course[knot - 1, axis] + NEAREST, course[knot + 1, axis] - NEAREST
    if low <= high:  # else it lies between two others that leave no room
        course[knot, axis] = np.clip(place[axis], low, high)
    course[knot, 1 - axis] = np.clip(place[1 - axis], 0, layout.extent[1 - axis])
    return _with(courses, fibre, course)


def with_knot(courses: Courses, layout: Layout, fibre: int, place: Sequence[float] | None) -> tuple[Courses, int]:
    """With one more knot of a fibre on its curve, next to `place` or in the middle of its longest span, and its index.

    Raises:
        InputError: it has as many as it may have, or they leave no room there.
    """
    from scipy.interpolate import PchipInterpolator

    course, axis = courses[fibre], layout.family(fibre)
    travel = course[:, axis]
    if len(course) >= MOST_KNOTS + 2:
        raise InputError(f"fibre {fibre + 1} has {MOST_KNOTS} knots, which is all that it may have")
    longest = int(np.argmax(np.diff(travel)))
    at = float(travel[longest : longest + 2].mean() if place is None else place[axis])
    knot = int(np.clip(np.searchsorted(travel, at), 1, len(course) - 1))
    low, high = travel[knot - 1] + NEAREST, travel[knot] - NEAREST
    if low > high:
        raise InputError(f"fibre {fibre + 1} has no room for a knot there")
    at = float(np.clip(at, low, high))
    new = np.empty(2)
    new[axis], new[1 - axis] = at, PchipInterpolator(travel, course[:, 1 - axis])(at)
    return _with(courses, fibre, np.insert(course, knot, new, axis=0)), knot


def without_knot(courses: Courses, fibre: int, knot: int) -> Courses:
    """With one inner knot of a fibre less."""
    return _with(courses, fibre, np.delete(courses[fibre], knot, axis=0))


def _with(courses: Courses, fibre: int, course: Array) -> Courses:
    return (*courses[:fibre], course, *courses[fibre + 1 :])
