"""What is told of fibres as they are drawn: the rules they break, and where they confuse presses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.ambiguity import AMBIGUITY_NOISE, ambiguity_map, free_presses
from padforge.design.objectives.rules import check_rules
from padforge.design.paths.curves import beziers
from padforge.design.paths.fitting import add_spare_knots
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, SearchSettings

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


@dataclass(frozen=True)
class Answers:
    """What a pad is judged by.

    Attributes:
        size: of the pad, whose layout all courses have.
    """

    size: PadSettings
    rules: RulesSettings
    contact: Contact
    search: SearchSettings

    def morphology(self, courses: Courses) -> Morphology:
        """The courses as a pad."""
        layout = self.size.layout
        return Morphology.from_layout(add_spare_knots(courses, layout), layout)

    def of(self, courses: Courses) -> dict[str, Any]:
        """All that is told of courses, JSON, in mm from the middle of the pad and grid units."""
        pad = self.morphology(courses)
        spread = self._spread(pad)
        broken = check_rules(pad, self.rules, self.size)
        spans = pad.to_mm(beziers(pad)).round(4)
        return {
            "fibres": [
                {"family": pad.layout.family(fibre), "knots": _told(pad, course), "spans": spans[fibre].tolist()}
                for fibre, course in enumerate(courses)
            ],
            "rules": [
                {"text": str(found), "fibres": found.fibres, "place_mm": found.place_mm and list(found.place_mm)}
                for found in broken
            ],
            "map": np.round(spread, 4).tolist(),
            "ambiguity": spread.mean(axis=1).tolist(),
        }

    @cached_property
    def fixed(self) -> dict[str, Any]:
        """What stays while fibres are drawn, JSON."""
        layout = self.size.layout
        straight = Morphology.straight(layout)
        low, high = (straight.to_mm(corner) for corner in self.size.sensed)
        places = straight.to_mm(self._presses)
        return {
            "middle_mm": [0, 0],
            "half_mm": [side / 2 for side in layout.size_mm],
            "unit_mm": layout.unit_mm,
            "mirrored": False,
            "deep": int(self.size.deep_family == "vertical"),
            "sensed_mm": [*low.tolist(), *high.tolist()],
            "keep_out_mm": self.size.keep_out_mm,
            "places_mm": places.round(3).tolist(),
            "cell_mm": [_step(places[:, axis]) for axis in (0, 1)],
            "straight": self._spread(straight).mean(axis=1).tolist(),
        }

    @cached_property
    def _presses(self) -> Array:
        return free_presses(self.size)

    def _spread(self, pad: Morphology) -> Array:
        return ambiguity_map(pad, self._presses, self.contact, self.search.max_failures, AMBIGUITY_NOISE)


def _told(pad: Morphology, course: Array) -> list[list[float]]:
    return pad.to_mm(course).round(4).tolist()


def _step(places: Array) -> float:
    """Distance of neighbouring rows or columns of a lattice."""
    apart = np.diff(np.unique(places.round(6)))
    return float(apart.min()) if len(apart) else 1.0
