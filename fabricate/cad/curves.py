"""Smooth pieces of outlines: a finely drawn ring becomes straight lines, arcs and cubic splines that follow it.

A ring is cut where it has a corner, where a straight edge begins or ends, and where the curvature jumps. What is left
between two cuts is smooth, and one curve follows all of it: a circle's arc where one does, else a cubic spline. Its
ends are exact, and tangent to what goes on smoothly from there. Lengths are mm.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from shapely.geometry.base import BaseGeometry

from padforge.design.paths.curves import slopes
from padforge.fabricate.plan import Plan, polygon_rings

Array = NDArray[np.float64]
Joints = dict[tuple[float, float], Array]
"""Of every joint, x and y, mm, the direction (2,) of its fibre."""

_NEAR_MM = 1e-3
"""A joint further from an outline is inside it: there the walls of two fibres, or of one that folds, run into one."""


def joints(plan: Plan, level: int, half_mm: float) -> Joints:
    """The joints of the walls, `half_mm` from their fibres, of all fibres of a level."""
    found: Joints = {}
    for fibre, (knots, slope) in enumerate(zip(plan.pad.to_mm(plan.pad.knots), slopes(plan.pad), strict=True)):
        if plan.layer_indices[fibre] == level:
            along = np.stack([np.ones_like(slope), slope], axis=1)[:, :: -1 if plan.family(fibre) else 1]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            beside = half_mm * np.stack([-along[:, 1], along[:, 0]], axis=1)
            for places in (knots + beside, knots - beside):
                found |= zip(map(tuple, places.tolist()), along, strict=True)
    return found


def with_joints(area: BaseGeometry, places: Joints) -> BaseGeometry:
    """The area with a vertex at every joint on its outline."""
    points = np.array(list(places))
    polygons = [
        shapely.Polygon(*_split([_with_vertices(ring, points) for ring in rings])) for rings in polygon_rings(area)
    ]
    return shapely.MultiPolygon(polygons)


def _split(rings: list[Array]) -> tuple[Array, list[Array]]:
    return rings[0], rings[1:]


def _with_vertices(ring: Array, points: Array) -> Array:
    line = shapely.LinearRing(ring)
    near = points[shapely.dwithin(line, shapely.points(points), _NEAR_MM)]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    at = np.concatenate([along, shapely.line_locate_point(line, shapely.points(near))])
    order = np.argsort(at, kind="stable")
    vertices = np.vstack([ring, near])[order]
    return vertices[np.linalg.norm(vertices - np.roll(vertices, 1, axis=0), axis=1) > 1e-9]


Array = NDArray[np.float64]

MOST_SPANS = 6
"""Longer splines are cut: the CAD kernel's areas and volumes are inexact where an edge has many spans."""
_PARTS, _FAR_MM = 4, 0.1
"""A curve is looked at in so many places of every edge, and no further apart: between far vertices it might stray."""
_ALONG = 20
"""A parameter may be so many times the tolerance away from the length along the polyline: that changes no shape."""


def spline(points: Array, ends: Sequence[Array], fit_mm: float) -> BSpline:
    """The cubic spline of about the fewest spans that stays near a polyline, over the length along it.

    Args:
        points: (n, 2) its vertices, n > 2; those at its ends are exact. ends: directions (2,) of unit length there.
        fit_mm: how near the spline is to all of it, mm.

    Interpolation through sites that are halved where it strays shows how densely knots are needed; with knots as
    dense in proportion, fewer and fewer, the poles between the ends are then found by least squares.
    """

    places, drawn, normals, vertices = _divided(points)

    def fitted(knots: Array, at: NDArray[np.intp] | slice) -> tuple[BSpline, NDArray[np.bool_]]:
        """The spline over knots that is nearest to drawn points, and where it stays near what is drawn."""
        padded = np.concatenate([[knots[0]] * 3, knots, [knots[-1]] * 3])
        basis = _basis(padded, places)
        poles = _poles(knots, basis[at], drawn[at], ends)
        off = basis @ poles - drawn
        near = (np.abs((off * normals).sum(axis=1)) <= fit_mm) & ((off**2).sum(axis=1) <= (fit_mm * _ALONG) ** 2)
        return BSpline.construct_fast(padded, poles, 3), near

    sites = np.unique(vertices[[0, len(vertices) // 2, -1]])
    while True:
        best, near = fitted(places[sites], sites)
        bad = [(a, b) for a, b in pairwise(sites.tolist()) if b > a + 1 and not near[a:b].all()]
        if not bad:
            break
        sites = np.union1d(sites, [_between(a, b, vertices) for a, b in bad])
    low, high = (len(sites) - 1) // 3, len(sites) - 1  # spans that are too few, and that are enough
    while high - low > 1:
        spans = (low + high) // 2
        knots = np.interp(np.linspace(0, 1, spans + 1), np.linspace(0, 1, len(sites)), places[sites])
        curve, near = fitted(knots, slice(None))
        if near.all():
            best, high = curve, spans
        else:
            low = spans
    return best


def _poles(knots: Array, basis: Array, drawn: Array, ends: Sequence[Array]) -> Array:
    """The poles of the cubic spline over knots that is nearest to drawn points (n, 2), with their ends and directions.

    Args:
        basis: (n, poles) share of every pole in every point.
    """
    poles = np.zeros((basis.shape[1], 2))
    poles[0], poles[-1] = drawn[0], drawn[-1]
    poles[1] = poles[0] + (knots[1] - knots[0]) / 3 * ends[0]
    poles[-2] = poles[-1] - (knots[-1] - knots[-2]) / 3 * ends[1]
    if len(poles) > 4:
        inner = basis[:, 2:-2]
        poles[2:-2] = np.linalg.solve(inner.T @ inner, inner.T @ (drawn - basis @ poles))
    return poles


def _basis(padded: Array, places: Array) -> Array:
    """(n, poles) share of every pole of a cubic spline in its points at places (n,), by de Boor's recurrence."""
    last = len(padded) - 5
    span = np.clip(np.searchsorted(padded, places, side="right") - 1, 3, last)
    below = [places - padded[span - i] for i in range(3)]
    above = [padded[span + 1 + i] - places for i in range(3)]
    shares = [np.ones(len(places))]
    for degree in range(1, 4):
        carried, raised = np.zeros(len(places)), []
        for i, share in enumerate(shares):
            part = share / (above[i] + below[degree - 1 - i])
            raised.append(carried + above[i] * part)
            carried = below[degree - 1 - i] * part
        shares = [*raised, carried]
    basis = np.zeros((len(places), last + 1))
    basis[np.arange(len(places))[:, None], span[:, None] + np.arange(-3, 1)] = np.stack(shares, axis=1)
    return basis


def breaks(curve: BSpline) -> Array:
    """Where a spline is cut, its ends excluded, so that no stretch has more than `MOST_SPANS` spans."""
    knots = np.unique(curve.t)
    parts = -(-(len(knots) - 1) // MOST_SPANS)
    return knots[np.linspace(0, len(knots) - 1, parts + 1).round().astype(int)[1:-1]]


def stretch(curve: BSpline, start: float, end: float) -> BSpline:
    """The part of a cubic spline from one parameter to another."""
    nearest = [curve.t[np.abs(curve.t - at).argmin()] for at in (start, end)]
    start, end = (knot if abs(knot - at) < 1e-9 else at for knot, at in zip(nearest, (start, end), strict=True))
    for at in (start, end):
        missing = 4 - int((curve.t == at).sum())
        curve = curve.insert_knot(at, missing) if missing > 0 else curve
    first, last = np.searchsorted(curve.t, start), np.searchsorted(curve.t, end, side="right")
    return BSpline(curve.t[first:last], curve.c[first : last - 4], 3)


def _between(a: int, b: int, vertices: NDArray[np.intp]) -> int:
    """Where to look next between two sites: at the middle one of the vertices, or on an edge if there is none."""
    inside = vertices[np.searchsorted(vertices, a, side="right") : np.searchsorted(vertices, b)]
    return int(inside[np.abs(inside - (a + b) / 2).argmin()]) if len(inside) else (a + b) // 2


def lengths(points: Array) -> Array:
    """(n,) length along a polyline (n, 2) up to each vertex."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _divided(points: Array) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Places to look at on every edge of a polyline: lengths (m,), points (m, 2), unit normals (m, 2), and vertices."""
    s = lengths(points)
    along = np.diff(s)
    parts = np.maximum(_PARTS, np.ceil(along / _FAR_MM)).astype(int)
    vertices = np.concatenate([[0], np.cumsum(parts)])
    edge = np.append(np.repeat(np.arange(len(parts)), parts), len(parts) - 1)
    share = (np.arange(vertices[-1] + 1) - vertices[edge]) / parts[edge]
    edges = np.diff(points, axis=0)
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / along[:, None]
    return s[edge] + share * along[edge], points[edge] + share[:, None] * edges[edge], normals[edge], vertices


Array = NDArray[np.float64]

FINE_MM = 3e-4
"""How near the drawn rings are to the exact outlines: a vertex is far nearer still."""
_CORNER_RAD = 0.2
"""A sharper turn at one vertex is a corner; finely drawn curves turn by less, but where they hardly have a radius."""
_STRAIGHT_MM = 1e-3
"""An edge is straight if it were so much away from its arc otherwise: drawn curves are several times nearer."""
_ARC_MM = 1e-4


@dataclass(frozen=True, eq=False)
class OutlineCurve:
    """A smooth run of an outline from s = 0 to `length`, the length along its vertices.

    Attributes:
        points: (n, 2) vertices. curve: a cubic spline over s, None for lines and arcs.
        arc: centre x and y, radius, angle at the start and angle swept (positive counter-clockwise), radians.
        rise: from what height to what height the wall of its outline stands, mm, where that is known.
    """

    points: Array
    curve: BSpline | None = None
    arc: tuple[float, float, float, float, float] | None = None
    rise: tuple[float, float] = (math.inf, -math.inf)
    length: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "length", float(lengths(self.points)[-1]))

    def at(self, s: Array | float) -> Array:
        """(..., 2) points at lengths (...,) from the start."""
        if self.curve is not None:
            return self.curve(s)
        if self.arc is not None:
            x, y, radius, start, sweep = self.arc
            angle = start + sweep * s / self.length
            return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=-1)
        return self.points[0] + np.multiply.outer(s / self.length, self.points[-1] - self.points[0])

    def tangent(self, s: Array | float) -> Array:
        """(..., 2) derivative of the points by s."""
        if self.curve is not None:
            return self.curve(s, 1)
        if self.arc is not None:
            _, _, radius, start, sweep = self.arc
            angle = start + sweep * s / self.length
            return radius * sweep / self.length * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        return np.broadcast_to((self.points[-1] - self.points[0]) / self.length, (*np.shape(s), 2))

    def run(self, s: float) -> tuple[float, float, float, float]:
        """x and y at a length, and how they grow by it: as `at` and `tangent` say of one place, but sooner."""
        if self.curve is not None:
            return self._de_boor(s)
        if self.arc is not None:
            x, y, radius, start, sweep = self.arc
            angle, turn = start + sweep * s / self.length, radius * sweep / self.length
            cos, sin = math.cos(angle), math.sin(angle)
            return x + radius * cos, y + radius * sin, -turn * sin, turn * cos
        (x0, y0), (x1, y1) = self._numbers[1]
        dx, dy = (x1 - x0) / self.length, (y1 - y0) / self.length
        return x0 + s * dx, y0 + s * dy, dx, dy

    def _de_boor(self, s: float) -> tuple[float, float, float, float]:
        t, poles = self._numbers
        k = min(max(bisect_right(t, s) - 1, 3), len(t) - 5)
        (x0, y0), (x1, y1), (x2, y2), (x3, y3) = poles[k - 3 : k + 1]
        a = (s - t[k - 2]) / (t[k + 1] - t[k - 2])
        b = (s - t[k - 1]) / (t[k + 2] - t[k - 1])
        c = (s - t[k]) / (t[k + 3] - t[k])
        x0, y0, x1, y1 = x0 + a * (x1 - x0), y0 + a * (y1 - y0), x1 + b * (x2 - x1), y1 + b * (y2 - y1)
        x2, y2 = x2 + c * (x3 - x2), y2 + c * (y3 - y2)
        a = (s - t[k - 1]) / (t[k + 1] - t[k - 1])
        b = (s - t[k]) / (t[k + 2] - t[k])
        x0, y0, x1, y1 = x0 + a * (x1 - x0), y0 + a * (y1 - y0), x1 + b * (x2 - x1), y1 + b * (y2 - y1)
        span = t[k + 1] - t[k]
        a = (s - t[k]) / span
        return x0 + a * (x1 - x0), y0 + a * (y1 - y0), 3 * (x1 - x0) / span, 3 * (y1 - y0) / span

    @cached_property
    def _numbers(self) -> tuple[list[float], list[list[float]]]:
        """Knots and poles of a spline, of a line its ends."""
        if self.curve is not None:
            return self.curve.t.tolist(), self.curve.c.tolist()
        return [], self.points[[0, -1]].tolist()


def outline_pieces(area: BaseGeometry, joints: Joints, rise: tuple[float, float], fit_mm: float) -> list[OutlineCurve]:
    """The pieces of all rings of an area whose curves are drawn within `FINE_MM`.

    Args:
        joints: vertices where the curvature jumps; their directions may be those of who walks the other way.
        rise: from what height to what height the outline's wall stands, mm.
        fit_mm: how near splines stay to the rings.
    """
    pieces = (piece for rings in polygon_rings(area) for ring in rings for piece in ring_pieces(ring, joints, fit_mm))
    return [replace(piece, rise=rise) for piece in pieces]


def straight_pieces(lines: BaseGeometry) -> list[OutlineCurve]:
    """Every edge of lines or rings as a piece of its own."""
    ends = (shapely.get_coordinates(line) for line in shapely.get_parts(lines))
    return [OutlineCurve(points[i : i + 2]) for points in ends for i in range(len(points) - 1)]


def ring_pieces(ring: Array, joints: Joints, fit_mm: float) -> Iterator[OutlineCurve]:
    """The pieces of one closed ring (n, 2), first point not repeated, in order."""
    edges = np.roll(ring, -1, axis=0) - ring
    along = np.linalg.norm(edges, axis=1)
    before = np.roll(edges, 1, axis=0)
    turn = np.abs(np.arctan2(before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0], (before * edges).sum(axis=1)))
    corner = turn > _CORNER_RAD
    straight = _straight(along, turn, corner)
    joint = np.array([vertex in joints for vertex in map(tuple, ring.tolist())])
    cuts = np.flatnonzero(corner | straight | np.roll(straight, 1) | joint)
    if not len(cuts):  # smooth all round: two halves
        cuts = np.array([0, len(ring) // 2])

    def direction(vertex: int) -> Array | None:
        """Where the ring runs at a vertex; None at corners, where it runs two ways, and where nobody knows."""
        if corner[vertex]:
            return None
        if straight[vertex]:
            return edges[vertex] / along[vertex]
        if straight[vertex - 1]:
            return before[vertex] / along[vertex - 1]
        given = joints.get((ring[vertex, 0], ring[vertex, 1]))
        return None if given is None else given * np.sign(given @ edges[vertex])

    for first, last in zip(cuts.tolist(), np.roll(cuts, -1).tolist(), strict=True):
        count = (last - first - 1) % len(ring) + 1
        points = ring[(first + np.arange(count + 1)) % len(ring)]
        if count == 1:
            yield OutlineCurve(points)
        else:
            yield from _curved(points, [direction(first), direction(last)], fit_mm)


def _straight(along: Array, turn: Array, corner: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which edges are straight lines rather than chords of a curve."""
    smooth = np.where(corner, 0.0, turn)
    ends = (~corner).astype(int) + np.roll(~corner, -1)
    mean = (smooth + np.roll(smooth, -1)) / np.maximum(ends, 1)
    return (ends == 0) | (along * mean / 8 > _STRAIGHT_MM)


def _curved(points: Array, tangents: list[Array | None], fit_mm: float) -> Iterator[OutlineCurve]:
    """The pieces of a smooth run of vertices (n, 2), n > 2, with the directions at its ends where they are known."""
    if np.abs(_beside(points)).max() < _ARC_MM:
        yield OutlineCurve(points[[0, -1]])
        return
    if (arc := arc_through(points)) is not None:
        yield OutlineCurve(points, arc=arc)
        return
    s = lengths(points)
    ends = [_end_tangent(s, points) if tangents[0] is None else tangents[0]]
    ends.append(_end_tangent(s[-1] - s[::-1], points[::-1]) * -1 if tangents[1] is None else tangents[1])
    curve = spline(points, ends, fit_mm)
    cuts = sorted({0, *np.searchsorted(s, breaks(curve)).tolist(), len(s) - 1})
    for first, last in pairwise(cuts):
        part = stretch(curve, s[first], s[last])
        yield OutlineCurve(points[first : last + 1], curve=BSpline(part.t - part.t[0], part.c, 3))


def arc_through(points: Array) -> tuple[float, float, float, float, float] | None:
    """The circle's arc through vertices (n, 2), or None where no arc is near all of them."""
    if len(points) < 5:
        return None
    middle = points.mean(axis=0)
    away = points - middle
    system = np.column_stack([2 * away, np.ones(len(away))])
    x, y, rest = np.linalg.lstsq(system, (away**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(rest + x * x + y * y))
    from_centre = away - (x, y)
    if not np.abs(np.linalg.norm(from_centre, axis=1) - radius).max() < _ARC_MM:
        return None
    angles = np.unwrap(np.arctan2(from_centre[:, 1], from_centre[:, 0]))
    return middle[0] + x, middle[1] + y, radius, float(angles[0]), float(angles[-1] - angles[0])


def _beside(points: Array) -> Array:
    """(n,) how far points lie to the left of the line from the first to the last."""
    away, along = points - points[0], points[-1] - points[0]
    return (along[0] * away[:, 1] - along[1] * away[:, 0]) / np.linalg.norm(along)


def _end_tangent(s: Array, points: Array) -> Array:
    """Direction at the first vertex: that of the parabola through the first three, as far as the first edge allows.

    An edge is a chord that its curve stays within `FINE_MM` of: directions differ by 4 `FINE_MM` / length at most.
    """
    a, b = s[1], s[2]
    chord = (points[1] - points[0]) / a
    slope = chord * b / (b - a) - (points[2] - points[0]) / b * a / (b - a)
    turn = np.arctan2(chord[0] * slope[1] - chord[1] * slope[0], chord @ slope)
    turn = np.clip(turn, -4 * FINE_MM / a, 4 * FINE_MM / a)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ chord
