"""Where everything is on a drawing of the tracks, true in size: courses, numbers, scale bar and writing."""

import textwrap
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from padforge.design.morphology import Array
from padforge.design.paths.curves import beziers
from padforge.fabricate.mould.plan import Plan

from .fibre_layers import COLOURS
from .laying.orientation import sentence

Point = tuple[float, float]

SCALE_MM = 10.0
"""Length of the scale bar: whoever prints a drawing measures it."""
_TEXT_MM = 2.5
"""Height of writing, as drawing standards have it; less where the pitch is narrow."""
_ASIDE_MM = 1.0
"""Between the silicone and the writing beside it."""
NOTE = "as it lies in the tray, seen from above"
_LETTER_MM = 0.6
"""Width of a letter, at most and on average, for a height of 1."""


@dataclass(frozen=True)
class Writing:
    """Writing at (x, y) mm: `anchor` "end" ends there, "middle" has its middle there, "start" begins there."""

    text: str
    x: float
    y: float
    anchor: str
    colour: str


@dataclass(frozen=True)
class TrackSheet:
    """Where everything is on a drawing, mm, y upwards."""

    plan: Plan

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, low, right and high of the silicone."""
        return self.plan.silicone.bounds

    @cached_property
    def text_mm(self) -> float:
        """Height of the writing."""
        return min(_TEXT_MM, 0.6 * self.plan.least_pitch_mm)

    @cached_property
    def frame(self) -> tuple[float, float, float, float]:
        """Left, low, right and high of the drawing; the scale bar and the numbers lie outside of the silicone."""
        left, _, _, high = self.bounds
        digits = len(str(self.plan.pad.layout.fibres))
        left -= 2 * _ASIDE_MM + digits * self.text_mm
        low = self.scale_y - 3 * _ASIDE_MM - len(self.said) * self.line_mm
        return left, low, self.bounds[0] + self.room_mm + 2 * _ASIDE_MM, high + 2 * _ASIDE_MM

    @cached_property
    def spans(self) -> list[Array]:
        """Of every fibre (n, 4, 2) Bezier control points, those of the bends of its leads too."""
        return [
            np.concatenate([start.spans[::-1, ::-1], self.plan.pad.to_mm(curve), end.spans])
            for (start, end), curve in zip(self.plan.leads.pairs, beziers(self.plan.pad), strict=True)
        ]

    @cached_property
    def ends(self) -> Array:
        """(F, 2, 2) where every fibre enters and leaves the silicone."""
        past = self.plan.settings.mould.exit_mm
        return np.array([[lead.beyond(past) for lead in pair] for pair in self.plan.leads.pairs])

    @cached_property
    def numbers(self) -> list[Writing]:
        """The number of every fibre, outside of the silicone where it starts, and where it ends if that is beside."""
        one_side = self.plan.settings.pad.leads == "one side"
        texts = []
        for fibre, (x, y) in [each for end in range(1 + one_side) for each in enumerate(self.ends[:, end].tolist())]:
            below = self.plan.leads.pairs[fibre][0].axis == 1
            place = (x, y - _ASIDE_MM - self.text_mm / 2) if below else (x - _ASIDE_MM, y)
            anchor, colour = "middle" if below else "end", COLOURS[self.plan.family(fibre)]
            texts.append(Writing(str(fibre + 1), *place, anchor, colour))
        return texts

    @cached_property
    def scale_y(self) -> float:
        """Height of the scale bar."""
        return self.bounds[1] - 4 * _ASIDE_MM - self.text_mm

    @cached_property
    def scale(self) -> list[tuple[Point, Point]]:
        """The strokes of the scale bar."""
        left, y = self.bounds[0], self.scale_y
        ticks = [(left + share * SCALE_MM, tick) for share, tick in ((0, 1.5), (0.5, 0.8), (1, 1.5))]
        return [((left, y), (left + SCALE_MM, y)), *(((x, y), (x, y + tick)) for x, tick in ticks)]

    @cached_property
    def line_mm(self) -> float:
        """From one line of writing to the next."""
        return 1.4 * self.text_mm

    @cached_property
    def room_mm(self) -> float:
        """For writing: as wide as the silicone, or as the scale bar with its two texts."""
        left, _, right, _ = self.bounds
        return max(right - left, SCALE_MM + _ASIDE_MM + (5 + _LETTER_MM * len(NOTE)) * self.text_mm)

    @property
    def sentence(self) -> str:
        """Which way round."""
        return sentence(self.plan.pad.layout.counts, self.plan.settings.pad.leads)

    @cached_property
    def said(self) -> list[str]:
        """Which way round, in lines as long as there is room for."""
        return textwrap.wrap(self.sentence, int(self.room_mm / (_LETTER_MM * self.text_mm)))

    @cached_property
    def notes(self) -> list[Writing]:
        """What is written beside the scale bar and below it."""
        left, x, y = self.bounds[0], self.bounds[0] + SCALE_MM + _ASIDE_MM, self.scale_y + self.text_mm / 4
        beside = [(f"{SCALE_MM:g} mm", x, y), (NOTE, x + 5 * self.text_mm, y)]
        first = self.scale_y - _ASIDE_MM - self.line_mm / 2
        below = [(line, left, first - row * self.line_mm) for row, line in enumerate(self.said)]
        return [Writing(*text, "start", "#555555") for text in (*beside, *below)]
