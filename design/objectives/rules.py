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

TOLERANCE_MM = 1e-3
"""To which curves are flattened."""
FOLD_TOLERANCE = 1e-4
"""The same for folds, share of the gap where that is more: all points within a gap of each other are compared."""
MAX_TURN = 1e-4
"""Radians between the points of a bend, at least: matters for radii far beyond the pad's size."""
CROSSING_TOLERANCE = 1e-6
"""Grid units; crossings are placed so well that, at the default pitch, the angle of two fibres of 1 mm radius that
cross at 10 degrees is right to 0.01 degrees."""
CACHE_SIZE = 256
"""Fibres whose bends and folds are cached: whoever draws one fibre leaves the others."""


@dataclass(frozen=True)
class Violation:
    """One broken rule.

    Attributes:
        rule: the setting's name in `[rules]`.
        fibres: the fibres concerned, from 1 (horizontals bottom to top, then verticals left to right); none where it
            concerns the pad as a whole.
        measured: the measured amount, mm (or degrees, or a count).
        limit: the allowed one.
        place_mm: position from the pad's centre; None where there is no single one.
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


def check_rules(pad: Morphology, rules: RulesSettings, size: PadSettings | None = None) -> list[Violation]:
    """Check every rule of `[rules]`, and return the worst violation per fibre or pair of fibres.

    - `min_mean_bend_radius_mm` R: in no stretch of R / 2 along it does a fibre turn by more than half a radian, left
      and right added up; the measured radius is R / 2 divided by the greatest such angle, the mean over that stretch.
      So a long bend is as wide as R, while a short one may be tighter, and a kink of up to half a radian (29 degrees)
      passes where R / 2 around it is straight. A fibre goes on straight from its ends, by its leads: it may meet them
      at such a kink. Where the pad is worn bent, the angle is that in space (`rolled_turns`).
    - `min_gap_mm` g: two fibres of a family keep the distance g; and so do any two points of one fibre that lie at
      least pi g / 2 apart along it, which is half a turn around a circle of diameter g.
    - `same_family_crossings`: the number of points at which fibres of one family meet, in the whole pad.
    - `max_crossings`: the number of points at which horizontals meet verticals, in the whole pad.
    - `min_crossing_angle_deg`: the angle, 0 to 90, between the tangents where a horizontal meets a vertical; 0 where
      they run on each other, and next to 0 where they touch.
    - `max_common_track_mm`: the length of a stretch of a horizontal in which all of it is nearer than the width w of a
      track, `TRACK_WIDTH_MM`, to one vertical, or of a vertical to one horizontal, whether they cross there or not;
      2 w / sin(a) where they cross straight at the angle a.
    - `border_mm`: the distance of every fibre to the two sides of the pad that it runs along.
    - `keep_out_mm`: the distance of every fibre to the polygons `keep_out_mm` of `[pad]`; 0 in them.
    - `max_length_mm`: the arc length of a fibre.

    Distances are right to twice the TOLERANCE_MM to which curves are flattened, those of a fibre to itself to 2e-4 g if
    that is more; bend radii below R to 0.5 %; common stretches to 0.01 mm.

    Args:
        pad: the fibres.
        rules: the limits.
        size: keep-outs and the radius the pad is worn on; its layout is the pad's.
    """
    pad, rules = check_type("pad", pad, Morphology), check_type("rules", rules, RulesSettings)
    lines = [pad.to_mm(points) for points in curves.flatten(pad, TOLERANCE_MM / pad.unit_mm)]
    size = or_default("size", size, PadSettings).for_layout(pad.layout)
    return [
        *_check_bends(pad, rules.min_mean_bend_radius_mm, size.bent_radius_mm),
        *_check_gaps(lines, pad.layout, rules.min_gap_mm),
        *_check_folds(pad, lines, rules.min_gap_mm),
        *_check_crossings(pad, rules),
        *_check_common_tracks(lines, pad.layout, rules.max_common_track_mm),
        *_check_borders(pad, lines, rules.border_mm),
        *_check_keep_outs(pad, lines, size, rules.keep_out_mm),
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
    for fibre in map(int, np.flatnonzero(turned + max_rolled > window / limit)):
        path = spans[fibre].tobytes(), slopes[fibre].tobytes()
        radius, place = _min_bend(*path, pad.layout.family(fibre), pad.unit_mm, window, limit, bent_radius_mm)
        if radius < limit:
            yield _violation("min_mean_bend_radius_mm", [fibre], radius, limit, pad.to_mm(place))


@lru_cache(maxsize=CACHE_SIZE)
def _min_bend(
    spans: bytes, slopes: bytes, family: int, unit_mm: float, window: float, limit: float, bent_radius_mm: float | None
) -> tuple[float, Array]:
    """Return `bend_radius` in mm of a fibre, of its Bezier spans in grid units, and its position in grid units."""
    curve = np.frombuffer(spans).reshape(-1, 4, 2), np.frombuffer(slopes).reshape(-1, 3)
    # An end of the window that falls between two points is off by less than the turn from one to the other.
    points, headings = trace_curve(*curve, step=max(window / limit / 200, MAX_TURN))
    # a straight lead at either end, with a corner there
    points, lead = points * unit_mm, np.eye(2)[family] * window
    points = np.vstack([points[0] - lead, points[0], points, points[-1], points[-1] + lead])
    headings = np.pad(headings, 2)
    flat = bent_radius_mm is None
    rolled = 0.0 if flat else rolled_turns(points, headings - family * np.pi / 2, bent_radius_mm)
    radius, place = bend_radius(points, headings, window, rolled)
    return radius, place / unit_mm


def _check_gaps(lines: list[Array], layout: Layout, limit: float) -> Iterator[Violation]:
    shapes = np.array([shapely.LineString(line) for line in lines])
    shapely.prepare(shapes)  # a tenth of the time where fibres are tangled
    for rows in layout.families:
        family = shapes[rows]
        near = shapely.STRtree(family).query(family, predicate="dwithin", distance=limit).T
        for first, second in sorted((i, j) for i, j in near if i < j):
            between = shapely.shortest_line(family[first], family[second])
            if between.length < limit:
                fibres, middle = (rows.start + first, rows.start + second), np.mean(between.coords, axis=0)
                yield _violation("min_gap_mm", fibres, between.length, limit, middle)


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
    points = curves.crossings(pad, CROSSING_TOLERANCE, across=limit is not None or min_angle > 0)
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
        # a pair's least angle comes first
        for i in np.argsort(angles, kind="stable")[: np.count_nonzero(angles < min_angle)]:
            pair, place = (across[i].first, across[i].second), pad.to_mm(across[i].position)
            worst.setdefault(pair, _violation("min_crossing_angle_deg", pair, float(angles[i]), min_angle, place))
        yield from (worst[pair] for pair in sorted(worst))


def _check_common_tracks(lines: list[Array], layout: Layout, limit: float | None) -> Iterator[Violation]:
    """Yield the longest common stretch of each pair of a horizontal and a vertical above the limit."""
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


def _check_keep_outs(pad: Morphology, lines: list[Array], size: PadSettings, limit: float) -> Iterator[Violation]:
    """Yield the point of every fibre nearest to each polygon, or the middle of the longest stretch through it."""
    for polygon in shapely.transform(keep_outs(size), pad.to_mm):
        for fibre, line in enumerate(lines):
            curve = shapely.LineString(line)
            between, inside = shapely.shortest_line(curve, polygon), curve.intersection(polygon)
            if not inside.is_empty:
                longest = max(shapely.get_parts(inside), key=lambda part: part.length)
                middle = longest.interpolate(0.5, normalized=True).coords[0]
                yield _violation("keep_out_mm", [fibre], 0.0, limit, middle)
            elif between.length < limit:
                yield _violation("keep_out_mm", [fibre], between.length, limit, between.coords[0])


def _check_lengths(pad: Morphology, limit: float) -> Iterator[Violation]:
    long = curves.lengths(pad) * pad.unit_mm
    return (_violation("max_length_mm", [f], float(long[f]), limit) for f in np.flatnonzero(long > limit))


def _violation(
    rule: str, fibres: Iterable[int], measured: float, limit: float, place_mm: Sequence[float] | Array | None = None
) -> Violation:
    """Return the violation of fibres that are counted from 0."""
    place = None if place_mm is None else (float(place_mm[0]), float(place_mm[1]))
    return Violation(rule, tuple(int(fibre) + 1 for fibre in fibres), measured, limit, place)


def _format_amount(value: float) -> str:
    """Format with three digits, but no fewer than a count has."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
