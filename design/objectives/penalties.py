"""The rules of `[rules]` as differentiable penalties: 0 where a rule holds with a margin, and growing with the breach.

Each has the unit of a share of its limit, averaged over the pad, so that they add. What counts is the exact check on
the finished curves (`rules`); these are what leads there. A rule whose limit cannot be met or missed is not computed.
"""

import math
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import shapely
import torch
from torch import Tensor

from padforge.design.common.validation import InputError
from padforge.design.kernels.geometry import sum_overlaps
from padforge.design.paths.curves import common_stretches
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import TRACK_WIDTH_MM, Layout, PadSettings, RulesSettings
from padforge.design.torch_signals import pchip_sample, span_samples

PER_SPAN = 12
ORDER_PER_UNIT = 40
BLUR = 0.1  # standard deviation of the mollified crossing count, grid units
LEAST_CLEARANCE = 0.1  # from keep-outs, grid units, of which what comes nearer is a share
FIBRES_AT_ONCE = 32  # that are sampled for their order
COMMON = 0.2  # of what two tracks have in common: with all of it the search keeps fibres apart that may cross
MOST_PAIRS = 10**8  # of samples that are compared at once: some GB


@dataclass(frozen=True)
class SampledCurves:
    """Fibres sampled densely: places (F, P, 2) along their travel and cross axes, slopes and arc lengths (F, P)."""

    place: Tensor
    slope: Tensor
    arc: Tensor

    @property
    def travelled(self) -> Tensor:
        """How far fibres run along their travel axes, on average."""
        return self.place[:, -1, 0].detach().mean()

    @property
    def share(self) -> Tensor:
        """(F, P) arc length that belongs to each sample, without gradient."""
        return _shares(self.arc)

    def take(self, fibres: list[int]) -> "SampledCurves":
        """Those of some fibres."""
        return SampledCurves(self.place[fibres], self.slope[fibres], self.arc[fibres])


def _shares(arc: Tensor) -> Tensor:
    """(F, P) how much of arc lengths (F, P) belongs to each, without gradient."""
    step = arc.detach().diff(dim=1) / 2
    return torch.nn.functional.pad(step, (1, 0)) + torch.nn.functional.pad(step, (0, 1))


def penalties(
    travel: Tensor, cross: Tensor, pad: PadSettings, rules: RulesSettings, margin: float = 1.0
) -> dict[str, Tensor]:
    """A penalty by name of each rule that may be broken, scalars with gradient by the knots.

    Args:
        travel, cross: (F, N+2) coordinates of the knots, grid units.
        margin: factor on the limits, so that a curve whose penalty is 0 also passes the exact check.

    Raises:
        InputError: so many fibres, of so many knots, that comparing their samples would not fit into memory.
    """
    unit, layout = pad.layout.unit_mm, pad.layout
    place, slope = span_samples(travel, cross, PER_SPAN)
    step = torch.linalg.vector_norm(place.diff(dim=1), dim=-1)
    fibres = SampledCurves(place, slope, torch.nn.functional.pad(step.cumsum(dim=1), (1, 0)))
    radius, gap = margin * rules.min_bend_radius_mm / unit, margin * rules.min_gap_mm / unit
    found = {}
    if radius > 0:
        around = rules.min_bend_radius_mm / 2 / (pad.bent_radius_mm or math.inf)
        found["min_bend_radius_mm"] = _bend(fibres, radius, rules.min_bend_radius_mm / unit / 2, around)
    if gap > 0 and max(layout.counts) > 1:
        found["min_gap_mm"] = _gap(fibres, gap, layout)
    if gap > radius:  # else fibres that bend by the rule keep their folds apart
        found["folds"] = _folds(fibres, gap)
    if max(layout.counts) > 1:
        if rules.same_family_crossings == 0:
            found["same_family_crossings"] = _disorder(travel, cross, max(gap, 0.01), layout)
        else:
            found["same_family_crossings"] = _too_many(
                _family_crossings(fibres, layout), rules.same_family_crossings / margin
            )
    if min(layout.counts) and (rules.max_crossings is not None or rules.min_crossing_angle_deg > 0):
        limit = math.radians(margin * rules.min_crossing_angle_deg)
        count, flat = _crossings(fibres, limit, layout)
        if rules.max_crossings is not None:
            # every horizontal crosses every vertical: no margin may ask for fewer than that
            found["max_crossings"] = _too_many(count, max(rules.max_crossings / margin, math.prod(layout.counts)))
        if limit > 0:
            found["min_crossing_angle_deg"] = flat / (layout.fibres / 2)
    if min(layout.counts) and rules.max_common_track_mm is not None:
        found["max_common_track_mm"] = _common_tracks(
            fibres, TRACK_WIDTH_MM / unit, rules.max_common_track_mm / margin / unit, layout
        )
    if rules.border_mm > 0:
        found["border_mm"] = _hugging(fibres, rules.border_mm / unit)
    if pad.keep_out_mm:
        found["keep_out_mm"] = _intruding(fibres, pad, margin * rules.keep_out_mm / unit)
    found["max_length_mm"] = torch.relu(fibres.arc[:, -1] * unit * margin / rules.max_length_mm - 1).mean()
    return found


def _bend(fibres: SampledCurves, radius: float, window: float, around: float) -> Tensor:
    """How much more than window / radius a fibre turns within `window` of arc, as a share of that angle.

    It goes on straight from both ends, by its leads, which it may meet at a corner.
    Where the pad is worn bent it turns by `around` more at right angles to that, as a fibre does that runs along x;
    leads are outside of the pad.
    """
    start, end = torch.zeros_like(fibres.arc[:, :1]), fibres.arc[:, -1:]
    arc = torch.cat([start - window, start, fibres.arc, end, end + window], dim=1)
    headings = torch.nn.functional.pad(torch.atan(fibres.slope), (2, 2))
    turned = torch.nn.functional.pad(headings.diff(dim=1).abs().cumsum(dim=1), (1, 0))
    until = arc + window
    after = torch.searchsorted(arc.detach(), until.detach()).clamp(1, until.shape[1] - 1)
    a0, a1, t0, t1 = (x.gather(1, i) for x in (arc, turned) for i in (after - 1, after))
    angle = t0 + ((until - a0) / (a1 - a0)).clamp(0, 1) * (t1 - t0) - turned
    if around > 0:
        angle = torch.sqrt(angle**2 + torch.nn.functional.pad(torch.full_like(fibres.arc, around), (2, 2)) ** 2)
    over = torch.relu(angle * radius / window - 1)
    return (over * _shares(arc)).sum(dim=1).mean() / fibres.travelled


def _gap(fibres: SampledCurves, gap: float, layout: Layout) -> Tensor:
    """How much nearer than `gap` neighbours in a family come, as a share of it."""
    _require_room(layout.fibres, fibres.arc.shape[1])
    below = [f for rows in layout.families for f in range(rows.start, rows.stop - 1)]
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
    least, at = distances.min(dim=2)
    fibre, sample = (least < gap + reach).nonzero(as_tuple=True)
    nearest = at[fibre, sample]
    slope = other.slope.detach()[fibre, nearest]
    tangent = torch.nn.functional.normalize(torch.stack([torch.ones_like(slope), slope], dim=-1), dim=-1)
    away = place[fibre, sample] - other.place[fibre, nearest]
    along = (away.detach() * tangent).sum(dim=-1, keepdim=True)
    bound = other.share[fibre, nearest][:, None]
    return torch.linalg.vector_norm(away - along.clamp(-bound, bound) * tangent + 1e-12, dim=-1)


def _common_tracks(fibres: SampledCurves, width: float, length: float, layout: Layout) -> Tensor:
    """How much nearer than `width` to fibres of the other family those are that lie longer than `length` beside them.

    Looked at are two places of every such stretch, `length` / 2 before and behind its middle. They are few: autograd
    would take longer to follow them than a kernel takes for their gradient.
    """
    place, slope, arc = (x.detach().numpy() for x in (fibres.place, fibres.slope, fibres.arc))
    lines = np.concatenate([place[: layout.horizontals], place[layout.horizontals :, :, ::-1]])
    total, gradient = 0.0, np.zeros_like(place)
    for one, other in (layout.families, layout.families[::-1]):
        shared = common_stretches([*lines[one]], [*lines[other]], width)
        long = shared.length > length
        middle = (shared.begin[long] + shared.end[long]) / 2
        pairs = one.start + shared.line[long], other.start + shared.other[long]
        total += sum_overlaps(place, slope, arc, *pairs, middle, length / 2, width, gradient)
    weight = COMMON * length / 4 / len(arc) / fibres.travelled.item()  # the mean of two places, along either fibre
    value = weight * (total - (gradient * place).sum())
    return (torch.from_numpy(weight * gradient) * fibres.place).sum() + value


def _closeness(near: Tensor, gap: float) -> Tensor:
    close = torch.relu(1 - near / gap)
    return (close + 10 * close**2).sum()


def _disorder(travel: Tensor, cross: Tensor, least: float, layout: Layout) -> Tensor:
    """How much less than `least` a fibre lies above its lower neighbour in the family, as a share of it."""
    points = math.ceil(ORDER_PER_UNIT * max(layout.extent)) + 1
    along = [
        torch.linspace(0, extent, points, dtype=torch.float64).expand(count, -1)
        for extent, count in zip(layout.extent, layout.counts, strict=True)
    ]
    at = torch.cat(along)
    # a few fibres at a time: what a large pad's take does not leave the processor's cache then
    parts = zip(travel.split(FIBRES_AT_ONCE), cross.split(FIBRES_AT_ONCE), at.split(FIBRES_AT_ONCE), strict=True)
    above = torch.cat([pchip_sample(*part)[0] for part in parts]).diff(dim=0)
    within = [row for rows in layout.families for row in range(rows.start, rows.stop - 1)]
    return _closeness(above[within], least) / (len(within) * points)


def _too_many(count: Tensor, limit: float) -> Tensor:
    return torch.relu(count - limit) / max(1.0, limit)


def _family_crossings(fibres: SampledCurves, layout: Layout) -> Tensor:
    """Soft number of crossings within the families."""
    pairs = [pair for rows in layout.families for pair in combinations(range(rows.start, rows.stop), 2)]
    _require_room(len(pairs), fibres.arc.shape[1])
    first, second = (fibres.place[list(side)] for side in zip(*pairs, strict=True))
    return _mollified(first, second, 0.0)[0]


def _crossings(fibres: SampledCurves, limit: float, layout: Layout) -> tuple[Tensor, Tensor]:
    """Soft number of horizontal x vertical crossings, and of those flatter than `limit` radians, by how much."""
    pairs = list(product(*(range(rows.start, rows.stop) for rows in layout.families)))
    _require_room(len(pairs), fibres.arc.shape[1])
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
    edge = (travel < zone) | (travel > travel[:, -1:] - zone)
    return (torch.relu(fibres.slope.abs() - 1) * edge * fibres.share).sum(dim=1).mean() / fibres.travelled


def _intruding(fibres: SampledCurves, pad: PadSettings, clearance: float) -> Tensor:
    """How much nearer than `clearance` to a keep-out fibres come, or how deep inside, as a share of it."""
    layout = pad.layout
    place = torch.cat([fibres.place[: layout.horizontals], fibres.place[layout.horizontals :].flip(-1)]).flatten(0, 1)
    known = place.detach().numpy()
    within, total = max(clearance, LEAST_CLEARANCE), fibres.place.new_zeros(())
    for polygon in keep_outs(pad):
        edge, (left, low, right, high) = polygon.exterior, polygon.bounds
        beside = (known < (left - within, low - within)) | (known > (right + within, high + within))
        near = np.flatnonzero(~beside.any(axis=1))
        points = np.asarray(shapely.points(known[near]))
        close = shapely.distance(polygon, points) < within
        near, points = near[close], points[close]
        if not len(near):
            continue
        nearest = shapely.line_interpolate_point(edge, shapely.line_locate_point(edge, points))
        away = place[torch.from_numpy(near)] - torch.tensor(shapely.get_coordinates(nearest))
        outward = 1 - 2 * torch.from_numpy(shapely.contains(polygon, points).astype(float))
        signed = outward * torch.linalg.vector_norm(away + 1e-12, dim=-1)
        total = total + torch.relu(1 - signed / within).sum()
    return total / fibres.arc.numel()
