"""The fibres as curves: PCHIP spans as cubic Beziers, flattened to a tolerance, and where they cross."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from .kernels.pchip import pchip_slopes
from .morphology import Morphology

Array = NDArray[np.float64]


def slopes(pad: Morphology) -> Array:
    """(2M, N+2) PCHIP slope of the cross coordinate at each knot, per unit of travel."""
    out = np.empty(pad.knots.shape[:2])
    for fibre, (t, v) in enumerate(_travel_and_cross(pad)):
        pchip_slopes(t, v, out[fibre])
    return out


def beziers(pad: Morphology) -> Array:
    """(2M, N+1, 4, 2) Bezier control points of every span: a PCHIP span is exactly one cubic Bezier segment."""
    d = slopes(pad)
    spans = np.empty((len(pad.knots), pad.knots.shape[1] - 1, 4, 2))
    for fibre, (t, v) in enumerate(_travel_and_cross(pad)):
        travel = 0 if fibre < pad.grid else 1
        third = np.diff(t) / 3
        spans[fibre, :, :, travel] = np.stack([t[:-1], t[:-1] + third, t[1:] - third, t[1:]], axis=1)
        rise = np.stack([v[:-1], v[:-1] + third * d[fibre, :-1], v[1:] - third * d[fibre, 1:], v[1:]], axis=1)
        spans[fibre, :, :, 1 - travel] = rise
    return spans


def flatten(pad: Morphology, tolerance: float) -> list[Array]:
    """Each fibre as a polyline (n, 2) within `tolerance` of its curve, in grid units.

    A span is cut into n equal steps of its parameter with n = ceil(sqrt(3 L / (4 tolerance))), L the largest second
    difference of its control points; the chord error is then at most `tolerance` (Wang's bound for cubics).
    """
    lines = []
    for spans in beziers(pad):
        second = np.linalg.norm(np.diff(spans, 2, axis=1), axis=2).max(axis=1)
        counts = np.maximum(1, np.ceil(np.sqrt(0.75 * second / tolerance))).astype(int)
        pieces = [_bezier_points(span, n) for span, n in zip(spans, counts, strict=True)]
        lines.append(np.vstack([*pieces, spans[-1, -1:]]))
    return lines


def lengths(pad: Morphology) -> Array:
    """(2M,) arc length of every fibre in grid units, to about 1e-5 where knots nearly coincide."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    u = ((nodes + 1) / 2)[:, None]
    derivative = 3 * np.diff(beziers(pad), axis=2)[:, :, :, None, :]
    speed = derivative[:, :, 0] * (1 - u) ** 2 + 2 * derivative[:, :, 1] * u * (1 - u) + derivative[:, :, 2] * u**2
    return (np.linalg.norm(speed, axis=-1) @ (weights / 2)).sum(axis=1)


@dataclass(frozen=True)
class Crossing:
    """Two fibres that meet: their indices (0..2M-1, first < second) and the place (x, y) in grid units."""

    first: int
    second: int
    place: tuple[float, float]


def crossings(pad: Morphology, tolerance: float = 1e-4) -> list[Crossing]:
    """Every place where two fibres meet, ordered by fibre and place; fibres are flattened to `tolerance`.

    Fibres that touch or run on each other count at the middle of what they share.
    """
    lines = [shapely.LineString(points) for points in flatten(pad, tolerance)]
    tree = shapely.STRtree(lines)
    pairs = tree.query(lines, predicate="intersects").T
    found = []
    for first, second in sorted(map(tuple, pairs[pairs[:, 0] < pairs[:, 1]])):
        shared = lines[first].intersection(lines[second])
        for part in shapely.get_parts(shapely.line_merge(shared) if shared.length else shared):
            place = part.interpolate(0.5, normalized=True) if part.length else part
            found.append(Crossing(int(first), int(second), (place.x, place.y)))
    return sorted(found, key=lambda c: (c.first, c.second, c.place))


def _travel_and_cross(pad: Morphology) -> list[tuple[Array, Array]]:
    """Travel and cross coordinates of every fibre, contiguous."""
    axes = [0] * pad.grid + [1] * pad.grid
    return [(knots[:, a].copy(), knots[:, 1 - a].copy()) for knots, a in zip(pad.knots, axes, strict=True)]


def _bezier_points(control: Array, count: int) -> Array:
    """`count` points of a cubic Bezier at equal parameter steps, its start included, its end not."""
    u = (np.arange(count) / count)[:, None]
    w = 1 - u
    return w**3 * control[0] + 3 * w**2 * u * control[1] + 3 * w * u**2 * control[2] + u**3 * control[3]
