"""Cubic splines that follow a polyline with few spans. Lengths are mm."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

Array = NDArray[np.float64]

MOST_SPANS = 6
"""Longer splines are cut: the CAD kernel's areas and volumes are inexact where an edge has many spans."""
_PARTS = 4
"""A curve is looked at in so many places of every edge: between far vertices it might stray."""
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

    places, drawn, normals = _divided(points)

    def near(curve: BSpline) -> NDArray[np.bool_]:
        off = curve(places) - drawn
        return np.maximum(np.abs((off * normals).sum(axis=1)), np.linalg.norm(off, axis=1) / _ALONG) <= fit_mm

    sites = np.unique(np.linspace(0, (len(places) - 1) // _PARTS, 3).astype(int)) * _PARTS
    while True:
        best = make_interp_spline(places[sites], drawn[sites], k=3, bc_type=([(1, ends[0])], [(1, ends[1])]))
        good = near(best)
        bad = [(a, b) for a, b in pairwise(sites.tolist()) if b > a + 1 and not good[a:b].all()]
        if not bad:
            break
        sites = np.union1d(sites, [_between(a, b) for a, b in bad])
    low, high = (len(sites) - 1) // 3, len(sites) - 1  # spans that are too few, and that are enough
    while high - low > 1:
        spans = (low + high) // 2
        knots = np.interp(np.linspace(0, 1, spans + 1), np.linspace(0, 1, len(sites)), places[sites])
        curve = _least_squares(knots, places, drawn, ends)
        if near(curve).all():
            best, high = curve, spans
        else:
            low = spans
    return best


def _least_squares(knots: Array, places: Array, drawn: Array, ends: Sequence[Array]) -> BSpline:
    """The cubic spline over knots that is nearest to drawn points, with their ends, in the given directions."""
    padded = np.concatenate([[knots[0]] * 3, knots, [knots[-1]] * 3])
    poles = np.zeros((len(knots) + 2, 2))
    poles[0], poles[-1] = drawn[0], drawn[-1]
    poles[1] = poles[0] + (knots[1] - knots[0]) / 3 * ends[0]
    poles[-2] = poles[-1] - (knots[-1] - knots[-2]) / 3 * ends[1]
    if len(poles) > 4:
        basis = BSpline.design_matrix(places, padded, 3).toarray()
        inner = basis[:, 2:-2]
        poles[2:-2] = np.linalg.solve(inner.T @ inner, inner.T @ (drawn - basis @ poles))
    return BSpline(padded, poles, 3)


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


def _between(a: int, b: int) -> int:
    """Where to look next between two sites: at the middle one of the vertices, or on an edge if there is none."""
    vertex = round((a + b) / 2 / _PARTS) * _PARTS
    return vertex if a < vertex < b else (a + b) // 2


def lengths(points: Array) -> Array:
    """(n,) length along a polyline (n, 2) up to each vertex."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _divided(points: Array) -> tuple[Array, Array, Array]:
    """Lengths (m,), points (m, 2), unit normals (m, 2) of `_PARTS` places on every edge of a polyline, and its end."""
    s = lengths(points)
    vertices = np.arange(_PARTS * (len(s) - 1) + 1) / _PARTS
    edge = np.minimum(vertices.astype(int), len(s) - 2)
    edges = np.diff(points, axis=0)
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.diff(s)[:, None]
    share = vertices - edge
    return s[edge] + share * np.diff(s)[edge], points[edge] + share[:, None] * edges[edge], normals[edge]
