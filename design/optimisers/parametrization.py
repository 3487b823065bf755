"""A pad's fibres as free variables of the gradient search, and the courses it starts from."""

import numpy as np
import torch
from torch import Tensor

from design.pad.courses.curves import refine
from design.pad.knots import MARGIN, Array, assemble
from design.pad.morphology import Morphology
from design.settings import PadSettings, RulesSettings

KNOTS_PER_TURN = 3  # before, at and after: a turn of given radius needs its shoulders
STRAIGHT_START = 3  # the last of the default's: zigzags more often lead to the better pad
WIDEST_BORDER = 0.45  # of the pad's side: a wider border leaves no room, which the rule check then says


class Fibres:
    """Free variables of a pad's fibres, mapped so that knots stay ascending, apart and off the border.

    Travel coordinates are running sums of a softmax with a floor under every span, cross coordinates a sigmoid.

    Attributes:
        spans: (2M, N+1) logits of the spans. cross: (2M, N) logits of the cross coordinates; leaves with gradient.
        floor: least span, grid units. border: least cross distance of a knot to the border, grid units.
    """

    def __init__(self, spans: Tensor, cross: Tensor, floor: float, border: float) -> None:
        self.spans, self.cross = (x.detach().clone().requires_grad_() for x in (spans, cross))
        self.floor, self.border = floor, border
        grid = len(spans) // 2
        self.extent = float(grid + 1)
        self.level = torch.arange(1, grid + 1, dtype=torch.float64).repeat(2)[:, None]

    @classmethod
    def through(cls, knots: Array, border: float) -> "Fibres":
        """Variables of the fibres through knots (2M, N+2, 2); knots within `border` of the border are moved off."""
        grid, count = len(knots) // 2, knots.shape[1] - 1
        extent = grid + 1.0
        travel = np.concatenate([knots[:grid, :, 0], knots[grid:, :, 1]])
        across = np.concatenate([knots[:grid, 1:-1, 1], knots[grid:, 1:-1, 0]])
        width = np.diff(travel, axis=1)
        floor = min(0.1 * extent / count, 0.5 * float(width.min()))
        unit = np.clip((across - border) / (extent - 2 * border), 0.005, 0.995)
        return cls(torch.tensor(np.log(width - floor)), torch.tensor(np.log(unit / (1 - unit))), floor, border)

    def axes(self) -> tuple[Tensor, Tensor]:
        """Travel and cross coordinates of all knots, ends included, both (2M, N+2)."""
        count = self.spans.shape[1]
        width = self.floor + (self.extent - count * self.floor) * self.spans.softmax(dim=1)
        start = torch.zeros_like(width[:, :1])
        travel = torch.cat([start, width.cumsum(dim=1)[:, :-1], start + self.extent], dim=1)
        cross = self.border + (self.extent - 2 * self.border) * self.cross.sigmoid()
        return travel, torch.cat([self.level, cross, self.level], dim=1)

    def knots(self) -> Array:
        """(2M, N+2, 2) knots as `Morphology` holds them."""
        with torch.no_grad():
            travel, cross = (x.numpy() for x in self.axes())
        grid = len(travel) // 2
        inner = np.stack([travel, cross], axis=-1)[:, 1:-1]
        inner[grid:] = inner[grid:, :, ::-1]
        return assemble(inner)


def border_of(pad: PadSettings, rules: RulesSettings) -> float:
    """Least cross distance of a knot to the border, grid units."""
    wanted = rules.border_mm / pad.pitch_mm if rules.enforce else 0.0
    return min(max(MARGIN, wanted), WIDEST_BORDER * (pad.grid + 1))


def first_course(
    pad: PadSettings, rules: RulesSettings, knots: int, origin: Morphology | None, start: int, rng: np.random.Generator
) -> Array:
    """Knots (2M, N+2, 2) a start of the search begins with.

    Without an origin each start has its own zigzag, but start 3, which has straight fibres. With one, start 0 has its
    very course, later ones have it with knots moved by a tenth of a grid unit or so. So are those of straight fibres:
    where slopes are 0 to both sides of a knot, PCHIP keeps them there and has no gradient to follow.
    """
    if origin is None and start == STRAIGHT_START:
        origin = Morphology.straight(pad.grid)
    if origin is None:
        return _zigzag(pad, rules, knots, rng)
    refined = refine(origin.knots, knots)
    if start == 0 and len(origin.knots[0]) > 2:
        return refined
    inner = refined[:, 1:-1] + 0.1 * rng.standard_normal(refined[:, 1:-1].shape)
    return assemble(np.clip(inner, MARGIN, pad.grid + 1 - MARGIN))


def nearly_straight(grid: int, knots: int, rng: np.random.Generator) -> Array:
    """Knots (2M, N+2, 2) of straight fibres, moved crosswise by a tenth of a grid unit or so."""
    course = refine(Morphology.straight(grid).knots, knots)
    crosswise = 0.1 * rng.standard_normal(course[:, 1:-1, 0].shape)
    inner = course[:, 1:-1].copy()
    inner[:grid, :, 1] += crosswise[:grid]
    inner[grid:, :, 0] += crosswise[grid:]
    return assemble(np.clip(inner, MARGIN, grid + 1 - MARGIN))


def _zigzag(pad: PadSettings, rules: RulesSettings, knots: int, rng: np.random.Generator) -> Array:
    """A random zigzag each family runs side by side: nothing crosses within a family, and every turn is round.

    PCHIP has slope 0 at a turn, so that one knot alone bends sharper the higher the flanks; with shoulders
    beside it the flanks may be as steep as they like.
    """
    grid, extent = pad.grid, pad.grid + 1.0
    radius = rules.min_bend_radius_mm / pad.pitch_mm if rules.enforce else 0.0
    most = max(1, int(extent / (4 * radius))) if radius > 0 else knots
    per_turn = KNOTS_PER_TURN if radius > 0 and knots >= 2 * KNOTS_PER_TURN else 1
    turns = max(1, min(knots // per_turn, most))
    pitch = extent / (turns + 1)
    shoulder = float(np.clip(0.8 * radius, 0.1 * pitch, 0.25 * pitch))
    level = np.arange(1.0, grid + 1)[:, None]
    fibres = []
    for _ in range(2):
        along = pitch * (np.arange(1, turns + 1) + 0.12 * rng.standard_normal(turns))
        side = np.where(np.arange(turns) % 2 == 0, 1, -1) * rng.choice([-1, 1])
        swing = 0.6 * side * rng.uniform(0.5, 1.2, turns)
        peak = extent / 2 + 0.7 * (level - extent / 2) + swing + 0.1 * rng.standard_normal((grid, turns))
        peak = np.sort(peak, axis=0)
        turn = np.sort(along + 0.02 * rng.standard_normal((grid, turns)), axis=1)
        whole = np.concatenate([level, peak, level], axis=1)
        drop = np.clip(0.12 * np.stack([peak - whole[:, :-2], peak - whole[:, 2:]]), -0.1, 0.1)
        parts = [(turn - shoulder, peak - drop[0]), (turn, peak), (turn + shoulder, peak - drop[1])]
        chosen = parts if per_turn == KNOTS_PER_TURN else parts[1:2]
        travel, cross = (np.stack([part[i] for part in chosen], axis=-1).reshape(grid, -1) for i in (0, 1))
        fibres.append(np.stack([travel, cross] if len(fibres) == 0 else [cross, travel], axis=-1))
    inner = np.clip(np.concatenate(fibres), 0.02, extent - 0.02)
    return refine(assemble(inner), knots)
