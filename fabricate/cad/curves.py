"""Outlines as exact curves: a finely drawn ring is converted to straight lines, arcs and cubic splines.

A ring is cut at corners, at the ends of straight edges and where the curvature jumps. Each smooth run between two cuts
becomes an arc if one fits, otherwise a cubic spline; its ends are exact, and tangent to a smooth neighbour. Lengths are
mm.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from shapely.geometry.base import BaseGeometry

from padforge.design.paths.curves import arc_lengths, slopes
from padforge.fabricate.plan import Plan, polygon_rings

Array = NDArray[np.float64]
Arc = tuple[float, float, float, float, float]
"""Centre x and y, radius, start angle and swept angle (positive counter-clockwise), radians."""
Joints = dict[tuple[float, float], Array]  # direction (2,) of the fibre at every joint, by x and y in mm

FINE_MM = 3e-4  # tolerance of the drawn rings against the exact outlines; their vertices are much closer
MAX_SPANS = 8
"""Longer splines are cut: the CAD kernel's default integration is inexact on edges of many spans (1.4e-4 at twelve)."""
_JOINT_MM = 1e-3  # maximum distance of a joint from its outline; others lie inside, where walls merge
_STRAIGHT_MM = 1e-3  # sagitta above which an edge is no chord of a drawn curve, whose sagitta is several times less
_ARC_TOLERANCE_MM = 1e-4  # tolerance of arcs and straight runs
_KNOT_DECIMALS = 4  # decimals of knots, mm; further ones lengthen STEP files and depend on memory alignment
_MIN_SPAN_MM = 1e-3  # minimum distance of inner knots from the ends
_ALONG_FACTOR = 20  # tolerance along the curve relative to that across; errors along hardly change the shape


@dataclass(frozen=True, eq=False)
class OutlineCurve:
    """A smooth run of an outline: a straight line unless it has an arc or a spline."""

    points: Array  # vertices of an arc, the two ends of a line or a spline; shape (n, 2)
    spline: BSpline | None = None  # cubic, over about its arc length
    arc: Arc | None = None


def find_joints(plan: Plan, fibre: int, half_mm: float) -> Joints:
    """Return the joints of the walls `half_mm` beside a fibre, where the curvature jumps: those beside its knots."""
    knots, slope = plan.pad.to_mm(plan.pad.knots[fibre]), slopes(plan.pad)[fibre]
    along = np.stack([np.ones_like(slope), slope], axis=1)[:, :: -1 if plan.family(fibre) else 1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    offset = half_mm * np.stack([-along[:, 1], along[:, 0]], axis=1)
    walls = np.vstack([knots + offset, knots - offset])
    return dict(zip(map(tuple, walls.tolist()), np.vstack([along, along]), strict=True))


def insert_joints(area: BaseGeometry, joints: Joints) -> BaseGeometry:
    """Return the area with a vertex at every joint on its outline."""
    points = np.array(list(joints))
    polygons = [[_insert_vertices(ring, points) for ring in rings] for rings in polygon_rings(area)]
    return shapely.MultiPolygon([shapely.Polygon(outer, holes) for outer, *holes in polygons])


def _insert_vertices(ring: Array, points: Array) -> Array:
    line = shapely.LinearRing(ring)
    near = points[shapely.dwithin(line, shapely.points(points), _JOINT_MM)]
    s = np.concatenate([arc_lengths(ring), shapely.line_locate_point(line, shapely.points(near))])
    vertices = np.vstack([ring, near])[np.argsort(s, kind="stable")]
    return vertices[np.linalg.norm(vertices - np.roll(vertices, 1, axis=0), axis=1) > 1e-9]


def ring_curves(ring: Array, joints: Joints, fit_mm: float) -> Iterator[OutlineCurve]:
    """Yield the curves of one closed ring (n, 2) in order; its first point is not repeated."""
    edges = np.roll(ring, -1, axis=0) - ring
    length = np.linalg.norm(edges, axis=1)
    previous = np.roll(edges, 1, axis=0)
    cross = previous[:, 0] * edges[:, 1] - previous[:, 1] * edges[:, 0]
    turn = np.abs(np.arctan2(cross, (previous * edges).sum(axis=1)))
    corner = turn > 0.2  # vertices of finely drawn curves turn less
    straight = _is_straight(length, turn, corner)
    joint = np.array([vertex in joints for vertex in map(tuple, ring.tolist())])
    cuts = np.flatnonzero(corner | straight | np.roll(straight, 1) | joint)
    if not len(cuts):  # a smooth closed curve is cut into halves
        cuts = np.array([0, len(ring) // 2])

    def tangent(vertex: int) -> Array | None:
        """Return the direction of the ring at a vertex; None at corners and where it is unknown."""
        if corner[vertex]:
            return None
        if straight[vertex]:
            return edges[vertex] / length[vertex]
        if straight[vertex - 1]:
            return previous[vertex] / length[vertex - 1]
        direction = joints.get((ring[vertex, 0], ring[vertex, 1]))
        return None if direction is None else direction * np.sign(direction @ edges[vertex])

    for first, last in zip(cuts.tolist(), np.roll(cuts, -1).tolist(), strict=True):
        count = (last - first - 1) % len(ring) + 1
        points = ring[(first + np.arange(count + 1)) % len(ring)]
        if count == 1:
            yield OutlineCurve(points)
        else:
            yield from _smooth_curves(points, [tangent(first), tangent(last)], fit_mm)


def _is_straight(length: Array, turn: Array, corner: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which edges are straight lines rather than chords of a curve, by their sagitta, length * turn / 8."""
    smooth = np.where(corner, 0.0, turn)
    ends = (~corner).astype(int) + np.roll(~corner, -1)
    mean = (smooth + np.roll(smooth, -1)) / np.maximum(ends, 1)
    return (ends == 0) | (length * mean / 8 > _STRAIGHT_MM)


def _smooth_curves(points: Array, tangents: Sequence[Array | None], fit_mm: float) -> Iterator[OutlineCurve]:
    """Yield the curves of a smooth run of vertices (n, 2), n > 2, with the tangents at its ends, None if unknown."""
    chord = points[-1] - points[0]
    offsets = points - points[0]
    if np.abs(chord[0] * offsets[:, 1] - chord[1] * offsets[:, 0]).max() < _ARC_TOLERANCE_MM * np.linalg.norm(chord):
        yield OutlineCurve(points[[0, -1]])
        return
    if (arc := fit_arc(points)) is not None:
        yield OutlineCurve(points, arc=arc)
        return
    s = arc_lengths(points)
    start, end = tangents
    start = _end_tangent(s, points) if start is None else start
    end = -_end_tangent(s[-1] - s[::-1], points[::-1]) if end is None else end
    for spline in cut_spline(fit_spline(points, (start, end), fit_mm)):
        yield OutlineCurve(spline.c[[0, -1]], spline=spline)


def _end_tangent(s: Array, points: Array) -> Array:
    """Return the direction at the first vertex of the parabola through the first three.

    It is limited to 4 `FINE_MM` / length from that of the first edge, a chord with a sagitta of at most `FINE_MM`.
    """
    a, b = s[1], s[2]
    chord = (points[1] - points[0]) / a
    slope = chord * b / (b - a) - (points[2] - points[0]) / b * a / (b - a)
    turn = np.arctan2(chord[0] * slope[1] - chord[1] * slope[0], chord @ slope)
    turn = np.clip(turn, -4 * FINE_MM / a, 4 * FINE_MM / a)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ chord


def fit_arc(points: Array) -> Arc | None:
    """Fit an arc to vertices (n, 2) by linear least squares (Kasa); None if the error exceeds `_ARC_TOLERANCE_MM`."""
    if len(points) < 5:
        return None
    mean = points.mean(axis=0)
    centred = points - mean
    design_matrix = np.column_stack([2 * centred, np.ones(len(centred))])
    x, y, constant = np.linalg.lstsq(design_matrix, (centred**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(constant + x * x + y * y))
    radial = centred - (x, y)
    if not np.abs(np.linalg.norm(radial, axis=1) - radius).max() < _ARC_TOLERANCE_MM:
        return None
    angles = np.unwrap(np.arctan2(radial[:, 1], radial[:, 0]))
    return mean[0] + x, mean[1] + y, radius, float(angles[0]), float(angles[-1] - angles[0])


def fit_spline(points: Array, tangents: Sequence[Array], fit_mm: float) -> BSpline:
    """Fit a cubic spline of few spans to a polyline, parametrised by its arc length.

    Args:
        points: vertices, more than two, of which the first and the last are exact; shape (n, 2), mm.
        tangents: unit directions (2,) of the spline at its start and its end.
        fit_mm: tolerance across the polyline; along it `_ALONG_FACTOR` times as much.
    """
    s, samples, normals, vertices = _sample_edges(points)
    s *= max(np.round(s[-1], _KNOT_DECIMALS), _MIN_SPAN_MM) / s[-1]

    def fit(knots: Array, rows: NDArray[np.intp] | slice) -> tuple[BSpline, NDArray[np.bool_]]:
        """Fit a spline to the samples `rows`; return it, and the mask of all samples that are within the tolerance."""
        padded = np.concatenate([[knots[0]] * 3, knots, [knots[-1]] * 3])
        basis = BSpline.construct_fast(padded, np.eye(len(padded) - 4), 3)(s)
        poles = _fit_poles(knots, basis[rows], samples[rows], tangents)
        error = basis @ poles - samples
        across = np.abs((error * normals).sum(axis=1))
        is_close = (across <= fit_mm) & ((error**2).sum(axis=1) <= (fit_mm * _ALONG_FACTOR) ** 2)
        return BSpline.construct_fast(padded, poles, 3), is_close

    # 1. Interpolate some samples, the sites, and add sites where the error exceeds the tolerance.
    sites = np.unique(vertices[[0, len(vertices) // 2, -1]])
    while True:
        best, is_close = fit(s[sites], sites)
        gaps = [(a, b) for a, b in pairwise(sites.tolist()) if b > a + 1 and not is_close[a:b].all()]
        if not gaps:
            break
        sites = np.union1d(sites, [_next_site(a, b, vertices) for a, b in gaps])
    # 2. Fit all samples by least squares, with knots at the sites. Leave out each knot without which the fit is still
    # within the tolerance.
    inner = np.unique(np.round(s[sites], _KNOT_DECIMALS))
    inner = inner[(inner > _MIN_SPAN_MM) & (inner < s[-1] - _MIN_SPAN_MM)]
    knots = np.concatenate([s[:1], inner, s[-1:]])
    for removed in (None, *inner):
        remaining = knots if removed is None else knots[knots != removed]
        curve, is_close = fit(remaining, slice(None))
        if is_close.all():
            best, knots = curve, remaining
    return best


def _fit_poles(knots: Array, basis: Array, samples: Array, tangents: Sequence[Array]) -> Array:
    """Return the poles of the least-squares spline with given tangents through the first and the last of the samples.

    `knots` are without their multiplicity, `basis` (n, poles) are the basis functions at the samples (n, 2).
    """
    poles = np.zeros((basis.shape[1], 2))
    poles[0], poles[-1] = samples[0], samples[-1]
    poles[1] = poles[0] + (knots[1] - knots[0]) / 3 * tangents[0]
    poles[-2] = poles[-1] - (knots[-1] - knots[-2]) / 3 * tangents[1]
    if len(poles) > 4:
        inner = basis[:, 2:-2]
        poles[2:-2] = np.linalg.solve(inner.T @ inner, inner.T @ (samples - basis @ poles))
    return poles


def _next_site(a: int, b: int, vertices: NDArray[np.intp]) -> int:
    """Return the next site between two others: the middle vertex, or the middle sample if there is no vertex."""
    inside = vertices[np.searchsorted(vertices, a, side="right") : np.searchsorted(vertices, b)]
    return int(inside[np.abs(inside - (a + b) / 2).argmin()]) if len(inside) else (a + b) // 2


def _sample_edges(points: Array) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Sample a polyline; return arc lengths (m,), points (m, 2), unit normals (m, 2), and the indices of vertices."""
    s = arc_lengths(points)
    length = np.diff(s)
    counts = np.maximum(4, np.ceil(length / 0.1)).astype(int)  # at most 0.1 mm apart
    vertices = np.concatenate([[0], np.cumsum(counts)])
    edge = np.append(np.repeat(np.arange(len(counts)), counts), len(counts) - 1)
    fraction = (np.arange(vertices[-1] + 1) - vertices[edge]) / counts[edge]
    edges = np.diff(points, axis=0)
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / length[:, None]
    return s[edge] + fraction * length[edge], points[edge] + fraction[:, None] * edges[edge], normals[edge], vertices


def cut_spline(curve: BSpline) -> Iterator[BSpline]:
    """Yield the pieces of a cubic spline, each from 0, cut at knots so that none has more than `MAX_SPANS` spans."""
    knots = np.unique(curve.t)
    n_pieces = -(-(len(knots) - 1) // MAX_SPANS)
    cuts = knots[np.linspace(0, len(knots) - 1, n_pieces + 1).round().astype(int)]
    for knot in cuts[1:-1]:
        curve = curve.insert_knot(knot, 3)
    for start, end in pairwise(cuts):
        first, last = np.searchsorted(curve.t, start), np.searchsorted(curve.t, end, side="right")
        yield BSpline(curve.t[first:last] - start, curve.c[first : last - 4], 3)
