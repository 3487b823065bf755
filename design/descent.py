"""Gradient search on the expected localisation error under noise and fibre loss.

For presses p_a with signals s_a the ambiguity of a pad whose fibres `kept` still work is

    A = mean_a sum_b w_ab |p_a - p_b|,    w_ab = softmax_b(-|s_a - s_b|^2_kept / (4 sigma^2)),

the mean distance between a press and a place drawn from what its noisy signals leave possible. Averaged over losses
it falls as the conditional entropy H(place | signals) falls, but unlike the published joint entropy it does not
saturate: presses that stay distinguishable still count for how far apart the confusable ones lie.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .differentiable import ExactSignals, pchip_sample, pchip_slopes
from .morphology import MARGIN, Morphology, assemble
from .settings import Contact, Pad, Rules, Search

Array = NDArray[np.float64]

SIDE = 14  # presses per row and column of the stratified sample a step looks at
SAMPLES_PER_UNIT = 108  # of a fibre, for the rules
NOISE = (0.30, 0.06)  # sigma, grid units of signal, annealed from first to last step
RATE = 0.06
PENALTY = (1.0, 300.0)  # weight of the rules, raised from first to last step


@dataclass(frozen=True)
class Step:
    """What a step of a start reports: its number (from 1), the ambiguity and the penalty of the rules."""

    number: int
    ambiguity: float
    penalty: float


class Fibres(torch.nn.Module):
    """Free variables of a pad's fibres, mapped so that knots stay ascending, apart and off the border.

    Travel coordinates are running sums of a softmax with a floor under every span, cross coordinates a sigmoid.
    """

    def __init__(self, pad: Pad, search: Search, rules: Rules, rng: np.random.Generator) -> None:
        super().__init__()
        grid, knots = pad.grid, search.knots
        self.extent = float(grid + 1)
        self.border = max(MARGIN, rules.border_mm / pad.pitch_mm) if rules.enforce else MARGIN
        self.floor = (0.4 if rules.enforce else 0.05) * self.extent / (knots + 1)
        level = np.tile(np.arange(1.0, grid + 1), 2)[:, None]
        spread = 0.5 if rules.enforce else 1.5
        cross = level + spread * rng.standard_normal((2 * grid, knots))
        unit = np.clip((cross - self.border) / (self.extent - 2 * self.border), 0.05, 0.95)
        self.spans = torch.nn.Parameter(torch.tensor(0.3 * rng.standard_normal((2 * grid, knots + 1))))
        self.cross = torch.nn.Parameter(torch.tensor(np.log(unit / (1 - unit))))
        self.register_buffer("level", torch.tensor(level))

    def forward(self) -> tuple[Tensor, Tensor]:
        """Travel and cross coordinates of all knots, ends included, both (2M, N+2)."""
        count = self.spans.shape[1]
        spans = self.floor + (self.extent - count * self.floor) * self.spans.softmax(dim=1)
        start = torch.zeros_like(spans[:, :1])
        travel = torch.cat([start, spans.cumsum(dim=1)[:, :-1], start + self.extent], dim=1)
        level = self.get_buffer("level")
        cross = self.border + (self.extent - 2 * self.border) * self.cross.sigmoid()
        return travel, torch.cat([level, cross, level], dim=1)

    def knots(self) -> Array:
        """(2M, N+2, 2) knots as `Morphology` holds them."""
        with torch.no_grad():
            travel, cross = (x.numpy() for x in self())
        grid = len(travel) // 2
        inner = np.stack([travel, cross], axis=-1)[:, 1:-1]
        inner[grid:] = inner[grid:, :, ::-1]
        return assemble(inner)


def ambiguity(signals: Tensor, presses: Tensor, kept: Tensor, sigma: float) -> Tensor:
    """A of the module's formula, averaged over losses.

    Args:
        signals: (2M, Q). presses: (Q, 2). kept: (L, 2M), 1 for a fibre that works, 0 for a lost one.
        sigma: noise of a signal, grid units.
    """
    difference = (signals[:, :, None] - signals[:, None, :]) ** 2
    apart = (kept @ difference.flatten(1)).view(len(kept), *difference.shape[1:])
    weight = torch.softmax(-apart / (4 * sigma**2), dim=-1)
    return (weight * torch.cdist(presses, presses)).sum(dim=-1).mean()


def penalty(curve: Tensor, slope: Tensor, step: float, pad: Pad, rules: Rules) -> Tensor:
    """How far sampled fibres break the rules on gap, bend, border and length: 0 where all hold with a small margin.

    Args:
        curve, slope: (2M, F) cross coordinates and slopes at travel 0, step, ...; grid units.
    """
    grid = len(curve) // 2
    stretch = torch.sqrt(1 + slope**2)
    gap = 1.15 * rules.min_gap_mm / pad.pitch_mm
    families = curve.view(2, grid, -1)
    steepest = torch.maximum(stretch.view(2, grid, -1)[:, 1:], stretch.view(2, grid, -1)[:, :-1])
    closeness = torch.relu(gap - families.diff(dim=1) / steepest) / gap if gap > 0 else torch.zeros(1)
    heading = torch.atan(slope)
    turn = heading.diff(dim=-1).abs()
    arc = step * (stretch[:, 1:] + stretch[:, :-1]) / 2
    radius = 1.15 * rules.min_bend_radius_mm / pad.pitch_mm
    bend = torch.relu(turn * radius / arc - 1)
    zone = max(1, round(rules.border_mm / pad.pitch_mm / step))  # by its own wall a fibre leaves at 45 degrees or less
    hugging = torch.relu(torch.cat([slope[:, :zone], slope[:, -zone:]], dim=1).abs() - 1)
    length = torch.relu((step * stretch).sum(dim=1) * pad.pitch_mm / rules.max_length_mm - 1)
    return closeness.mean() + (closeness**2).mean() * 10 + bend.mean() + hugging.mean() / 10 + length.mean()


def descend(
    start: int,
    pad: Pad,
    contact: Contact,
    search: Search,
    rules: Rules,
    report: Callable[[Step], bool] = lambda step: True,
) -> Morphology:
    """One start of the gradient search: Adam with annealed noise and rising penalties.

    The same start of the same seed gives the same fibres, whichever other starts run. Where `report`, which hears of
    every step, answers False, the start ends with the fibres it has.
    """
    rng = np.random.default_rng([search.seed, start])
    fibres = Fibres(pad, search, rules, rng)
    optimiser = torch.optim.Adam(fibres.parameters(), lr=RATE)
    extent = pad.grid + 1
    samples = SAMPLES_PER_UNIT * extent + 1
    at = torch.linspace(0, extent, samples, dtype=torch.float64)
    for number in range(search.steps):
        progress = number / max(1, search.steps - 1)
        sigma, weight = (_anneal(*ends, progress) for ends in (NOISE, PENALTY))
        for group in optimiser.param_groups:
            group["lr"] = RATE * (0.02 + 0.98 * (1 + math.cos(math.pi * progress)) / 2)
        places = _stratified(pad.grid, rng)
        kept = torch.tensor(_losses(2 * pad.grid, search.lost, rng), dtype=torch.float32)
        travel, cross = fibres()
        signals = ExactSignals.apply(travel, cross, pchip_slopes(travel, cross), places, contact)
        spread = ambiguity(signals.float(), torch.tensor(places, dtype=torch.float32), kept, sigma)
        broken = torch.zeros(())
        if rules.enforce:
            broken = penalty(*pchip_sample(travel, cross, at), extent / (samples - 1), pad, rules)
        optimiser.zero_grad()
        (spread + weight * broken).backward()
        optimiser.step()
        if not report(Step(number + 1, spread.item(), broken.item())):
            break
    return Morphology(fibres.knots(), pad.pitch_mm)


def _anneal(first: float, last: float, progress: float) -> float:
    """From the first value to the last along a geometric path."""
    return first * (last / first) ** progress


def _stratified(grid: int, rng: np.random.Generator) -> Array:
    """One press in each of SIDE x SIDE cells over 1..M, (SIDE^2, 2)."""
    corner = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2)
    return 1 + (grid - 1) * (corner + rng.random(corner.shape)) / SIDE


def _losses(fibres: int, lost: int, rng: np.random.Generator) -> Array:
    """Masks (L, 2M) of fibres that still work: none lost, then two random losses of every number up to `lost`."""
    kept = np.ones((1 + 2 * min(lost, fibres - 1), fibres))
    for row in range(1, len(kept)):
        kept[row, rng.choice(fibres, (row + 1) // 2, replace=False)] = 0
    return kept
