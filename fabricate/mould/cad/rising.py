"""What rises over a stretch of an outline: its curves at any height, and the upright surface through them.

Lines rise to planes, arcs to cylinders and splines to spline surfaces; a surface's second parameter is the height, its
first that of the curve. Lengths are mm.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import math
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from OCP.collections import Array1_double, Array1_gp_Pnt, Array1_gp_Pnt2d, Array1_int, Array2_gp_Pnt
from OCP.Geom import (
    Geom_BSplineCurve,
    Geom_BSplineSurface,
    Geom_Circle,
    Geom_CylindricalSurface,
    Geom_Ellipse,
    Geom_Line,
    Geom_Plane,
)
from OCP.Geom2d import Geom2d_BSplineCurve, Geom2d_Line
from OCP.gp import gp_Ax2, gp_Ax3, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d
from scipy.interpolate import BSpline, make_interp_spline

from .outlines.arrangement import Chain
from .outlines.pieces import Piece
from .outlines.splines import stretch

Array = NDArray[np.float64]
Height = float | Callable[[Array], Array]
"""A height, mm, or what gives the heights (n,) over places (n, 2) of a plane that is not level."""

_UP = gp_Dir(0, 0, 1)
_PLACES, _SPARE_MM = 33, 0.01
"""A curve that is not level is looked at in so many places for its extreme heights, and might pass them so far."""
_SITES = 65
"""Places through which the parameters of an ellipse are drawn on its cylinder."""
_KEPT = 256
"""So many curves and surfaces are kept for the other chains of their piece."""
_ALONE = 0.4
"""A stretch of less than this share of its piece has a curve of its own at heights where nobody shares the whole."""


class Rising(Protocol):
    """What rises over a stretch of a piece.

    Attributes:
        rightward: whether the surface's own normal points to the right of who walks along the piece.
    """

    rightward: bool

    def curve(self, z: Height) -> tuple[Any, float, float]:
        """The curve at a height, with its first and its last parameter."""
        ...

    def surface(self, bottom: Height, top: Height) -> Any:
        """The upright surface between two heights, or more of it."""
        ...

    def across(self, z: Height) -> Any:
        """The curve at a height, in the surface's parameters; None where the surface is a plane."""
        ...

    def upright(self, end: int, z: float) -> Any:
        """The line upwards from a height at the start (0) or the end (1), in the surface's parameters, or None."""
        ...


def rising(piece: Piece, chain: Chain, ends: Array) -> Rising:
    """What rises over a chain whose nodes lie at `ends` (2, 2)."""
    if piece.curve is not None:
        return _Spline(piece, piece.curve, chain)
    return _Line(ends) if piece.arc is None else _Arc(piece.arc, piece.length, chain)


class _Line:
    rightward = True

    def __init__(self, ends: Array) -> None:
        self._ends = ends

    def curve(self, z: Height) -> tuple[Any, float, float]:
        start, end = (gp_Pnt(*xy, height) for xy, height in zip(self._ends.tolist(), _at(z, self._ends), strict=True))
        towards = gp_Dir(end.X() - start.X(), end.Y() - start.Y(), end.Z() - start.Z())
        return Geom_Line(start, towards), 0.0, start.Distance(end)

    def surface(self, bottom: Height, top: Height) -> Any:
        (x0, y0), (x1, y1) = self._ends.tolist()
        return Geom_Plane(gp_Pnt(x0, y0, _at(bottom, self._ends)[0]), gp_Dir(y1 - y0, x0 - x1, 0))

    def across(self, z: Height) -> None:
        return None

    def upright(self, end: int, z: float) -> None:
        return None


class _Arc:
    """Its parameter is the angle, counted clockwise for an arc that runs so."""

    def __init__(self, arc: tuple[float, float, float, float, float], length: float, chain: Chain) -> None:
        *self._centre, self._radius, start, sweep = arc
        self.rightward = sweep > 0
        self._sign = 1 if sweep > 0 else -1
        first, last = (self._sign * (start + sweep * s / length) for s in (chain.start, chain.end))
        whole = 2 * math.pi * math.floor(first / (2 * math.pi))
        self._range = first - whole, last - whole

    def curve(self, z: Height) -> tuple[Any, float, float]:
        if callable(z):
            return self._ellipse(z)
        frame = gp_Ax2(gp_Pnt(*self._centre, z), gp_Dir(0, 0, self._sign), gp_Dir(1, 0, 0))
        return Geom_Circle(frame, self._radius), *self._range

    def _ellipse(self, z: Callable[[Array], Array]) -> tuple[Any, float, float]:
        """That of a plane that leans; its parameter is the angle from where the plane rises."""
        middle, rise, towards = self._lean(z)
        x, y = math.cos(towards), math.sin(towards)
        normal = gp_Dir(-rise * x * self._sign, -rise * y * self._sign, self._radius * self._sign)
        frame = gp_Ax2(gp_Pnt(*self._centre, middle), normal, gp_Dir(self._radius * x, self._radius * y, rise))
        first, last = (angle - self._sign * towards for angle in self._range)
        return Geom_Ellipse(frame, math.hypot(self._radius, rise), self._radius), first, last

    def _lean(self, z: Callable[[Array], Array]) -> tuple[float, float, float]:
        """A plane's height over the centre, how far it rises over the radius, and the angle towards where it does."""
        middle, along_x, along_y = z(np.add(self._centre, self._radius * np.array([[0, 0], [1, 0], [0, 1]]))).tolist()
        return middle, math.hypot(along_x - middle, along_y - middle), math.atan2(along_y - middle, along_x - middle)

    def surface(self, bottom: Height, top: Height) -> Any:
        return Geom_CylindricalSurface(gp_Ax3(gp_Pnt(*self._centre, 0), _UP, gp_Dir(1, 0, 0)), self._radius)

    def across(self, z: Height) -> Any:
        if not callable(z):
            return Geom2d_Line(gp_Pnt2d(0, z), gp_Dir2d(self._sign, 0))
        middle, rise, towards = self._lean(z)
        sites = np.linspace(*self._ellipse(z)[1:], _SITES)
        places = np.stack([self._sign * sites + towards, middle + rise * np.cos(sites)], axis=1)
        curve = make_interp_spline(sites, places, k=3)
        return _flat_spline(curve, curve.c)

    def upright(self, end: int, z: float) -> Any:
        return Geom2d_Line(gp_Pnt2d(self._sign * self._range[end], z), gp_Dir2d(0, 1))


class _Spline:
    """The surface's first parameter is the length along the piece, and so is that of its curves.

    Curves are those of the whole piece, which chains share: files say them once.
    """

    rightward = True

    def __init__(self, piece: Piece, curve: BSpline, chain: Chain) -> None:
        self._rise, self._whole = piece.rise, curve
        self._range = chain.start, chain.end
        self._short = chain.end - chain.start < _ALONE * piece.length

    @cached_property
    def _along(self) -> Array:
        return self._whole(np.linspace(*self._range, _PLACES))

    @cached_property
    def _own(self) -> BSpline:
        return stretch(self._whole, *self._range)

    def _part(self, z: Height) -> BSpline:
        alone = callable(z) or (self._short and z not in self._rise)
        return self._own if alone else self._whole

    def curve(self, z: Height) -> tuple[Any, float, float]:
        part = self._part(z)
        if part is self._whole:
            return _level_curve(part, z), *self._range
        return _raised_curve(part, _at(z, part.c)), *self._range

    def surface(self, bottom: Height, top: Height) -> Any:
        low = min(_at(bottom, self._along)) - _SPARE_MM if callable(bottom) else bottom
        high = max(_at(top, self._along)) + _SPARE_MM if callable(top) else top
        low, high = min(self._rise[0], low), max(self._rise[1], high)
        return _upright_surface(self._whole, low, high)

    def across(self, z: Height) -> Any:
        if not callable(z):
            return Geom2d_Line(gp_Pnt2d(0, z), gp_Dir2d(1, 0))
        part = self._part(z)
        greville = (part.t[1:-3] + part.t[2:-2] + part.t[3:-1]) / 3
        return _flat_spline(part, np.column_stack([greville, _at(z, part.c)]))

    def upright(self, end: int, z: float) -> Any:
        return Geom2d_Line(gp_Pnt2d(self._range[end], z), gp_Dir2d(0, 1))


def upright_line(x: float, y: float, z: float) -> Any:
    """The line upwards from a point."""
    return Geom_Line(gp_Pnt(x, y, z), _UP)


def _at(z: Height, places: Array) -> list[float]:
    return z(places).tolist() if callable(z) else [z] * len(places)


@lru_cache(_KEPT)
def _level_curve(curve: BSpline, z: float) -> Any:
    return _raised_curve(curve, [z] * len(curve.c))


def _raised_curve(curve: BSpline, heights: list[float]) -> Any:
    return Geom_BSplineCurve(_points(np.column_stack([curve.c, heights])), *_knots(curve), 3)


@lru_cache(_KEPT)
def _upright_surface(curve: BSpline, low: float, high: float) -> Any:
    poles = Array2_gp_Pnt(1, len(curve.c), 1, 2)
    for row, (x, y) in enumerate(curve.c.tolist(), 1):
        poles.SetValue(row, 1, gp_Pnt(x, y, low))
        poles.SetValue(row, 2, gp_Pnt(x, y, high))
    knots, counts = _knots(curve)
    return Geom_BSplineSurface(poles, knots, _reals([low, high]), counts, _ints([2, 2]), 3, 1)


@lru_cache(_KEPT)
def _knots(curve: BSpline) -> tuple[Any, Any]:
    """The knots of a spline, and how often each counts."""
    knots, counts = np.unique(curve.t, return_counts=True)
    return _reals(knots), _ints(counts)


def _flat_spline(curve: BSpline, poles: Array) -> Any:
    """The spline of other poles (n, 2), in a surface's parameters."""
    places = Array1_gp_Pnt2d(1, len(poles))
    for i, (u, v) in enumerate(poles.tolist(), 1):
        places.SetValue(i, gp_Pnt2d(u, v))
    return Geom2d_BSplineCurve(places, *_knots(curve), 3)


def _points(points: Array) -> Any:
    array = Array1_gp_Pnt(1, len(points))
    for i, (x, y, z) in enumerate(points.tolist(), 1):
        array.SetValue(i, gp_Pnt(x, y, z))
    return array


def _reals(values: Any) -> Any:
    array = Array1_double(1, len(values))
    for i, value in enumerate(np.asarray(values, float).tolist(), 1):
        array.SetValue(i, value)
    return array


def _ints(values: Any) -> Any:
    array = Array1_int(1, len(values))
    for i, value in enumerate(np.asarray(values, int).tolist(), 1):
        array.SetValue(i, value)
    return array
