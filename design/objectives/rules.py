"""Rules that make a pad buildable, checked exactly on the finished curves, each finding with place and amount.

The search has a differentiable penalty for some of them (`penalties`); what counts is the check here.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely

from padforge.design.common.settings import or_default
from padforge.design.common.validation import check_type
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.bends import UNFOLDED, bend_radius, extreme_headings, fold_gap, rolled_turns, trace_curve
from padforge.design.paths.curves import (
    Crossing,
    beziers,
    common_stretches,
    crossing_angles,
    crossings,
    flatten,
    lengths,
    slope_beziers,
)
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import TRACK_WIDTH_MM, Layout, PadSettings, RulesSettings

_TOLERANCE_MM = 1e-3
_REMEMBERED = 256
"""Bends and folds of fibres that are known without another look: whoever draws one fibre leaves the others."""
_FOLD_TOLERANCE = 1e-4  # of the gap where that is more: all points within a gap of each other are compared

_FINEST_TURN = 1e-4
"""Radians between the points at which bends are looked at, at least: matters for radii far beyond the pad's size."""
_CROSSING_TOLERANCE = 1e-6
"""Grid units; places a crossing so well that, at the default pitch, the angle of two fibres of 1 mm radius that cross
at 10 degrees is right to 0.01 degrees."""


@dataclass(frozen=True)
class Violation:
    """One broken rule.

    Attributes:
        rule: the setting's name in `[rules]`.
        fibres: the fibres concerned, 1.. (horizontals bottom to top, then verticals left to right); none where the
            finding is about the whole pad.
        measured, limit: what was found and what is allowed, mm (or degrees, or a count).
        place_mm: where, from the pad's centre; None where the finding has no single place.
    """

    rule: str
    fibres: tuple[int, ...]
    measured: float
    limit: float
    place_mm: tuple[float, float] | None = None

    def __str__(self) -> str:
        names = " and ".join(f"fibre {f}" for f in self.fibres) or "pad"
        place = "" if self.place_mm is None else f" at ({self.place_mm[0]:.1f}, {self.place_mm[1]:.1f}) mm"
        return f"{self.rule}: {names}{place}: {_amount(self.measured)}, limit {_amount(self.limit)}"


def check_rules(pad: Morphology, rules: RulesSettings, size: PadSettings | None = None) -> list[Violation]:
    """Every rule of `[rules]` that `pad` breaks, worst place per fibre or pair of fibres.

    `size` says what there is to keep off and what the pad is worn on; its layout is the pad's whatever it says of that.

    - `min_bend_radius_mm` R: in no stretch of R / 2 along it does a fibre turn by more than half a radian, left and
      right added up; the radius found is R / 2 divided by the greatest such angle. So a bend that keeps on is as wide
      as R, while a kink of up to half a radian (29 degrees) passes where R / 2 around it is straight. A fibre goes on
      straight from its ends, by its leads: it may meet them at such a kink. Where the pad is worn bent, the angle is
      that in space (`rolled_turns`).
    - `min_gap_mm` g: two fibres of a family keep the distance g; and so do any two points of one fibre that lie at
      least pi g / 2 apart along it, which is half a turn around a circle of diameter g.
    - `same_family_crossings`: the number of places at which fibres of one family meet, in the whole pad.
    - `max_crossings`: the number of places at which horizontals meet verticals, in the whole pad.
    - `min_crossing_angle_deg`: the angle, 0 to 90, between the tangents where a horizontal meets a vertical; 0 where
      they run on each other, and next to 0 where they touch.
    - `max_common_track_mm`: the length of a stretch of a horizontal in which all of it is nearer than the width w of a
      track, `TRACK_WIDTH_MM`, to one vertical, or of a vertical to one horizontal, whether they cross there or not;
      2 w / sin(a) where they cross straight at the angle a.
    - `border_mm`: the distance of every fibre to the two sides of the pad that it runs along.
    - `keep_out_mm`: the distance of every fibre to the polygons `keep_out_mm` of `[pad]`; 0 in them.
    - `max_length_mm`: the arc length of a fibre.

    Distances are right to twice the 1e-3 mm to which curves are flattened, those of a fibre to itself to 2e-4 g if that
    is more; bend radii below R to 0.5 %; what two tracks have in common to 0.01 mm.
    """
    pad, rules = check_type("pad", pad, Morphology), check_type("rules", rules, RulesSettings)
    lines = [pad.to_mm(points) for points in flatten(pad, _TOLERANCE_MM / pad.unit_mm)]
    size = or_default("size", size, PadSettings).for_layout(pad.layout)
    return [
        *tight_bends(pad, rules.min_bend_radius_mm, size.bent_radius_mm),
        *_gaps(lines, pad.layout, rules.min_gap_mm),
        *_folds(pad, lines, rules.min_gap_mm),
        *_crossings(pad, rules),
        *_common_tracks(lines, pad.layout, rules.max_common_track_mm),
        *_borders(pad, lines, rules.border_mm),
        *_keep_outs(pad, lines, size, rules.keep_out_mm),
        *_lengths(pad, rules.max_length_mm),
    ]


def tight_bends(pad: Morphology, limit: float, bent_radius_mm: float | None = None) -> list[Violation]:
    """The tightest bend of every fibre that breaks `min_bend_radius_mm` = `limit`, on the cylinder it is worn on."""
    if limit == 0:
        return []
    window = min(limit / 2, *pad.layout.size_mm)  # no fibre is shorter than the pad
    angle = window / limit
    spans, slopes = beziers(pad), slope_beziers(pad)
    turned = np.abs(np.diff(extreme_headings(slopes), prepend=0, append=0)).sum(axis=1)  # leads have heading 0
    around = 0.0 if bent_radius_mm is None else window / bent_radius_mm  # most that it turns so, in a window
    found = []
    for fibre in map(int, np.flatnonzero(turned + around > angle)):
        course = spans[fibre].tobytes(), slopes[fibre].tobytes()
        radius, place = _least_bend(*course, pad.layout.family(fibre), pad.unit_mm, window, limit, bent_radius_mm)
        if radius < limit:
            found.append(Violation("min_bend_radius_mm", (fibre + 1,), radius, limit, _place(pad.to_mm(place))))
    return found


@lru_cache(maxsize=_REMEMBERED)
def _least_bend(
    spans: bytes, slopes: bytes, family: int, unit_mm: float, window: float, limit: float, bent_radius_mm: float | None
) -> tuple[float, Array]:
    """`bend_radius` in mm of one fibre, of its Bezier spans in grid units, and where it is, grid units."""
    # An end of the window that falls between two points is off by less than the turn from one to the other.
    curve = np.frombuffer(spans).reshape(-1, 4, 2), np.frombuffer(slopes).reshape(-1, 3)
    points, headings = trace_curve(*curve, step=max(window / limit / 200, _FINEST_TURN))
    points, headings = _with_leads(points * unit_mm, headings, np.eye(2)[family] * window)
    across = family * np.pi / 2
    rolled = 0.0 if bent_radius_mm is None else rolled_turns(points, headings - across, bent_radius_mm)
    radius, place = bend_radius(points, headings, window, rolled)
    return radius, place / unit_mm


def _with_leads(points: Array, headings: Array, lead: Array) -> tuple[Array, Array]:
    """The points (n, 2) and headings (n,) of a fibre with a straight lead (2,) at either end, with a corner there."""
    before, after = np.array([points[0] - lead, points[0]]), np.array([points[-1], points[-1] + lead])
    return np.vstack([before, points, after]), np.pad(headings, 2)


def _gaps(lines: list[Array], layout: Layout, limit: float) -> list[Violation]:
    shapes = np.array([shapely.LineString(line) for line in lines])
    shapely.prepare(shapes)  # a tenth of the time where fibres are tangled
    found = []
    for rows in layout.families:
        offset, family = rows.start, shapes[rows]
        near = shapely.STRtree(family).query(family, predicate="dwithin", distance=limit).T
        for first, second in sorted((int(i), int(j)) for i, j in near if i < j):
            between = shapely.shortest_line(family[first], family[second])
            gap = float(between.length)
            if gap < limit:
                place = np.mean(between.coords, axis=0)
                fibres = (offset + first + 1, offset + second + 1)
                found.append(Violation("min_gap_mm", fibres, gap, limit, _place(place)))
    return found


def _folds(pad: Morphology, lines: list[Array], limit: float) -> list[Violation]:
    if limit == 0:
        return []
    if _FOLD_TOLERANCE * limit > _TOLERANCE_MM:
        lines = [pad.to_mm(points) for points in flatten(pad, _FOLD_TOLERANCE * limit / pad.unit_mm)]
    found = []
    for fibre in np.flatnonzero(np.ptp(extreme_headings(slope_beziers(pad)), axis=1) > UNFOLDED):
        fold = _least_fold(lines[fibre].tobytes(), limit)
        if fold is not None:
            found.append(Violation("min_gap_mm", (int(fibre) + 1,), fold[0], limit, _place(fold[1])))
    return found


@lru_cache(maxsize=_REMEMBERED)
def _least_fold(line: bytes, limit: float) -> tuple[float, Array] | None:
    return fold_gap(np.frombuffer(line).reshape(-1, 2), limit)


def _crossings(pad: Morphology, rules: RulesSettings) -> list[Violation]:
    most, least_angle = rules.max_crossings, rules.min_crossing_angle_deg
    met = crossings(pad, _CROSSING_TOLERANCE, across=most is not None or least_angle > 0)
    horizontals = pad.layout.horizontals
    across = [c for c in met if c.first < horizontals <= c.second]
    same = [c for c in met if (c.first < horizontals) == (c.second < horizontals)]
    found = []
    if len(same) > rules.same_family_crossings:
        count, limit = len(same), rules.same_family_crossings
        found += [Violation("same_family_crossings", _pair(c), count, limit, _place(pad.to_mm(c.place))) for c in same]
    if most is not None and len(across) > most:
        found.append(Violation("max_crossings", (), len(across), most))
    return found + (_angles(pad, across, least_angle) if least_angle > 0 else [])


def _angles(pad: Morphology, across: list[Crossing], limit: float) -> list[Violation]:
    angles = crossing_angles(pad, across)
    worst: dict[tuple[int, int], Violation] = {}
    for i in np.argsort(angles, kind="stable")[: np.count_nonzero(angles < limit)]:  # a pair's least angle comes first
        place = _place(pad.to_mm(across[i].place))
        worst.setdefault(
            _pair(across[i]), Violation("min_crossing_angle_deg", _pair(across[i]), float(angles[i]), limit, place)
        )
    return [worst[pair] for pair in sorted(worst)]


def _common_tracks(lines: list[Array], layout: Layout, limit: float | None) -> list[Violation]:
    """The longest stretch of each pair of a horizontal and a vertical that have more than `limit` in common."""
    if limit is None or not min(layout.counts):
        return []
    longest: dict[tuple[int, int], Violation] = {}
    for one, other in (layout.families, layout.families[::-1]):
        shared = common_stretches(lines[one], lines[other], TRACK_WIDTH_MM)
        for i in np.flatnonzero(shared.length > limit).tolist():
            fibre, length = one.start + int(shared.line[i]), float(shared.length[i])
            pair = (
                min(fibre, other.start + int(shared.other[i])) + 1,
                max(fibre, other.start + int(shared.other[i])) + 1,
            )
            if pair not in longest or longest[pair].measured < length:
                middle = shapely.LineString(lines[fibre]).interpolate(shared.begin[i] + length / 2)
                longest[pair] = Violation("max_common_track_mm", pair, length, limit, (middle.x, middle.y))
    return [longest[pair] for pair in sorted(longest)]


def _borders(pad: Morphology, lines: list[Array], limit: float) -> list[Violation]:
    found = []
    for fibre, line in enumerate(lines):
        across = 1 - pad.layout.family(fibre)
        distance = pad.layout.size_mm[across] / 2 - np.abs(line[:, across])
        worst = int(np.argmin(distance))
        if distance[worst] < limit:
            found.append(Violation("border_mm", (fibre + 1,), float(distance[worst]), limit, _place(line[worst])))
    return found


def _keep_outs(pad: Morphology, lines: list[Array], size: PadSettings, limit: float) -> list[Violation]:
    """The place of every fibre that is nearest to each polygon, or the middle of the longest way through it."""
    found = []
    for polygon in shapely.transform(keep_outs(size), pad.to_mm):
        for fibre, line in enumerate(lines):
            curve = shapely.LineString(line)
            between = shapely.shortest_line(curve, polygon)
            inside = curve.intersection(polygon)
            if not inside.is_empty:
                longest = max(shapely.get_parts(inside), key=lambda part: part.length)
                place = longest.interpolate(0.5, normalized=True)
                found.append(Violation("keep_out_mm", (fibre + 1,), 0.0, limit, (place.x, place.y)))
            elif between.length < limit:
                found.append(
                    Violation("keep_out_mm", (fibre + 1,), between.length, limit, _place(np.array(between.coords[0])))
                )
    return found


def _lengths(pad: Morphology, limit: float) -> list[Violation]:
    long = lengths(pad) * pad.unit_mm
    return [Violation("max_length_mm", (int(f) + 1,), float(long[f]), limit) for f in np.flatnonzero(long > limit)]


def _pair(crossing: Crossing) -> tuple[int, int]:
    return crossing.first + 1, crossing.second + 1


def _place(point: Array) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _amount(value: float) -> str:
    """Three digits, but no fewer than a count has."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
