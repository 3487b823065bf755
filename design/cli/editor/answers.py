"""What is told of fibres as they are drawn: the rules they break, and where they confuse presses."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from padforge.design.criteria.rules import check_rules
from padforge.design.criteria.score import AMBIGUITY_NOISE, free_presses
from padforge.design.evaluation.ambiguity_map import ambiguity_map
from padforge.design.pad.courses.curves import beziers
from padforge.design.pad.courses.spare_knots import with_spares
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

from .course_edits import Courses


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
        return Morphology.of_layout(with_spares(courses, layout), layout)

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
        return ambiguity_map(pad, self._presses, self.contact, self.search.lost, AMBIGUITY_NOISE)


def _told(pad: Morphology, course: Array) -> list[list[float]]:
    return pad.to_mm(course).round(4).tolist()


def _step(places: Array) -> float:
    """Distance of neighbouring rows or columns of a lattice."""
    apart = np.diff(np.unique(places.round(6)))
    return float(apart.min()) if len(apart) else 1.0
