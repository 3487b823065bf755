"""The rules of `[rules]` as penalties with gradients, in the order of their exact checks in `rules`.

A penalty is 0 where its rule holds with a margin, and grows with the breach. Each is relative to its limit and averaged
over the pad, so that they add. The exact check on the finished curves decides; penalties lead the search there.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
import shapely

from padforge.common.validation import InputError
from padforge.design.kernels.geometry import sum_overlaps
from padforge.design.kernels.pchip import (
    add_samples_gradient,
    fibre_slopes_gradient,
    population_slopes,
    sample_spans,
)
from padforge.design.kernels.rule_penalties import (
    add_arc_gradient,
    sum_border_slopes,
    sum_closeness,
    sum_crossings,
    sum_excess_turns,
    sum_order,
)
from padforge.design.morphology import Array
from padforge.design.paths.curves import FOLD, common_stretches
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import TRACK_WIDTH_MM, Layout, PadSettings, RulesSettings

PER_SPAN = 12
"""Samples of a span between two knots."""
SPAN_SHARES = (1 - np.cos(np.arange(PER_SPAN) * (math.pi / PER_SPAN))) / 2
"""Where they lie in it: denser towards its ends, where it bends."""
ORDER_SAMPLES = 40
"""Samples per grid unit at which the order of a family is compared."""
BLUR = 0.1
"""Standard deviation of the mollified crossing count, grid units."""
MIN_CLEARANCE = 0.1
"""From keep-outs, grid units, to which distances are relative where the rule asks for less."""
MIN_ORDER_GAP = 0.01
"""By which a fibre lies above its lower neighbour at least, grid units."""
COMMON_WEIGHT = 0.2
"""Of common tracks: at 1 the search keeps fibres apart that may cross."""
MAX_COMPARISONS = 10**8
"""Pairs of samples compared at once: some seconds."""


class Gradient:
    """The gradient of all penalties by what they are computed from, which each adds to.

    Shares of arc, by which samples are weighted, are held (`rule_penalties`): it is not quite that of the sum.
    """

    def __init__(self, samples: Array, knots: Array) -> None:
        self.points, self.slope, self.arc = (
            np.zeros((*samples.shape, 2)),
            np.zeros_like(samples),
            np.zeros_like(samples),
        )
        self.along, self.across, self.knot_slope = np.zeros((3, *knots.shape))


class Penalties(NamedTuple):
    """Penalties of the rules that can be broken, and the gradient of their sum."""

    values: dict[str, float]  # by the key of `[rules]`
    by_along: Array  # (F, N + 2), by the knots' coordinates along the fibres, with shares of arc held
    by_across: Array  # (F, N + 2), by those across them


@dataclass(frozen=True)
class FibreSamples:
    """Fibres sampled densely, with what their penalties depend on."""

    along: Array  # coordinates of the knots along the fibres; shape (F, N + 2), grid units
    across: Array  # those at right angles to them
    knot_slope: Array  # slopes there
    points: Array  # samples along and across; shape (F, P, 2)
    slope: Array  # shape (F, P)
    arc: Array  # arc length from the start; shape (F, P)
    pad: PadSettings
    layout: Layout
    rules: RulesSettings
    margin: float  # factor on the limits, so that a curve with penalty 0 passes the exact check
    all_bends: bool  # whether bends between samples count, too

    def scale(self, limit_mm: float) -> float:
        """Return a lower limit with the margin, grid units."""
        return self.margin * limit_mm / self.layout.unit_mm

    @property
    def mean_run(self) -> float:
        """Mean length of the fibres along their axes."""
        return float(self.points[:, -1, 0].mean())

    @property
    def lower(self) -> list[int]:
        """Indices of the fibres with a neighbour of their family above them."""
        return [fibre for rows in self.layout.families for fibre in range(rows.start, rows.stop - 1)]

    @cached_property
    def shares(self) -> Array:
        """(F, P) arc length that belongs to each sample."""
        step = np.diff(self.arc, axis=1) / 2
        return np.pad(step, ((0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 1)))

    def plan(self, of_points: Array) -> Array:
        """Return samples along and across, or a gradient by them, as along x and y; shape (F, P, 2)."""
        split = self.layout.horizontals
        return np.concatenate([of_points[:split], of_points[split:, :, ::-1]])


def penalties(
    along: Array, across: Array, pad: PadSettings, rules: RulesSettings, margin: float = 1.0, all_bends: bool = True
) -> Penalties:
    """Compute the penalty of each rule that can be broken, and the gradient of their sum by the knots.

    The gradient holds the share of arc that each sample stands for.
    The knots are (F, N + 2) coordinates along and across the fibres, grid units; `margin` is a factor on the limits.

    Raises:
        InputError: so many fibres and knots that a comparison of their samples takes too long.
    """
    along, across = np.ascontiguousarray(along), np.ascontiguousarray(across)
    knot_slope = population_slopes(along[None], across[None])[0]
    slope = np.empty((len(along), PER_SPAN * (along.shape[1] - 1) + 1))
    points = np.empty((*slope.shape, 2))
    sample_spans(along, across, knot_slope, SPAN_SHARES, points, slope)
    arc = np.pad(np.linalg.norm(np.diff(points, axis=1), axis=-1).cumsum(axis=1), ((0, 0), (1, 0)))
    fibres = FibreSamples(along, across, knot_slope, points, slope, arc, pad, pad.layout, rules, margin, all_bends)
    by = Gradient(slope, along)
    values = {name: value for name, penalty in PENALTIES.items() if (value := penalty(fibres, by)) is not None}
    add_arc_gradient(points, by.arc, by.points)
    where = along, across, knot_slope
    add_samples_gradient(*where, SPAN_SHARES, by.points, by.slope, by.along, by.across, by.knot_slope)
    through_slopes = fibre_slopes_gradient(*where, by.knot_slope)
    return Penalties(values, by.along + through_slopes[0], by.across + through_slopes[1])


def check_comparisons(fibres: int, samples: int) -> None:
    """Refuse so many fibres, or pairs of fibres, that comparing their samples takes too long."""
    if fibres * samples**2 > MAX_COMPARISONS:
        raise InputError(
            f"the rules take {fibres * samples**2} comparisons for so many fibres and knots, allowed are "
            f"{MAX_COMPARISONS}; take fewer, or no limit on crossings"
        )


def _bends(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise turns of more than window / radius within a window of arc length, relative to that angle.

    Where the pad is worn bent, fibres turn by `rolled` more at right angles to that, as a fibre along x does; leads are
    outside the pad.
    """
    radius_mm = fibres.rules.min_mean_bend_radius_mm
    if radius_mm == 0:
        return None
    radius, window = fibres.scale(radius_mm), radius_mm / fibres.layout.unit_mm / 2
    rolled = radius_mm / 2 / (fibres.pad.bent_radius_mm or math.inf)
    weight, all_bends = 1 / len(fibres.arc) / fibres.mean_run, fibres.all_bends
    return sum_excess_turns(fibres.slope, fibres.arc, radius, window, rolled, all_bends, weight, by.slope, by.arc)


def _gaps(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise neighbours in a family that come nearer than the gap, relative to it."""
    gap, lower = fibres.scale(fibres.rules.min_gap_mm), fibres.lower
    if gap == 0 or not lower:
        return None
    check_comparisons(*fibres.arc.shape)
    return _closeness(fibres, [pair for fibre in lower for pair in ((fibre, fibre + 1), (fibre + 1, fibre))], gap, by)


def _folds(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise a fibre that comes nearer than the gap to a part of itself FOLD gaps or more away along it."""
    gap = fibres.scale(fibres.rules.min_gap_mm)
    if gap <= fibres.scale(fibres.rules.min_mean_bend_radius_mm):  # fibres that keep that radius keep folds apart
        return None
    check_comparisons(*fibres.arc.shape)
    return _closeness(fibres, [(fibre, fibre) for fibre in range(len(fibres.arc))], gap, by)


def _closeness(fibres: FibreSamples, pairs: list[tuple[int, int]], gap: float, by: Gradient) -> float:
    where = fibres.points, fibres.slope, fibres.arc, fibres.shares, np.array(pairs)
    return sum_closeness(*where, gap, FOLD * gap, 1 / fibres.arc.size, by.points)


def _family_crossings(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise fibres too little above their lower neighbour, or, where some may cross, too many crossings."""
    layout, lower, limit = fibres.layout, fibres.lower, fibres.rules.same_family_crossings
    if not lower:
        return None
    if limit > 0:
        pairs = [pair for rows in layout.families for pair in combinations(range(rows.start, rows.stop), 2)]
        return _excess_crossings(fibres, pairs, limit / fibres.margin, by)
    gap = max(fibres.scale(fibres.rules.min_gap_mm), MIN_ORDER_GAP)
    stations = math.ceil(ORDER_SAMPLES * max(layout.extent)) + 1
    where = fibres.along, fibres.across, fibres.knot_slope, np.array(lower), stations
    return sum_order(*where, gap, 1 / (len(lower) * stations), by.along, by.across, by.knot_slope)


def _max_crossings(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise too many crossings of horizontals with verticals."""
    limit, counts = fibres.rules.max_crossings, fibres.layout.counts
    if limit is None or not min(counts):
        return None
    # every horizontal crosses every vertical: no margin may ask for fewer than that
    return _excess_crossings(fibres, _across(fibres), max(limit / fibres.margin, math.prod(counts)), by)


def _crossing_angles(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise crossings flatter than the limit, relative to it."""
    limit = math.radians(fibres.margin * fibres.rules.min_crossing_angle_deg)
    if limit == 0 or not min(fibres.layout.counts):
        return None
    weight = 2 / fibres.layout.fibres
    return weight * _crossings(fibres, _across(fibres), limit, (0.0, weight), by)[1]


def _common_tracks(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise stretches longer than the limit in which fibres of both families lie nearer than a track's width.

    Two points of every such stretch count, limit / 2 before and behind its middle.
    """
    layout, rules = fibres.layout, fibres.rules
    if rules.max_common_track_mm is None or not min(layout.counts):
        return None
    width, limit = TRACK_WIDTH_MM / layout.unit_mm, rules.max_common_track_mm / fibres.margin / layout.unit_mm
    lines, total, gradient = fibres.plan(fibres.points), 0.0, np.zeros_like(fibres.points)
    for one, other in (layout.families, layout.families[::-1]):
        stretches = common_stretches([*lines[one]], [*lines[other]], width)
        long = stretches.length > limit
        middle = (stretches.begin[long] + stretches.end[long]) / 2
        pairs = one.start + stretches.line[long], other.start + stretches.other[long]
        where = fibres.points, fibres.slope, fibres.arc, pairs, middle
        total += sum_overlaps(*where, limit / 2, width, gradient)
    weight = COMMON_WEIGHT * limit / 4 / len(fibres.arc) / fibres.mean_run  # the mean of two points, along either fibre
    by.points += weight * gradient
    return weight * total


def _borders(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise slopes of more than 45 degrees in the zone by the wall that fibres come from."""
    zone = fibres.rules.border_mm / fibres.layout.unit_mm
    if zone == 0:
        return None
    weight = 1 / len(fibres.arc) / fibres.mean_run
    return sum_border_slopes(fibres.points, fibres.slope, fibres.shares, zone, weight, by.slope)


def _keep_outs(fibres: FibreSamples, by: Gradient) -> float | None:
    """Penalise fibres nearer than the clearance to a keep-out, or inside, relative to it."""
    if not fibres.pad.keep_out_mm:
        return None
    clearance, plan = max(fibres.scale(fibres.rules.keep_out_mm), MIN_CLEARANCE), fibres.plan(fibres.points)
    samples, gradient, total = np.asarray(shapely.points(plan)), np.zeros_like(plan), 0.0
    for polygon in keep_outs(fibres.pad):
        shapely.prepare(polygon)
        near = np.nonzero(shapely.dwithin(polygon, samples, clearance))
        edge, points = polygon.exterior, samples[near]
        nearest = shapely.line_interpolate_point(edge, shapely.line_locate_point(edge, points))
        offset = plan[near] - shapely.get_coordinates(nearest)
        outward = 1 - 2 * shapely.contains(polygon, points).astype(float)
        distance = np.linalg.norm(offset, axis=1)
        total += float(np.maximum(1 - outward * distance / clearance, 0).sum())
        # dwithin: all of them count
        gradient[near] -= (outward / np.maximum(distance, 1e-12) / clearance)[:, None] * offset
    weight = 1 / fibres.arc.size
    by.points += weight * fibres.plan(gradient)
    return weight * total


def _lengths(fibres: FibreSamples, by: Gradient) -> float:
    """Penalise fibres longer than the limit, relative to it."""
    share = fibres.layout.unit_mm * fibres.margin / fibres.rules.max_length_mm
    excess = np.maximum(fibres.arc[:, -1] * share - 1, 0)
    by.arc[:, -1] += (excess > 0) * (share / len(excess))
    return float(excess.mean())


PENALTIES: dict[str, Callable[[FibreSamples, Gradient], float | None]] = {
    "min_mean_bend_radius_mm": _bends,
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


def _across(fibres: FibreSamples) -> list[tuple[int, int]]:
    """Return all pairs of a horizontal with a vertical."""
    return list(product(*(range(rows.start, rows.stop) for rows in fibres.layout.families)))


def _excess_crossings(fibres: FibreSamples, pairs: list[tuple[int, int]], limit: float, by: Gradient) -> float:
    count, share = _crossings(fibres, pairs, 0.0, (0.0, 0.0), by)[0], 1 / max(1.0, limit)
    if count > limit:
        _crossings(fibres, pairs, 0.0, (share, 0.0), by)
    return max(count - limit, 0.0) * share


def _crossings(
    fibres: FibreSamples, pairs: list[tuple[int, int]], limit: float, weights: tuple[float, float], by: Gradient
) -> tuple[float, float]:
    """Return `sum_crossings`, whose gradient is added with these weights."""
    check_comparisons(len(pairs), fibres.arc.shape[1])
    axes = np.repeat([0, 1], fibres.layout.counts)
    gradient = np.zeros_like(fibres.points)
    sums = sum_crossings(fibres.plan(fibres.points), np.array(pairs), axes, BLUR, limit, weights, gradient)
    by.points += fibres.plan(gradient)
    return sums
