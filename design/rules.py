"""Rules that make a pad buildable, checked exactly on the finished curves, each finding with place and amount (mm).

The search has a differentiable penalty for each of them (`descent`); what counts is the check here.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from .curves import crossings, flatten, lengths
from .morphology import Morphology
from .settings import Rules

Array = NDArray[np.float64]

_TOLERANCE_MM = 1e-3


@dataclass(frozen=True)
class Violation:
    """One broken rule.

    Attributes:
        rule: the setting's name in `[rules]`.
        fibres: the fibres concerned, 1..2M (horizontals bottom to top, then verticals left to right).
        measured, limit: what was found and what is allowed, mm (or a count).
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
        return f"{self.rule}: {names}{place}: {self.measured:.3g}, limit {self.limit:.3g}"


def check(pad: Morphology, rules: Rules) -> list[Violation]:
    """Every rule of `[rules]` that `pad` breaks, worst place per fibre or pair of fibres."""
    lines = [pad.to_mm(points) for points in flatten(pad, _TOLERANCE_MM / pad.pitch_mm)]
    return [
        *_bends(lines, rules.min_bend_radius_mm),
        *_gaps(lines, rules.min_gap_mm),
        *_crossings(pad, rules.same_family_crossings),
        *_borders(pad, lines, rules.border_mm),
        *_lengths(pad, rules.max_length_mm),
    ]


def bend_radius(line: Array, window_mm: float) -> tuple[float, int]:
    """Least bend radius of a polyline (n, 2) and the vertex it starts at.

    A PCHIP curve is only C1, so its pointwise curvature says nothing about how a fibre of finite stiffness lies.
    The radius here is `window_mm` divided by the angle the curve turns in any stretch of that length.
    """
    steps = np.diff(line, axis=0)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(heading)))])  # at the inner vertices, the start first
    before = np.concatenate([[0.0], turned])[: len(arc)]  # turned up to, but not at, each vertex
    last = np.searchsorted(arc, arc + window_mm, side="right") - 1
    after = turned[np.minimum(last, len(turned) - 1)]
    angle = after - before
    worst = int(np.argmax(angle))
    return (window_mm / float(angle[worst]) if angle[worst] > 0 else np.inf), worst


def _bends(lines: list[Array], limit: float) -> list[Violation]:
    found = []
    for fibre, line in enumerate(lines):
        if limit > 0:
            radius, vertex = bend_radius(line, window_mm=limit)
            if radius < limit:
                found.append(Violation("min_bend_radius_mm", (fibre + 1,), radius, limit, _place(line[vertex])))
    return found


def _gaps(lines: list[Array], limit: float) -> list[Violation]:
    shapes = [shapely.LineString(line) for line in lines]
    tree = shapely.STRtree(shapes)
    found = []
    for first, second in _family_pairs(len(lines), tree.query(shapes, predicate="dwithin", distance=limit).T):
        gap = float(shapes[first].distance(shapes[second]))
        if gap < limit:
            nearest = shapely.shortest_line(shapes[first], shapes[second])
            place = _place(np.mean(nearest.coords, axis=0))
            found.append(Violation("min_gap_mm", (first + 1, second + 1), gap, limit, place))
    return found


def _crossings(pad: Morphology, limit: int) -> list[Violation]:
    same = [c for c in crossings(pad) if (c.first < pad.grid) == (c.second < pad.grid)]
    if len(same) <= limit:
        return []
    return [
        Violation("same_family_crossings", (c.first + 1, c.second + 1), len(same), limit, _place(pad.to_mm(c.place)))
        for c in same
    ]


def _borders(pad: Morphology, lines: list[Array], limit: float) -> list[Violation]:
    found = []
    for fibre, line in enumerate(lines):
        cross = line[:, 1] if fibre < pad.grid else line[:, 0]
        distance = pad.size_mm / 2 - np.abs(cross)
        worst = int(np.argmin(distance))
        if distance[worst] < limit:
            found.append(Violation("border_mm", (fibre + 1,), float(distance[worst]), limit, _place(line[worst])))
    return found


def _lengths(pad: Morphology, limit: float) -> list[Violation]:
    long = lengths(pad) * pad.pitch_mm
    return [Violation("max_length_mm", (int(f) + 1,), float(long[f]), limit) for f in np.flatnonzero(long > limit)]


def _family_pairs(fibres: int, pairs: NDArray[np.int64]) -> list[tuple[int, int]]:
    grid = fibres // 2
    return sorted((int(i), int(j)) for i, j in pairs if i < j and (i < grid) == (j < grid))


def _place(point: Array) -> tuple[float, float]:
    return float(point[0]), float(point[1])
