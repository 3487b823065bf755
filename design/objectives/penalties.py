"""The rules of `[rules]` as differentiable penalties, in the order of their exact checks in `rules`.

A penalty is 0 where its rule holds with a margin, and grows with the breach. Each is relative to its limit and averaged
over the pad, so that they add. The exact check on the finished curves decides; penalties lead the search there.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

import numpy as np
import shapely
import torch
from torch import Tensor

from padforge.design.common.validation import InputError
from padforge.design.kernels.geometry import sum_overlaps
from padforge.design.paths.curves import FOLD, common_stretches
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import TRACK_WIDTH_MM, Layout, PadSettings, RulesSettings
from padforge.design.torch_signals import pchip_sample, span_samples

PER_SPAN = 12
"""Samples of a span between two knots."""
ORDER_SAMPLES = 40
"""Samples per grid unit at which the order of a family is compared."""
BLUR = 0.1
"""Standard deviation of the mollified crossing count, grid units."""
MIN_CLEARANCE = 0.1
"""From keep-outs, grid units, to which distances are relative where the rule asks for less."""
MIN_ORDER_GAP = 0.01
"""By which a fibre lies above its lower neighbour at least, grid units."""
ORDER_BATCH = 32
"""Fibres sampled at once for their order: what they take does not leave the processor's cache."""
COMMON_WEIGHT = 0.2
"""Of common tracks: at 1 the search keeps fibres apart that may cross."""
MAX_COMPARISONS = 10**8
"""Pairs of samples compared at once: some GB."""


@dataclass(frozen=True)
class FibreSamples:
    """Fibres sampled densely, with what their penalties depend on."""

    along: Tensor  # coordinates of the knots along the fibres; shape (F, N + 2), grid units
    across: Tensor  # those at right angles to them
    points: Tensor  # samples along and across; shape (F, P, 2)
    slope: Tensor  # shape (F, P)
    arc: Tensor  # arc length from the start; shape (F, P)
    pad: PadSettings
    layout: Layout
    rules: RulesSettings
    margin: float  # factor on the limits, so that a curve with penalty 0 passes the exact check

    def scale(self, limit_mm: float) -> float:
        """Return a lower limit with the margin, grid units."""
        return self.margin * limit_mm / self.layout.unit_mm

    @property
    def mean_run(self) -> Tensor:
        """Mean length of the fibres along their axes, without gradient."""
        return self.points[:, -1, 0].detach().mean()

    @property
    def lower(self) -> list[int]:
        """Indices of the fibres with a neighbour of their family above them."""
        return [fibre for rows in self.layout.families for fibre in range(rows.start, rows.stop - 1)]

    @property
    def plan(self) -> Tensor:
        """Samples along x and y; shape (F, P, 2)."""
        split = self.layout.horizontals
        return torch.cat([self.points[:split], self.points[split:].flip(-1)])

    @cached_property
    def shares(self) -> Tensor:
        """(F, P) arc length that belongs to each sample, without gradient."""
        return _shares(self.arc)

    @cached_property
    def crossings(self) -> tuple[Tensor, Tensor]:
        """`_crossing_density` of horizontals with verticals."""
        return _crossing_density(self, product(*(range(rows.start, rows.stop) for rows in self.layout.families)))


def penalties(
    along: Tensor, across: Tensor, pad: PadSettings, rules: RulesSettings, margin: float = 1.0
) -> dict[str, Tensor]:
    """Compute the penalty of each rule that can be broken: scalars with gradient by the knots, by name.

    The knots are (F, N + 2) coordinates along and across the fibres, grid units; `margin` is a factor on the limits.

    Raises:
        InputError: so many fibres and knots that a comparison of their samples does not fit into memory.
    """
    points, slope = span_samples(along, across, PER_SPAN)
    step = torch.linalg.vector_norm(points.diff(dim=1), dim=-1)
    arc = torch.nn.functional.pad(step.cumsum(dim=1), (1, 0))
    fibres = FibreSamples(along, across, points, slope, arc, pad, pad.layout, rules, margin)
    return {name: value for name, penalty in PENALTIES.items() if (value := penalty(fibres)) is not None}


def check_comparisons(fibres: int, samples: int) -> None:
    """Refuse so many fibres, or pairs of fibres, that their samples cannot be compared in memory."""
    if fibres * samples**2 > MAX_COMPARISONS:
        raise InputError(
            f"the rules take {fibres * samples**2} comparisons for so many fibres and knots, allowed are "
            f"{MAX_COMPARISONS}; take fewer, or no limit on crossings"
        )


def _bends(fibres: FibreSamples) -> Tensor | None:
    """Penalise turns of more than window / radius within a window of arc length, relative to that angle.

    Fibres go on straight from both ends, by their leads, which they may meet at a corner. Where the pad is worn bent,
    they turn by `rolled` more at right angles to that, as a fibre along x does; leads are outside the pad.
    """
    radius_mm = fibres.rules.min_bend_radius_mm
    if radius_mm == 0:
        return None
    radius, window = fibres.scale(radius_mm), radius_mm / fibres.layout.unit_mm / 2
    rolled = radius_mm / 2 / (fibres.pad.bent_radius_mm or math.inf)
    start, end = torch.zeros_like(fibres.arc[:, :1]), fibres.arc[:, -1:]
    arc = torch.cat([start - window, start, fibres.arc, end, end + window], dim=1)
    headings = torch.nn.functional.pad(torch.atan(fibres.slope), (2, 2))
    turned = torch.nn.functional.pad(headings.diff(dim=1).abs().cumsum(dim=1), (1, 0))
    until = arc + window
    after = torch.searchsorted(arc.detach(), until.detach()).clamp(1, until.shape[1] - 1)
    a0, a1, t0, t1 = (x.gather(1, i) for x in (arc, turned) for i in (after - 1, after))
    angle = t0 + ((until - a0) / (a1 - a0)).clamp(0, 1) * (t1 - t0) - turned
    if rolled > 0:
        angle = torch.sqrt(angle**2 + torch.nn.functional.pad(torch.full_like(fibres.arc, rolled), (2, 2)) ** 2)
    excess = torch.relu(angle * radius / window - 1)
    return (excess * _shares(arc)).sum(dim=1).mean() / fibres.mean_run


def _gaps(fibres: FibreSamples) -> Tensor | None:
    """Penalise neighbours in a family that come nearer than the gap, relative to it."""
    gap, lower = fibres.scale(fibres.rules.min_gap_mm), torch.tensor(fibres.lower)
    if gap == 0 or not len(lower):
        return None
    check_comparisons(*fibres.arc.shape)
    below, above = fibres.points[lower], fibres.points[lower + 1]
    distances = torch.cdist(below.detach().float(), above.detach().float())
    pairs = (below, lower + 1, distances), (above, lower, distances.mT)
    return _sum_closeness(torch.cat([_near_distances(fibres, *pair, gap) for pair in pairs]), gap) / fibres.arc.numel()


def _folds(fibres: FibreSamples) -> Tensor | None:
    """Penalise a fibre that comes nearer than the gap to a part of itself FOLD gaps or more away along it."""
    gap = fibres.scale(fibres.rules.min_gap_mm)
    if gap <= fibres.scale(fibres.rules.min_bend_radius_mm):  # fibres that keep the bend radius keep their folds apart
        return None
    check_comparisons(*fibres.arc.shape)
    arc, points = fibres.arc.detach().float(), fibres.points.detach().float()
    is_alongside = (arc[:, :, None] - arc[:, None, :]).abs() < FOLD * gap
    distances = torch.cdist(points, points).masked_fill(is_alongside, math.inf)
    near = _near_distances(fibres, fibres.points, torch.arange(len(arc)), distances, gap)
    return _sum_closeness(near, gap) / fibres.arc.numel()


def _near_distances(fibres: FibreSamples, points: Tensor, others: Tensor, distances: Tensor, gap: float) -> Tensor:
    """Return (K,) distances, with gradient, of those points (B, P, 2) that may lie nearer than `gap` to `others` (B,).

    They are measured to the piece of tangent that the nearest sample stands for, half a step to both sides. `distances`
    (B, P, P) are those between samples in single precision.
    """
    least, index = distances.min(dim=2)
    row, sample = (least < gap + fibres.shares[others].max().item()).nonzero(as_tuple=True)
    nearest = others[row], index[row, sample]
    slope = fibres.slope.detach()[nearest]
    tangent = torch.nn.functional.normalize(torch.stack([torch.ones_like(slope), slope], dim=-1), dim=-1)
    offset = points[row, sample] - fibres.points[nearest]
    along = (offset.detach() * tangent).sum(dim=-1, keepdim=True)
    bound = fibres.shares[nearest][:, None]
    return torch.linalg.vector_norm(offset - along.clamp(-bound, bound) * tangent + 1e-12, dim=-1)


def _family_crossings(fibres: FibreSamples) -> Tensor | None:
    """Penalise fibres too little above their lower neighbour, or, where some may cross, too many crossings."""
    layout, lower, limit = fibres.layout, fibres.lower, fibres.rules.same_family_crossings
    if not lower:
        return None
    if limit > 0:
        pairs = (pair for rows in layout.families for pair in combinations(range(rows.start, rows.stop), 2))
        return _excess(_crossing_density(fibres, pairs)[0].sum(), limit / fibres.margin)
    gap, samples = max(fibres.scale(fibres.rules.min_gap_mm), MIN_ORDER_GAP), ORDER_SAMPLES * max(layout.extent)
    lines = [torch.linspace(0, extent, math.ceil(samples) + 1, dtype=torch.float64) for extent in layout.extent]
    stations = torch.stack([lines[layout.family(fibre)] for fibre in range(layout.fibres)])
    parts = zip(*(x.split(ORDER_BATCH) for x in (fibres.along, fibres.across, stations)), strict=True)
    above = torch.cat([pchip_sample(*part)[0] for part in parts]).diff(dim=0)[lower]
    return _sum_closeness(above, gap) / above.numel()


def _max_crossings(fibres: FibreSamples) -> Tensor | None:
    """Penalise too many crossings of horizontals with verticals."""
    limit, counts = fibres.rules.max_crossings, fibres.layout.counts
    if limit is None or not min(counts):
        return None
    # every horizontal crosses every vertical: no margin may ask for fewer than that
    return _excess(fibres.crossings[0].sum(), max(limit / fibres.margin, math.prod(counts)))


def _crossing_angles(fibres: FibreSamples) -> Tensor | None:
    """Penalise crossings flatter than the limit, relative to it."""
    limit = math.radians(fibres.margin * fibres.rules.min_crossing_angle_deg)
    if limit == 0 or not min(fibres.layout.counts):
        return None
    density, sine = fibres.crossings
    flatness = torch.relu(1 - torch.asin(sine.clamp(max=1 - 1e-9)) / limit)
    return (density * flatness).sum() / (fibres.layout.fibres / 2)


def _common_tracks(fibres: FibreSamples) -> Tensor | None:
    """Penalise stretches longer than the limit in which fibres of both families lie nearer than a track's width.

    Two points of every such stretch count, limit / 2 before and behind its middle. They are few: autograd takes longer
    to follow them than a kernel takes for their gradient.
    """
    layout, rules = fibres.layout, fibres.rules
    if rules.max_common_track_mm is None or not min(layout.counts):
        return None
    width, limit = TRACK_WIDTH_MM / layout.unit_mm, rules.max_common_track_mm / fibres.margin / layout.unit_mm
    points, slope, arc, lines = (x.detach().numpy() for x in (fibres.points, fibres.slope, fibres.arc, fibres.plan))
    total, gradient = 0.0, np.zeros_like(points)
    for one, other in (layout.families, layout.families[::-1]):
        stretches = common_stretches([*lines[one]], [*lines[other]], width)
        long = stretches.length > limit
        middle = (stretches.begin[long] + stretches.end[long]) / 2
        pairs = one.start + stretches.line[long], other.start + stretches.other[long]
        total += sum_overlaps(points, slope, arc, pairs, middle, limit / 2, width, gradient)
    weight = COMMON_WEIGHT * limit / 4 / len(arc) / fibres.mean_run.item()  # the mean of two points, along either fibre
    value = weight * (total - (gradient * points).sum())
    return (torch.from_numpy(weight * gradient) * fibres.points).sum() + value


def _borders(fibres: FibreSamples) -> Tensor | None:
    """Penalise slopes of more than 45 degrees in the zone by the wall that fibres come from."""
    zone = fibres.rules.border_mm / fibres.layout.unit_mm
    if zone == 0:
        return None
    along = fibres.points[..., 0].detach()
    in_zone = (along < zone) | (along > along[:, -1:] - zone)
    return (torch.relu(fibres.slope.abs() - 1) * in_zone * fibres.shares).sum(dim=1).mean() / fibres.mean_run


def _keep_outs(fibres: FibreSamples) -> Tensor | None:
    """Penalise fibres nearer than the clearance to a keep-out, or inside, relative to it."""
    if not fibres.pad.keep_out_mm:
        return None
    clearance, plan = max(fibres.scale(fibres.rules.keep_out_mm), MIN_CLEARANCE), fibres.plan.flatten(0, 1)
    samples, total = np.asarray(shapely.points(plan.detach().numpy())), plan.new_zeros(())
    for polygon in keep_outs(fibres.pad):
        shapely.prepare(polygon)
        near = np.flatnonzero(shapely.dwithin(polygon, samples, clearance))
        edge, points = polygon.exterior, samples[near]
        nearest = shapely.line_interpolate_point(edge, shapely.line_locate_point(edge, points))
        offset = plan[torch.from_numpy(near)] - torch.tensor(shapely.get_coordinates(nearest))
        outward = 1 - 2 * torch.from_numpy(shapely.contains(polygon, points).astype(float))
        signed = outward * torch.linalg.vector_norm(offset + 1e-12, dim=-1)
        total = total + torch.relu(1 - signed / clearance).sum()
    return total / fibres.arc.numel()


def _lengths(fibres: FibreSamples) -> Tensor:
    """Penalise fibres longer than the limit, relative to it."""
    limit_mm = fibres.rules.max_length_mm
    return torch.relu(fibres.arc[:, -1] * fibres.layout.unit_mm * fibres.margin / limit_mm - 1).mean()


PENALTIES: dict[str, Callable[[FibreSamples], Tensor | None]] = {
    "min_bend_radius_mm": _bends,
    "min_gap_mm": _gaps,
    "folds": _folds,
    "same_family_crossings": _family_crossings,
    "max_crossings": _max_crossings,
    "min_crossing_angle_deg": _crossing_angles,
    "max_common_track_mm": _common_tracks,
    "border_mm": _borders,
    "keep_out_mm": _keep_outs,
    "max_length_mm": _lengths,
}
"""By the key of `[rules]`; None where the limit cannot be met or missed."""


def _shares(arc: Tensor) -> Tensor:
    """Return how much of the arc lengths (F, P) belongs to each sample, without gradient."""
    step = arc.detach().diff(dim=1) / 2
    return torch.nn.functional.pad(step, (1, 0)) + torch.nn.functional.pad(step, (0, 1))


def _sum_closeness(distances: Tensor, gap: float) -> Tensor:
    close = torch.relu(1 - distances / gap)
    return (close + 10 * close**2).sum()


def _excess(count: Tensor, limit: float) -> Tensor:
    return torch.relu(count - limit) / max(1.0, limit)


def _crossing_density(fibres: FibreSamples, pairs: Iterable[tuple[int, int]]) -> tuple[Tensor, Tensor]:
    """Return the density of crossings of fibres pair by pair, and the sines of their angles.

    By the Kac-Rice formula the number of crossings of lines p and q is the sum of |dp x dq| delta(p - q), here with a
    narrow Gaussian for delta, so that it has a gradient.
    """
    sides = list(zip(*pairs, strict=True))
    check_comparisons(len(sides[0]), fibres.arc.shape[1])
    p, q = (fibres.plan[list(side)] for side in sides)
    dp, dq = p.diff(dim=1)[:, :, None], q.diff(dim=1)[:, None]
    offset = (p[:, 1:] + p[:, :-1])[:, :, None] / 2 - (q[:, 1:] + q[:, :-1])[:, None] / 2
    area = (dp[..., 0] * dq[..., 1] - dp[..., 1] * dq[..., 0]).abs()
    density = area * torch.exp((offset**2).sum(dim=-1) / (-2 * BLUR**2)) / (2 * math.pi * BLUR**2)
    return density, area / (torch.linalg.vector_norm(dp, dim=-1) * torch.linalg.vector_norm(dq, dim=-1) + 1e-12)
