"""Rules that make a pad buildable, checked exactly on the finished curves, each violation with position and amount.

To add a rule, add its limit to `RulesSettings` and its check to `check_rules`. For the gradient search to lead there,
add its differentiable form to PENALTIES of `penalties`, under the same name.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely

from padforge.common.settings import or_default
from padforge.common.validation import check_type
from padforge.design.morphology import Array, Morphology
from padforge.design.paths import curves
from padforge.design.paths.curves import UNFOLDED, bend_radius, extreme_headings, fold_gap, rolled_turns, trace_curve
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import TRACK_WIDTH_MM, Layout, PadSettings, RulesSettings

TOLERANCE_MM = 1e-3  # maximum deviation of the polylines by which curves are checked, mm
FOLD_TOLERANCE = 1e-4
"""The same for folds, as a share of the gap, if that is more: the check compares all pairs of points within a gap."""
CACHE_SIZE = 256  # number of fibres whose bends and folds are cached: an editor changes one fibre at a time


@dataclass(frozen=True)
class Violation:
    """One broken rule.

    Attributes:
        rule: key of the rule in `[rules]`.
        fibres: numbers of the fibres, from 1 (horizontals bottom to top, then verticals left to right); none if the
            violation concerns the pad as a whole.
        measured: the measured value, mm (or degrees, or a count).
        limit: the allowed value.
        place_mm: position from the centre of the pad; None if there is no single one.
    """

    rule: str
    fibres: tuple[int, ...]
    measured: float
    limit: float
    place_mm: tuple[float, float] | None = None

    def __str__(self) -> str:
        names = " and ".join(f"fibre {f}" for f in self.fibres) or "pad"
        place = "" if self.place_mm is None else f" at ({self.place_mm[0]:.1f}, {self.place_mm[1]:.1f}) mm"
        return f"{self.rule}: {names}{place}: {_format_amount(self.measured)}, limit {_format_amount(self.limit)}"


def check_rules(pad: Morphology, rules: RulesSettings, pad_settings: PadSettings | None = None) -> list[Violation]:
    """Check every rule of `[rules]`, and return the worst violation per fibre or pair of fibres.

    - `min_mean_bend_radius_mm` R: in no stretch of R / 2 along it does a fibre turn by more than half a radian, left
      and right turns added up. The measured radius is the mean over that stretch, R / 2 divided by the largest such
      angle. So a long bend has at least the radius R, while a short one may be tighter, and a kink of up to half a
      radian (29 degrees) is allowed if R / 2 around it is straight. At its ends a fibre continues straight as a lead,
      which it may meet at such a kink. If the pad is worn bent, the angle is that in space (`rolled_turns`).
    - `min_gap_mm` g: two fibres of a family have at least the distance g, and so do any two points of one fibre that
      are at least pi g / 2 apart along it, half a turn around a circle of diameter g.
    - `same_family_crossings`: the number of points at which fibres of one family meet, in the whole pad.
    - `max_crossings`: the number of points at which horizontals meet verticals, in the whole pad.
    - `min_crossing_angle_deg`: the angle, 0 to 90, between the tangents at which a horizontal meets a vertical; 0 if
      they share a stretch, and nearly 0 if they touch.
    - `max_common_track_mm`: the length of a stretch of a fibre all of which is nearer than the width w of a track,
      `TRACK_WIDTH_MM`, to one fibre of the other family, whether or not they cross there; 2 w / sin(a) for straight
      fibres that cross at the angle a.
    - `border_mm`: the distance of every fibre to the two sides of the pad along which it runs.
    - `keep_out_mm`: the distance of every fibre to the polygons `keep_out_mm` of `[pad]`; 0 in them.
    - `max_length_mm`: the arc length of a fibre.

    Distances are accurate to twice TOLERANCE_MM, those of a fibre to itself to 2e-4 g if that is more; bend radii below
    R to 0.5 %; common stretches to 0.01 mm.

    Args:
        pad: the fibres.
        rules: the limits.
        pad_settings: settings of the pad, of which the keep-outs and the radius on which it is worn matter.
    """
    pad, rules = check_type("pad", pad, Morphology), check_type("rules", rules, RulesSettings)
    lines = [pad.to_mm(points) for points in curves.flatten(pad, TOLERANCE_MM / pad.unit_mm)]
    pad_settings = or_default("pad_settings", pad_settings, PadSettings).for_layout(pad.layout)
    return [
        *_check_bends(pad, rules.min_mean_bend_radius_mm, pad_settings.bent_radius_mm),
        *_check_gaps(lines, pad.layout, rules.min_gap_mm),
        *_check_folds(pad, lines, rules.min_gap_mm),
        *_check_crossings(pad, rules),
        *_check_common_tracks(lines, pad.layout, rules.max_common_track_mm),
        *_check_borders(pad, lines, rules.border_mm),
        *_check_keep_outs(pad, lines, pad_settings, rules.keep_out_mm),
        *_check_lengths(pad, rules.max_length_mm),
    ]


def _check_bends(pad: Morphology, limit: float, bent_radius_mm: float | None) -> Iterator[Violation]:
    """Yield the tightest bend of every fibre that breaks `min_mean_bend_radius_mm`."""
    if limit == 0:
        return
    window = min(limit / 2, *pad.layout.size_mm)  # no fibre is shorter than the pad
    spans, slopes = curves.beziers(pad), curves.slope_beziers(pad)
    turned = np.abs(np.diff(extreme_headings(slopes), prepend=0, append=0)).sum(axis=1)  # leads have heading 0
    max_rolled = 0.0 if bent_radius_mm is None else window / bent_radius_mm
    # others cannot turn by more than is allowed
    for fibre in map(int, np.flatnonzero(turned + max_rolled > window / limit)):
        curve = spans[fibre].tobytes(), slopes[fibre].tobytes()
        radius, place = _min_bend(*curve, pad.layout.family(fibre), pad.unit_mm, window, limit, bent_radius_mm)
        if radius < limit:
            yield _violation("min_mean_bend_radius_mm", [fibre], radius, limit, pad.to_mm(place))


@lru_cache(maxsize=CACHE_SIZE)
def _min_bend(
    spans: bytes, slopes: bytes, family: int, unit_mm: float, window: float, limit: float, bent_radius_mm: float | None
) -> tuple[float, Array]:
    """Return the `bend_radius` of a fibre, mm, and its position, grid units, from its Bezier spans in grid units."""
    curve = np.frombuffer(spans).reshape(-1, 4, 2), np.frombuffer(slopes).reshape(-1, 3)
    # The turn within a window is wrong by at most that from one point to the next, which is 1 / 200 of the limit. The
    # lower bound keeps the number of points small for radii far beyond the size of the pad.
    points, headings = trace_curve(*curve, step=max(window / limit / 200, 1e-4))
    # add a straight lead at either end, with a corner there
    points, lead = points * unit_mm, np.eye(2)[family] * window
    points = np.vstack([points[0] - lead, points[0], points, points[-1], points[-1] + lead])
    headings = np.pad(headings, 2)
    flat = bent_radius_mm is None
    rolled = 0.0 if flat else rolled_turns(points, headings - family * np.pi / 2, bent_radius_mm)
    radius, place = bend_radius(points, headings, window, rolled)
    return radius, place / unit_mm


def _check_gaps(lines: list[Array], layout: Layout, limit: float) -> Iterator[Violation]:
    shapes = np.array([shapely.LineString(line) for line in lines])
    shapely.prepare(shapes)  # takes a tenth of the time for tangled fibres
    for rows in layout.families:
        family = shapes[rows]
        near = shapely.STRtree(family).query(family, predicate="dwithin", distance=limit).T
        for first, second in sorted((i, j) for i, j in near if i < j):
            gap = shapely.shortest_line(family[first], family[second])
            if gap.length < limit:
                fibres, middle = (rows.start + first, rows.start + second), np.mean(gap.coords, axis=0)
                yield _violation("min_gap_mm", fibres, gap.length, limit, middle)


def _check_folds(pad: Morphology, lines: list[Array], limit: float) -> Iterator[Violation]:
    if limit == 0:
        return
    if FOLD_TOLERANCE * limit > TOLERANCE_MM:
        lines = [pad.to_mm(points) for points in curves.flatten(pad, FOLD_TOLERANCE * limit / pad.unit_mm)]
    for fibre in np.flatnonzero(np.ptp(extreme_headings(curves.slope_beziers(pad)), axis=1) > UNFOLDED):
        if fold := _min_fold(lines[fibre].tobytes(), limit):
            yield _violation("min_gap_mm", [fibre], fold[0], limit, fold[1])


@lru_cache(maxsize=CACHE_SIZE)
def _min_fold(line: bytes, limit: float) -> tuple[float, Array] | None:
    return fold_gap(np.frombuffer(line).reshape(-1, 2), limit)


def _check_crossings(pad: Morphology, rules: RulesSettings) -> Iterator[Violation]:
    limit, min_angle = rules.max_crossings, rules.min_crossing_angle_deg
    # At the default pitch, a tolerance of 1e-6 grid units makes the angle of two fibres of 1 mm radius that cross at 10
    # degrees accurate to 0.01 degrees.
    points = curves.crossings(pad, 1e-6, across=limit is not None or min_angle > 0)
    horizontals = pad.layout.horizontals
    across = [c for c in points if c.first < horizontals <= c.second]
    same = [c for c in points if (c.first < horizontals) == (c.second < horizontals)]
    if len(same) > rules.same_family_crossings:
        for c in same:
            pair, place = (c.first, c.second), pad.to_mm(c.position)
            yield _violation("same_family_crossings", pair, len(same), rules.same_family_crossings, place)
    if limit is not None and len(across) > limit:
        yield Violation("max_crossings", (), len(across), limit)
    if min_angle > 0:
        angles = curves.crossing_angles(pad, across)
        worst: dict[tuple[int, int], Violation] = {}
        for i in np.argsort(angles, kind="stable")[: np.count_nonzero(angles < min_angle)]:  # smallest angles first
            pair, place = (across[i].first, across[i].second), pad.to_mm(across[i].position)
            worst.setdefault(pair, _violation("min_crossing_angle_deg", pair, float(angles[i]), min_angle, place))
        yield from (worst[pair] for pair in sorted(worst))


def _check_common_tracks(lines: list[Array], layout: Layout, limit: float | None) -> Iterator[Violation]:
    """Yield the longest common stretch of each pair of a horizontal and a vertical, if it is above the limit."""
    if limit is None or not min(layout.counts):
        return
    longest: dict[tuple[int, int], Violation] = {}
    for one, other in (layout.families, layout.families[::-1]):
        stretches = curves.common_stretches(lines[one], lines[other], TRACK_WIDTH_MM)
        for i in np.flatnonzero(stretches.length > limit).tolist():
            fibre, length = one.start + int(stretches.line[i]), float(stretches.length[i])
            first, second = sorted((fibre, other.start + int(stretches.other[i])))
            if (first, second) not in longest or longest[first, second].measured < length:
                middle = shapely.LineString(lines[fibre]).interpolate(stretches.begin[i] + length / 2).coords[0]
                longest[first, second] = _violation("max_common_track_mm", (first, second), length, limit, middle)
    yield from (longest[pair] for pair in sorted(longest))


def _check_borders(pad: Morphology, lines: list[Array], limit: float) -> Iterator[Violation]:
    for fibre, line in enumerate(lines):
        across = 1 - pad.layout.family(fibre)
        distance = pad.layout.size_mm[across] / 2 - np.abs(line[:, across])
        worst = int(np.argmin(distance))
        if distance[worst] < limit:
            yield _violation("border_mm", [fibre], float(distance[worst]), limit, line[worst])


def _check_keep_outs(
    pad: Morphology, lines: list[Array], pad_settings: PadSettings, limit: float
) -> Iterator[Violation]:
    """Yield the point of every fibre nearest to each polygon, or the middle of the longest stretch through it."""
    for polygon in shapely.transform(keep_outs(pad_settings), pad.to_mm):
        for fibre, line in enumerate(lines):
            curve = shapely.LineString(line)
            gap, inside = shapely.shortest_line(curve, polygon), curve.intersection(polygon)
            if not inside.is_empty:
                longest = max(shapely.get_parts(inside), key=lambda stretch: stretch.length)
                middle = longest.interpolate(0.5, normalized=True).coords[0]
                yield _violation("keep_out_mm", [fibre], 0.0, limit, middle)
            elif gap.length < limit:
                yield _violation("keep_out_mm", [fibre], gap.length, limit, gap.coords[0])


def _check_lengths(pad: Morphology, limit: float) -> Iterator[Violation]:
    lengths_mm = curves.lengths(pad) * pad.unit_mm
    return (_violation("max_length_mm", [f], float(lengths_mm[f]), limit) for f in np.flatnonzero(lengths_mm > limit))


def _violation(
    rule: str, fibres: Iterable[int], measured: float, limit: float, place_mm: Sequence[float] | Array | None = None
) -> Violation:
    """Return a violation by fibres that are counted from 0."""
    place = None if place_mm is None else (float(place_mm[0]), float(place_mm[1]))
    return Violation(rule, tuple(int(fibre) + 1 for fibre in fibres), measured, limit, place)


def _format_amount(value: float) -> str:
    """Format with three significant digits, or as an integer if that has more."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
