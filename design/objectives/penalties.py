"""The rules of `[rules]` as penalties with gradients, in the order of their exact checks in `rules`.

A penalty is 0 if its rule is kept with a margin, and grows with the violation. Each is relative to its limit and
averaged over the pad, so that they can be added. They guide the search; the exact check on the finished curves decides.
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
"""Positions of the samples in a span, from 0 to 1, denser towards its ends, where it bends."""
COMMON_WEIGHT = 0.2
"""Weight of the penalty of common tracks; with 1, the search keeps fibres from crossing that may cross."""
MAX_COMPARISONS = 10**8
"""Maximum number of pairs of samples in one comparison, which then takes some seconds."""


class Gradient:
    """Gradients of the sum of all penalties by their inputs, to which each penalty adds its own.

    The shares of arc length that weight samples are treated as constants (see `rule_penalties`).

    Attributes:
        points: by the samples; shape (F, P, 2).
        slope: by the slopes at the samples; shape (F, P).
        arc: by the arc lengths of the samples; shape (F, P).
        along: by the knots' coordinates along the fibres; shape (F, N + 2).
        across: by those across the fibres; shape (F, N + 2).
        knot_slope: by the slopes at the knots; shape (F, N + 2).
    """

    def __init__(self, samples: Array, knots: Array) -> None:
        self.points = np.zeros((*samples.shape, 2))
        self.slope, self.arc = np.zeros((2, *samples.shape))
        self.along, self.across, self.knot_slope = np.zeros((3, *knots.shape))


class Penalties(NamedTuple):
    """Penalties of the rules that can be broken, and the gradient of their sum by the knots.

    Attributes:
        values: penalties by their name in PENALTIES.
        grad_along: gradient by the coordinates along the fibres; shape (F, N + 2).
        grad_across: gradient by those across the fibres; shape (F, N + 2).
    """

    values: dict[str, float]
    grad_along: Array
    grad_across: Array


@dataclass(frozen=True)
class FibreSamples:
    """Densely sampled fibres, and the settings of their penalties; lengths in grid units.

    Attributes:
        along: coordinates of the knots along the fibres; shape (F, N + 2).
        across: coordinates of the knots across the fibres; shape (F, N + 2).
        knot_slope: slopes at the knots; shape (F, N + 2).
        points: samples, along and across; shape (F, P, 2).
        slope: slopes at the samples; shape (F, P).
        arc: arc lengths of the samples from the start; shape (F, P).
        pad: settings of the pad.
        rules: limits of the design rules.
        margin: factor on the limits, so that a curve of penalty 0 passes the exact check.
        all_bends: whether bends between samples count too.
    """

    along: Array
    across: Array
    knot_slope: Array
    points: Array
    slope: Array
    arc: Array
    pad: PadSettings
    rules: RulesSettings
    margin: float
    all_bends: bool

    @cached_property
    def layout(self) -> Layout:
        """Number and spacing of the fibres."""
        return self.pad.layout

    def limit(self, limit_mm: float) -> float:
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
        """Arc length that each sample represents; shape (F, P)."""
        half_step, shares = np.diff(self.arc, axis=1) / 2, np.zeros_like(self.arc)
        shares[:, :-1] += half_step
        shares[:, 1:] += half_step
        return shares

    @property
    def family_pairs(self) -> list[tuple[int, int]]:
        """All pairs of a horizontal and a vertical."""
        return list(product(*(range(rows.start, rows.stop) for rows in self.layout.families)))

    def swap_axes(self, points: Array) -> Array:
        """Convert samples (F, P, 2), or gradients by them, from (along, across) to (x, y), or back."""
        split = self.layout.horizontals
        return np.concatenate([points[:split], points[split:, :, ::-1]])


def penalties(
    along: Array, across: Array, pad: PadSettings, rules: RulesSettings, margin: float = 1.0, all_bends: bool = True
) -> Penalties:
    """Compute the penalty of each rule that can be broken, and the gradient of their sum by the knots.

    The gradient treats the arc length that each sample represents as a constant.

    Args:
        along: coordinates of the knots along the fibres; shape (F, N + 2), grid units.
        across: coordinates of the knots across the fibres; shape (F, N + 2), grid units.
        pad: settings of the pad.
        rules: limits of the design rules.
        margin: factor on the limits.
        all_bends: whether bends between samples count too.

    Raises:
        InputError: so many fibres and knots that a comparison of their samples takes too long.
    """
    along, across = np.ascontiguousarray(along), np.ascontiguousarray(across)
    knot_slope = population_slopes(along[None], across[None])[0]
    slope = np.empty((len(along), PER_SPAN * (along.shape[1] - 1) + 1))
    points = np.empty((*slope.shape, 2))
    sample_spans(along, across, knot_slope, SPAN_SHARES, points, slope)
    steps, arc = np.diff(points, axis=1), np.zeros_like(slope)
    np.linalg.norm(steps, axis=-1).cumsum(axis=1, out=arc[:, 1:])
    fibres = FibreSamples(along, across, knot_slope, points, slope, arc, pad, rules, margin, all_bends)
    gradient = Gradient(slope, along)
    values = {name: value for name, penalty in PENALTIES.items() if (value := penalty(fibres, gradient)) is not None}
    # the arc length of a sample is the sum of the lengths of all steps before it
    grad_length = gradient.arc[:, :0:-1].cumsum(axis=1)[:, ::-1, None]
    length = np.hypot(*np.moveaxis(steps, -1, 0))[..., None]
    grad_step = np.divide(grad_length * steps, length, out=np.zeros_like(steps), where=length > 0)
    gradient.points[:, :-1] -= grad_step
    gradient.points[:, 1:] += grad_step
    add_samples_gradient(
        along,
        across,
        knot_slope,
        SPAN_SHARES,
        gradient.points,
        gradient.slope,
        gradient.along,
        gradient.across,
        gradient.knot_slope,
    )
    through_slopes = fibre_slopes_gradient(along, across, knot_slope, gradient.knot_slope)
    return Penalties(values, gradient.along + through_slopes[0], gradient.across + through_slopes[1])


def check_comparisons(pairs: int, samples: int) -> None:
    """Raise InputError if comparing the samples of so many fibres, or pairs of them, takes too long."""
    if pairs * samples**2 > MAX_COMPARISONS:
        raise InputError(
            f"the rules take {pairs * samples**2} comparisons for so many fibres and knots, allowed are "
            f"{MAX_COMPARISONS}; take fewer, or no limit on crossings"
        )


def _bends(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise turns of more than window / radius within a window of arc length, relative to that angle.

    On a pad that is worn bent, fibres also turn by `rolled` at right angles to the plane of the pad; the leads, which
    are outside the pad, do not.
    """
    radius_mm = fibres.rules.min_mean_bend_radius_mm
    if radius_mm == 0:
        return None
    radius, window = fibres.limit(radius_mm), radius_mm / fibres.layout.unit_mm / 2
    rolled = radius_mm / 2 / (fibres.pad.bent_radius_mm or math.inf)
    weight, all_bends = 1 / len(fibres.arc) / fibres.mean_run, fibres.all_bends
    return sum_excess_turns(
        fibres.slope, fibres.arc, radius, window, rolled, all_bends, weight, gradient.slope, gradient.arc
    )


def _gaps(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise neighbours of a family that are nearer to each other than the gap, relative to it."""
    gap, lower = fibres.limit(fibres.rules.min_gap_mm), fibres.lower
    if gap == 0 or not lower:
        return None
    pairs = [pair for fibre in lower for pair in ((fibre, fibre + 1), (fibre + 1, fibre))]
    return _closeness(fibres, pairs, gap, gradient)


def _folds(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise a fibre that is nearer than the gap to a part of itself that is FOLD gaps or more away along it."""
    gap = fibres.limit(fibres.rules.min_gap_mm)
    if gap <= fibres.limit(fibres.rules.min_mean_bend_radius_mm):  # a bend of that radius keeps the gap
        return None
    return _closeness(fibres, [(fibre, fibre) for fibre in range(len(fibres.arc))], gap, gradient)


def _closeness(fibres: FibreSamples, pairs: list[tuple[int, int]], gap: float, gradient: Gradient) -> float:
    check_comparisons(*fibres.arc.shape)
    samples = fibres.points, fibres.slope, fibres.arc, fibres.shares
    return sum_closeness(*samples, np.array(pairs), gap, FOLD * gap, 1 / fibres.arc.size, gradient.points)


def _family_crossings(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise fibres that are not above their lower neighbour or, if some may cross, too many crossings."""
    layout, lower, limit = fibres.layout, fibres.lower, fibres.rules.same_family_crossings
    if not lower:
        return None
    if limit > 0:
        pairs = [pair for rows in layout.families for pair in combinations(range(rows.start, rows.stop), 2)]
        return _excess_crossings(fibres, pairs, limit / fibres.margin, gradient)
    gap = max(fibres.limit(fibres.rules.min_gap_mm), 0.01)
    stations = math.ceil(40 * max(layout.extent)) + 1  # 40 per grid unit
    return sum_order(
        fibres.along,
        fibres.across,
        fibres.knot_slope,
        np.array(lower),
        stations,
        gap,
        1 / (len(lower) * stations),
        gradient.along,
        gradient.across,
        gradient.knot_slope,
    )


def _max_crossings(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise too many crossings of horizontals with verticals."""
    limit, counts = fibres.rules.max_crossings, fibres.layout.counts
    if limit is None or not min(counts):
        return None
    # the margin must not ask for fewer crossings than one of every horizontal with every vertical
    return _excess_crossings(fibres, fibres.family_pairs, max(limit / fibres.margin, math.prod(counts)), gradient)


def _crossing_angles(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise crossings flatter than the limit, relative to it."""
    limit = math.radians(fibres.margin * fibres.rules.min_crossing_angle_deg)
    if limit == 0 or not min(fibres.layout.counts):
        return None
    weight = 2 / fibres.layout.fibres
    return weight * _crossings(fibres, fibres.family_pairs, limit, (0.0, weight), gradient)[1]


def _common_tracks(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise stretches longer than the limit in which fibres of both families are nearer than a track's width.

    The penalty is evaluated at two points of every such stretch, limit / 2 before and after its middle.
    """
    layout, rules = fibres.layout, fibres.rules
    if rules.max_common_track_mm is None or not min(layout.counts):
        return None
    width, limit = TRACK_WIDTH_MM / layout.unit_mm, rules.max_common_track_mm / fibres.margin / layout.unit_mm
    lines, total, grad_points = fibres.swap_axes(fibres.points), 0.0, np.zeros_like(fibres.points)
    for one, other in (layout.families, layout.families[::-1]):
        stretches = common_stretches([*lines[one]], [*lines[other]], width)
        is_long = stretches.length > limit
        middle = (stretches.begin[is_long] + stretches.end[is_long]) / 2
        pairs = one.start + stretches.line[is_long], other.start + stretches.other[is_long]
        samples = fibres.points, fibres.slope, fibres.arc
        total += sum_overlaps(*samples, pairs, middle, limit / 2, width, grad_points)
    weight = COMMON_WEIGHT * limit / 4 / len(fibres.arc) / fibres.mean_run  # mean of two points, for either family
    gradient.points += weight * grad_points
    return weight * total


def _end_slopes(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise slopes of more than 45 degrees within `border_mm` of the walls at which fibres end."""
    zone = fibres.rules.border_mm / fibres.layout.unit_mm
    if zone == 0:
        return None
    along, steep = fibres.points[..., 0], np.abs(fibres.slope) - 1
    counts = (steep > 0) & ((along < zone) | (along > along[:, -1:] - zone))
    weights = 1 / len(fibres.arc) / fibres.mean_run * fibres.shares * counts
    gradient.slope += weights * np.sign(fibres.slope)
    return float((weights * steep).sum())


def _keep_outs(fibres: FibreSamples, gradient: Gradient) -> float | None:
    """Penalise fibres that are inside a keep-out or nearer to it than the clearance, relative to it."""
    if not fibres.pad.keep_out_mm:
        return None
    clearance, plan = max(fibres.limit(fibres.rules.keep_out_mm), 0.1), fibres.swap_axes(fibres.points)
    samples, grad_plan, total = np.asarray(shapely.points(plan)), np.zeros_like(plan), 0.0
    for polygon in keep_outs(fibres.pad):
        shapely.prepare(polygon)
        near = np.nonzero(shapely.dwithin(polygon, samples, clearance))
        edge, points = polygon.exterior, samples[near]
        nearest = shapely.line_interpolate_point(edge, shapely.line_locate_point(edge, points))
        offset = plan[near] - shapely.get_coordinates(nearest)
        sign = 1 - 2 * shapely.contains(polygon, points).astype(float)
        distance = np.linalg.norm(offset, axis=1)
        total += float(np.maximum(1 - sign * distance / clearance, 0).sum())
        grad_plan[near] -= (sign / np.maximum(distance, 1e-12) / clearance)[:, None] * offset
    weight = 1 / fibres.arc.size
    gradient.points += weight * fibres.swap_axes(grad_plan)
    return weight * total


def _lengths(fibres: FibreSamples, gradient: Gradient) -> float:
    """Penalise fibres longer than the limit, relative to it."""
    share = fibres.layout.unit_mm * fibres.margin / fibres.rules.max_length_mm
    excess = np.maximum(fibres.arc[:, -1] * share - 1, 0)
    gradient.arc[:, -1] += (excess > 0) * (share / len(excess))
    return float(excess.mean())


PENALTIES: dict[str, Callable[[FibreSamples, Gradient], float | None]] = {
    "min_mean_bend_radius_mm": _bends,
    "min_gap_mm": _gaps,
    "folds": _folds,
    "same_family_crossings": _family_crossings,
    "max_crossings": _max_crossings,
    "min_crossing_angle_deg": _crossing_angles,
    "max_common_track_mm": _common_tracks,
    "end_slopes": _end_slopes,
    "keep_out_mm": _keep_outs,
    "max_length_mm": _lengths,
}
"""Penalties by the key of their rule in `[rules]`; they return None if no fibres can break it. Two have no key:
`folds` belongs to `min_gap_mm`, and `end_slopes` keeps fibres from running along the walls at which they end.
"""


def _excess_crossings(fibres: FibreSamples, pairs: list[tuple[int, int]], limit: float, gradient: Gradient) -> float:
    count, weight = _crossings(fibres, pairs, 0.0, (0.0, 0.0), gradient)[0], 1 / max(1.0, limit)
    if count > limit:
        _crossings(fibres, pairs, 0.0, (weight, 0.0), gradient)
    return max(count - limit, 0.0) * weight


def _crossings(
    fibres: FibreSamples, pairs: list[tuple[int, int]], limit: float, weights: tuple[float, float], gradient: Gradient
) -> tuple[float, float]:
    """Return number and flatness of crossings, blurred by 0.1 grid units; add their weighted gradient."""
    check_comparisons(len(pairs), fibres.arc.shape[1])
    axes = np.repeat([0, 1], fibres.layout.counts)
    plan, grad_plan = fibres.swap_axes(fibres.points), np.zeros_like(fibres.points)
    sums = sum_crossings(plan, np.array(pairs), axes, 0.1, limit, weights, grad_plan)
    gradient.points += fibres.swap_axes(grad_plan)
    return sums
