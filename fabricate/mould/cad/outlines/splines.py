"""Cubic splines that follow a polyline with few spans. Lengths are mm."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

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
