"""The planned fibres as rows of short elements, in grid units from the pad's corner."""

from dataclasses import dataclass

import numpy as np

from design import Morphology
from design.pad.courses.curves import flatten
from sense.recordings.processing.limits import Array

ELEMENTS = 160
"""Elements of a fibre."""
FLAT = 1e-3
"""Tolerance of the polyline they lie on, grid units."""


@dataclass(frozen=True)
class Plan:
    """Elements of F a fibre, evenly spaced along each.

    Attributes:
        course: (2M, F, 2) their middles. tangent: (2M, F, 2) of unit length. length: (2M, F). pitch_mm, grid: as of the
            morphology.
    """

    course: Array
    tangent: Array
    length: Array
    pitch_mm: float
    grid: int

    @classmethod
    def of(cls, pad: Morphology) -> "Plan":
        """Of a morphology."""
        course, tangent, length = [], [], []
        for line in flatten(pad, FLAT):
            run = np.append(0.0, np.hypot(*np.diff(line, axis=0).T).cumsum())
            ends = np.linspace(0, run[-1], ELEMENTS + 1)
            points = np.column_stack([np.interp(ends, run, line[:, axis]) for axis in range(2)])
            along = np.diff(points, axis=0)
            size = np.hypot(*along.T)
            course.append((points[:-1] + points[1:]) / 2)
            tangent.append(along / size[:, None])
            length.append(size)
        return cls(np.array(course), np.array(tangent), np.array(length), pad.pitch_mm, pad.grid)

    def to_grid(self, places_mm: Array) -> Array:
        """(Q, 2) mm on the plan, from its middle, to grid units from its corner."""
        return places_mm / self.pitch_mm + (self.grid + 1) / 2
