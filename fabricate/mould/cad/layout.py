"""Which part of a mould fills every cell of its drawing, from what height to what height.

Parts touch and do not overlap: tracks and numbers stand on the tray, and where tracks cross the taller one goes
through. Lengths are mm, z = 0 is the underside of the tray.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.mould import parts
from padforge.fabricate.mould.plan import Plan

from .outlines.drawing import GRID_MM, Drawing
from .outlines.joints import joints, with_joints
from .outlines.pieces import FINE_MM, Piece, outline_pieces, straight_pieces
from .walls import FLOOR, RIM, Walls, walls_of

Surface = float | tuple[Walls, int]
"""A height, mm, or one of the walls' planes."""
TRAY, HORIZONTAL, VERTICAL, NUMBERS = PARTS = ("tray", "horizontal tracks", "vertical tracks", "numbers")


class Span(NamedTuple):
    """What bounds a part below and above."""

    bottom: Surface
    top: Surface


@dataclass(frozen=True)
class Part:
    """A named part: of every cell of the drawing what it fills, None for nothing."""

    name: str
    spans: Sequence[Span | None]


class _Standing(NamedTuple):
    """What stands on the floor: of which part, up to where, and its outline."""

    part: str
    top_mm: float
    outline: BaseGeometry
    pieces: list[Piece]


def layout(plan: Plan, fit_mm: float, wells: Sequence[BaseGeometry] = ()) -> tuple[Drawing, list[Part]]:
    """The drawing of a mould and its parts.

    Args:
        fit_mm: how near splines stay to the finely drawn outlines.
        wells: outlines that belong to the ridges of each level; none for a pad whose fibres are laid.
    """
    walls = walls_of(plan)
    rim_mm = walls.floor_mm + walls.depth_mm
    standing = sorted([*_ridges(plan, fit_mm, wells), *_numbers(plan)], key=lambda each: -each.top_mm)
    opened = [walls.outline(z).boundary for z in sorted({*(each.top_mm for each in standing), rim_mm})]
    straight = [plan.tray.boundary, *opened, *walls.creases(), plan.pillars.boundary]
    pieces = [piece for line in straight for piece in straight_pieces(line)]
    pieces += [piece for each in standing for piece in each.pieces]
    drawing = Drawing([*straight, *(each.outline.boundary for each in standing)], pieces)

    sheets = walls.sheets(drawing.middles).tolist()
    under: list[Surface] = [walls.floor_mm if k == FLOOR else rim_mm if k == RIM else (walls, k) for k in sheets]
    heights = walls.heights(drawing.middles)
    for cell in np.flatnonzero(shapely.contains_xy(plan.pillars, drawing.middles)):
        under[cell] = heights[cell] = rim_mm
    spans: dict[str, list[Span | None]] = {name: [None] * len(under) for name in PARTS}
    free = np.ones(len(under), dtype=bool)
    for each in standing:
        shapely.prepare(each.outline)
        for cell in np.flatnonzero(free & shapely.contains_xy(each.outline, drawing.middles) & (heights < each.top_mm)):
            spans[each.part][cell] = Span(under[cell], each.top_mm)
            free[cell] = False
    for cell in np.flatnonzero(shapely.contains_xy(plan.tray, drawing.middles)):
        spans[TRAY][cell] = Span(0.0, under[cell])
    for thin, beside in drawing.thin().items():
        for each in spans.values():
            each[thin] = each[beside]
    return drawing, [Part(name, each) for name, each in spans.items() if any(each)]


def _ridges(plan: Plan, fit_mm: float, wells: Sequence[BaseGeometry]) -> Iterator[_Standing]:
    """The terraces of the ridges of every level."""
    families = {level: plan.family(fibre) for fibre, level in enumerate(plan.levels)}
    for level, height_mm in enumerate(plan.heights_mm):
        for down_mm in parts.terraces(height_mm, plan.settings.terrace_mm):
            outline = plan.outline(level, down_mm, FINE_MM)
            if wells and not down_mm:
                outline = shapely.union_all([outline, wells[level]], grid_size=GRID_MM)
            at = joints(plan, level, plan.settings.mould.ridge_width_mm / 2 + down_mm * plan.settings.ridge_slope)
            outline = with_joints(outline, at)
            top = plan.settings.mould.floor_mm + height_mm - down_mm
            yield _Standing(
                (HORIZONTAL, VERTICAL)[families[level]],
                top,
                outline,
                outline_pieces(outline, at, (plan.settings.mould.floor_mm, top), fit_mm),
            )


def _numbers(plan: Plan) -> Iterator[_Standing]:
    top = plan.settings.mould.floor_mm + plan.settings.mould.shallow_ridge_height_mm
    for outline in plan.numbers:
        if outline is not None:
            yield _Standing(NUMBERS, top, outline, straight_pieces(outline.boundary))


def contact_mm2(drawing: Drawing, parts: Sequence[Part]) -> float:
    """The area where parts touch each other: undersides of what stands, crossings, ends at upright walls."""
    area = 0.0
    owner = np.full(len(drawing.cells) + 1, -1)  # the last stands for no cell
    low, top = np.zeros(len(owner)), np.zeros(len(owner))
    for number, part in enumerate(sorted(parts, key=lambda part: part.name != TRAY)):  # what stands on it hides it
        for cell, span in enumerate(part.spans):
            if span is not None:
                owner[cell], low[cell], top[cell] = number, _level(span.bottom), _level(span.top)
                if part.name != TRAY:
                    lean = math.hypot(*span.bottom[0].normal(span.bottom[1])) if isinstance(span.bottom, tuple) else 1.0
                    area += lean * drawing.cells[cell].area
    between = (owner[drawing.sides] >= 0).all(axis=1) & (owner[drawing.sides[:, 0]] != owner[drawing.sides[:, 1]])
    (left, right), edges = drawing.sides[between].T, np.array(drawing.edges, dtype=float)[between]
    long = GRID_MM * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    return area + float(long @ np.maximum(0, np.minimum(top[left], top[right]) - np.maximum(low[left], low[right])))


def _level(surface: Surface) -> float:
    """The height of a surface, mm; of a leaning wall its foot."""
    return surface[0].floor_mm if isinstance(surface, tuple) else surface
