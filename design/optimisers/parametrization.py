"""A pad's fibres as free variables of the gradient search, and the courses it starts from."""

import numpy as np
import torch
from padforge.design.pad.courses.curves import refine
from padforge.design.pad.courses.passing import passing, straight_course
from padforge.design.pad.knots import MARGIN, Array, assemble, axes, kernel_ends
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Layout, PadSettings, RulesSettings
from torch import Tensor

KNOTS_PER_TURN = 3  # before, at and after: a turn of given radius needs its shoulders
OTHER_START = 3  # the last of the default's
MOVED = 0.1  # standard deviation of knots that are moved off a straight course or an origin, grid units
WIDEST_BORDER = 0.45  # of the pad's side: a wider border leaves no room, which the rule check then says


class Fibres:
    """Free variables of a pad's fibres, mapped so that knots stay ascending, apart and off the border.

    Travel coordinates are running sums of a softmax with a floor under every span, cross coordinates a sigmoid.

    Attributes:
        layout: where they end.
        spans: (F, N+1) logits of the spans. cross: (F, N) logits of the cross coordinates; leaves with gradient.
        floor: least span, grid units. border: least cross distance of a knot to the border, grid units.
    """

    def __init__(self, layout: Layout, spans: Tensor, cross: Tensor, floor: float, border: float) -> None:
        self.layout, self.floor, self.border = layout, floor, border
        self.spans, self.cross = (x.detach().clone().requires_grad_() for x in (spans, cross))
        self.ends = kernel_ends(layout)
        along, across = _sides(layout)
        self._along, self._across, self._level = (
            torch.tensor(each)[:, None] for each in (along, across, layout.levels)
        )

    @classmethod
    def through(cls, knots: Array, layout: Layout, border: float) -> "Fibres":
        """Variables of the fibres through knots (F, N+2, 2); knots within `border` of the border are moved off."""
        travel, across = (axis[0] for axis in axes(knots[None], layout.horizontals))
        width = np.diff(travel, axis=1)
        floor = min(0.1 * min(layout.extent) / (knots.shape[1] - 1), 0.5 * float(width.min()))
        unit = np.clip((across[:, 1:-1] - border) / (_sides(layout)[1][:, None] - 2 * border), 0.005, 0.995)
        spans, cross = np.log(width - floor), np.log(unit / (1 - unit))
        return cls(layout, torch.tensor(spans), torch.tensor(cross), floor, border)

    def axes(self) -> tuple[Tensor, Tensor]:
        """Travel and cross coordinates of all knots, ends included, both (F, N+2)."""
        count = self.spans.shape[1]
        width = self.floor + (self._along - count * self.floor) * self.spans.softmax(dim=1)
        start = torch.zeros_like(width[:, :1])
        travel = torch.cat([start, width.cumsum(dim=1)[:, :-1], start + self._along], dim=1)
        cross = self.border + (self._across - 2 * self.border) * self.cross.sigmoid()
        return travel, torch.cat([self._level, cross, self._level], dim=1)

    def knots(self) -> Array:
        """(F, N+2, 2) knots as `Morphology` holds them."""
        with torch.no_grad():
            travel, cross = (x.numpy() for x in self.axes())
        inner = np.stack([travel, cross], axis=-1)[:, 1:-1]
        inner[self.layout.horizontals :] = inner[self.layout.horizontals :, :, ::-1]
        return assemble(inner, self.layout)


def _sides(layout: Layout) -> tuple[Array, Array]:
    """(F,) length of the pad along each fibre, and across it, grid units."""
    along = np.repeat(layout.extent, layout.counts)
    return along, np.repeat(layout.extent[::-1], layout.counts)


def border_of(pad: PadSettings, rules: RulesSettings) -> float:
    """Least cross distance of a knot to the border, grid units."""
    wanted = rules.border_mm / pad.layout.unit_mm if rules.enforce else 0.0
    return min(max(MARGIN, wanted), WIDEST_BORDER * min(pad.layout.extent))


def first_course(
    pad: PadSettings,
    rules: RulesSettings,
    knots: int,
    origin: Morphology | None,
    start: int,
    rng: np.random.Generator,
    gentle: bool = True,
) -> Array:
    """Draw the knots (F, N+2, 2) that a start of the search begins with.

    Without an origin most starts have straight fibres with knots moved by a tenth of a grid unit or so: where slopes
    are 0 to both sides of a knot, PCHIP keeps them there and has no gradient to follow. Start 3 has a zigzag; where
    `gentle` does not hold, as under a contact that is felt alike up to its edge, it is the other way round. With an
    origin, start 0 has its very course, later ones have it with knots moved. All pass by keep-outs.

    Args:
        pad, rules: to be kept to.
        knots: N, inside of each fibre.
        origin: to start from.
        start: number of the start.
        rng: of the start.
        gentle: whether fibres that are hardly curved mostly lead to the better pad.
    """
    layout = pad.layout
    if origin is None and (start == OTHER_START) == gentle:
        return passing(_zigzag(layout, rules, knots, rng), pad, rules)
    refined = straight_course(pad, rules, knots) if origin is None else refine(origin.knots, knots, layout)
    if origin is not None and start == 0 and len(origin.knots[0]) > 2:
        return refined
    inner = refined[:, 1:-1] + MOVED * rng.standard_normal(refined[:, 1:-1].shape)
    return assemble(np.clip(inner, MARGIN, np.array(layout.extent) - MARGIN), layout)


def _zigzag(layout: Layout, rules: RulesSettings, knots: int, rng: np.random.Generator) -> Array:
    """A random zigzag each family runs side by side: nothing crosses within a family, and every turn is round.

    PCHIP has slope 0 at a turn, so that one knot alone bends sharper the higher the flanks; with shoulders
    beside it the flanks may be as steep as they like.
    """
    radius = rules.min_bend_radius_mm / layout.unit_mm if rules.enforce else 0.0
    per_turn = KNOTS_PER_TURN if radius > 0 and knots >= 2 * KNOTS_PER_TURN else 1
    along = [extent for extent, count in zip(layout.extent, layout.counts, strict=True) if count]
    most = max(1, int(min(along) / (4 * radius))) if radius > 0 else knots
    turns = max(1, min(knots // per_turn, most))
    fibres = []
    for axis, rows in enumerate(layout.families):
        width, pitch, level = layout.extent[1 - axis], layout.extent[axis] / (turns + 1), layout.levels[rows, None]
        shoulder = float(np.clip(0.8 * radius, 0.1 * pitch, 0.25 * pitch))
        along = pitch * (np.arange(1, turns + 1) + 0.12 * rng.standard_normal(turns))
        side = np.where(np.arange(turns) % 2 == 0, 1, -1) * rng.choice([-1, 1])
        swing = 0.6 * side * rng.uniform(0.5, 1.2, turns)
        short = min(1.0, layout.extent[axis] / width)  # fibres shorter than the pad is wide have less room to turn
        towards = width / 2 + (1 - 0.3 * short) * (level - width / 2)
        peak = towards + short * swing + 0.1 * rng.standard_normal((len(level), turns))
        peak = np.sort(peak, axis=0)
        turn = np.sort(along + 0.02 * rng.standard_normal((len(level), turns)), axis=1)
        whole = np.concatenate([level, peak, level], axis=1)
        drop = np.clip(0.12 * np.stack([peak - whole[:, :-2], peak - whole[:, 2:]]), -0.1, 0.1)
        parts = [(turn - shoulder, peak - drop[0]), (turn, peak), (turn + shoulder, peak - drop[1])]
        chosen = parts if per_turn == KNOTS_PER_TURN else parts[1:2]
        travel, cross = (
            np.stack([part[i] for part in chosen], axis=-1).reshape(len(level), turns * len(chosen)) for i in (0, 1)
        )
        fibres.append(np.stack([travel, cross] if axis == 0 else [cross, travel], axis=-1))
    inner = np.clip(np.concatenate(fibres), 0.02, np.array(layout.extent) - 0.02)
    return refine(assemble(inner, layout), knots, layout)
