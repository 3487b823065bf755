"""The rules of `[rules]` as differentiable penalties: 0 where a rule holds with a margin, and growing with the breach.

Each has the unit of a share of its limit, averaged over the pad, so that they add. What counts is the exact check on
the finished curves (`rules`); these are what leads there. A rule whose limit cannot be met or missed is not computed.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from design.common.errors import InputError
from design.settings import PadSettings, RulesSettings

from .differentiable import pchip_sample, span_samples

PER_SPAN = 12
ORDER_PER_UNIT = 40
BLUR = 0.1  # standard deviation of the mollified crossing count, grid units
MOST_PAIRS = 10**8  # of samples that are compared at once: some GB


@dataclass(frozen=True)
class SampledCurves:
    """Fibres sampled densely: places (2M, P, 2) along their travel and cross axes, slopes and arc lengths (2M, P)."""

    place: Tensor
    slope: Tensor
    arc: Tensor

    @property
    def share(self) -> Tensor:
        """(2M, P) arc length that belongs to each sample, without gradient."""
        step = self.arc.detach().diff(dim=1) / 2
        return torch.nn.functional.pad(step, (1, 0)) + torch.nn.functional.pad(step, (0, 1))

    def take(self, fibres: list[int]) -> "SampledCurves":
        """Those of some fibres."""
        return SampledCurves(self.place[fibres], self.slope[fibres], self.arc[fibres])


def penalties(
    travel: Tensor, cross: Tensor, pad: PadSettings, rules: RulesSettings, margin: float = 1.0
) -> dict[str, Tensor]:
    """A penalty by name of each rule that may be broken, scalars with gradient by the knots.

    Args:
        travel, cross: (2M, N+2) coordinates of the knots, grid units.
        margin: factor on the limits, so that a curve whose penalty is 0 also passes the exact check.

    Raises:
        InputError: so many fibres, of so many knots, that comparing their samples would not fit into memory.
    """
    pitch = pad.pitch_mm
    place, slope = span_samples(travel, cross, PER_SPAN)
    step = torch.linalg.vector_norm(place.diff(dim=1), dim=-1)
    fibres = SampledCurves(place, slope, torch.nn.functional.pad(step.cumsum(dim=1), (1, 0)))
    radius, gap = margin * rules.min_bend_radius_mm / pitch, margin * rules.min_gap_mm / pitch
    found = {}
    if radius > 0:
        found["min_bend_radius_mm"] = _bend(fibres, radius, rules.min_bend_radius_mm / pitch / 2)
    if gap > 0 and pad.grid > 1:
        found["min_gap_mm"] = _gap(fibres, gap)
    if gap > radius:  # else fibres that bend by the rule keep their folds apart
        found["folds"] = _folds(fibres, gap)
    if pad.grid > 1:
        if rules.same_family_crossings == 0:
            found["same_family_crossings"] = _disorder(travel, cross, max(gap, 0.01))
        else:
            found["same_family_crossings"] = _too_many(_family_crossings(fibres), rules.same_family_crossings / margin)
    if rules.max_crossings is not None or rules.min_crossing_angle_deg > 0:
        limit = math.radians(margin * rules.min_crossing_angle_deg)
        count, flat = _crossings(fibres, limit)
        if rules.max_crossings is not None:
            found["max_crossings"] = _too_many(count, rules.max_crossings / margin)
        if limit > 0:
            found["min_crossing_angle_deg"] = flat / pad.grid
    if rules.border_mm > 0:
        found["border_mm"] = _hugging(fibres, rules.border_mm / pitch)
    found["max_length_mm"] = torch.relu(fibres.arc[:, -1] * pitch * margin / rules.max_length_mm - 1).mean()
    return found


def _bend(fibres: SampledCurves, radius: float, window: float) -> Tensor:
    """How much more than window / radius a fibre turns within `window` of arc, as a share of that angle."""
    turned = torch.atan(fibres.slope).diff(dim=1).abs().cumsum(dim=1)
    turned = torch.nn.functional.pad(turned, (1, 0))
    until = fibres.arc + window
    after = torch.searchsorted(fibres.arc.detach(), until.detach()).clamp(1, until.shape[1] - 1)
    a0, a1, t0, t1 = (x.gather(1, i) for x in (fibres.arc, turned) for i in (after - 1, after))
    angle = t0 + ((until - a0) / (a1 - a0)).clamp(0, 1) * (t1 - t0) - turned
    over = torch.relu(angle * radius / window - 1)
    return (over * fibres.share).sum(dim=1).mean() / fibres.place[0, -1, 0].detach()


def _gap(fibres: SampledCurves, gap: float) -> Tensor:
    """How much nearer than `gap` neighbours in a family come, as a share of it."""
    grid = len(fibres.place) // 2
    _require_room(2 * grid, fibres.arc.shape[1])
    below = [f for f in range(2 * grid) if f % grid < grid - 1]
    lower, upper = fibres.take(below), fibres.take([f + 1 for f in below])
    distances = torch.cdist(lower.place.detach().float(), upper.place.detach().float())
    near = [_near(lower.place, upper, distances, gap), _near(upper.place, lower, distances.mT, gap)]
    return _closeness(torch.cat(near), gap) / fibres.arc.numel()


def _folds(fibres: SampledCurves, gap: float) -> Tensor:
    """How much nearer than `gap` a fibre comes to a part of itself that is pi / 2 gaps or more away along it."""
    _require_room(*fibres.arc.shape)
    arc = fibres.arc.detach().float()
    place = fibres.place.detach().float()
    alongside = (arc[:, :, None] - arc[:, None, :]).abs() < math.pi / 2 * gap
    distances = torch.cdist(place, place).masked_fill(alongside, math.inf)
    return _closeness(_near(fibres.place, fibres, distances, gap), gap) / fibres.arc.numel()


def _near(place: Tensor, other: SampledCurves, distances: Tensor, gap: float) -> Tensor:
    """Distances (K,) to `other` of those places (B, P, 2) that may be nearer than `gap`, given all (B, P, P).

    They are measured to the piece of tangent the nearest sample stands for, which reaches up to half a step beyond it.
    """
    reach = other.share.max().item()
    fibre, sample = (distances.amin(dim=2) < gap + reach).nonzero(as_tuple=True)
    nearest = distances[fibre, sample].argmin(dim=1)
    slope = other.slope.detach()[fibre, nearest]
    tangent = torch.nn.functional.normalize(torch.stack([torch.ones_like(slope), slope], dim=-1), dim=-1)
    away = place[fibre, sample] - other.place[fibre, nearest]
    along = (away.detach() * tangent).sum(dim=-1, keepdim=True)
    bound = other.share[fibre, nearest][:, None]
    return torch.linalg.vector_norm(away - along.clamp(-bound, bound) * tangent + 1e-12, dim=-1)


def _closeness(near: Tensor, gap: float) -> Tensor:
    close = torch.relu(1 - near / gap)
    return (close + 10 * close**2).sum()


def _disorder(travel: Tensor, cross: Tensor, least: float) -> Tensor:
    """How much less than `least` a fibre lies above its lower neighbour in the family, as a share of it."""
    grid = len(travel) // 2
    at = torch.linspace(0, grid + 1, ORDER_PER_UNIT * (grid + 1) + 1, dtype=torch.float64)
    above = pchip_sample(travel, cross, at)[0].unflatten(0, (2, grid)).diff(dim=1)
    return _closeness(above, least) / above.numel()


def _too_many(count: Tensor, limit: float) -> Tensor:
    return torch.relu(count - limit) / max(1.0, limit)


def _family_crossings(fibres: SampledCurves) -> Tensor:
    """Soft number of crossings within the families."""
    grid = len(fibres.place) // 2
    _require_room(grid * (grid - 1), fibres.arc.shape[1])
    pairs = [(f, g) for f in range(2 * grid) for g in range(f + 1, grid * (f // grid + 1))]
    first, second = (fibres.place[list(side)] for side in zip(*pairs, strict=True))
    return _mollified(first, second, 0.0)[0]


def _crossings(fibres: SampledCurves, limit: float) -> tuple[Tensor, Tensor]:
    """Soft number of horizontal x vertical crossings, and of those flatter than `limit` radians, by how much."""
    grid = len(fibres.place) // 2
    _require_room(grid**2, fibres.arc.shape[1])
    pairs = [(f, g) for f in range(grid) for g in range(grid, 2 * grid)]
    horizontal, vertical = (fibres.place[list(side)] for side in zip(*pairs, strict=True))
    return _mollified(horizontal, vertical.flip(-1), limit)


def _mollified(p: Tensor, q: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Number of crossings of polylines p and q (B, P, 2) pair by pair, with a gradient.

    By Kac and Rice it is the sum of |dp x dq| delta(p - q), with a narrow Gaussian for delta. Also the same sum
    weighted by how far the angle falls short of `limit`, as a share of it.
    """
    dp, dq = p.diff(dim=1)[:, :, None], q.diff(dim=1)[:, None]
    apart = (p[:, 1:] + p[:, :-1])[:, :, None] / 2 - (q[:, 1:] + q[:, :-1])[:, None] / 2
    area = (dp[..., 0] * dq[..., 1] - dp[..., 1] * dq[..., 0]).abs()
    here = area * torch.exp((apart**2).sum(dim=-1) / (-2 * BLUR**2)) / (2 * math.pi * BLUR**2)
    if limit == 0:
        return here.sum(), here.new_zeros(())
    sine = area / (torch.linalg.vector_norm(dp, dim=-1) * torch.linalg.vector_norm(dq, dim=-1) + 1e-12)
    return here.sum(), (here * torch.relu(1 - torch.asin(sine.clamp(max=1 - 1e-9)) / limit)).sum()


def _require_room(fibres: int, samples: int) -> None:
    """Refuse to compare all `samples` of so many fibres, or pairs of them, where that takes too much memory."""
    if fibres * samples**2 > MOST_PAIRS:
        raise InputError(
            f"the rules take {fibres * samples**2} comparisons for so many fibres and knots, allowed are {MOST_PAIRS}; "
            "take fewer, or no limit on crossings"
        )


def _hugging(fibres: SampledCurves, zone: float) -> Tensor:
    """How steeper than 45 degrees fibres run in the `zone` by the wall they come from."""
    travel = fibres.place[..., 0].detach()
    edge = (travel < zone) | (travel > travel[0, -1] - zone)
    return (torch.relu(fibres.slope.abs() - 1) * edge * fibres.share).sum(dim=1).mean() / travel[0, -1]
