"""Solids from slabs: faces on planes, cylinders and spline surfaces that share their edges.

Nothing is intersected or fused by the CAD kernel: the boundary is put together face by face. Lengths are mm.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from build123d import Solid
from numpy.typing import NDArray
from OCP.BRep import BRep_Builder
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
from OCP.TopAbs import TopAbs_REVERSED
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Shell, TopoDS_Solid, TopoDS_Vertex, TopoDS_Wire
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from padforge.fabricate.cad.curves import OutlineCurve, stretch
from padforge.fabricate.cad.planar_map import BorderEdge, BorderWire, PlanarMap, Subdivision, Surface, ZRange

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.


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


class Wall(Protocol):
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


def make_wall(piece: OutlineCurve, chain: BorderEdge, ends: Array) -> Wall:
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

    def __init__(self, arc: tuple[float, float, float, float, float], length: float, chain: BorderEdge) -> None:
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

    def __init__(self, piece: OutlineCurve, curve: BSpline, chain: BorderEdge) -> None:
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


# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.


Steps = tuple[int, int, int]
"""Heights over start, end and middle of a chain, in steps of `STEP_MM`."""

STEP_MM, SAME_MM = 1e-7, 1e-5
"""Heights are whole steps, and those no further apart than `SAME_MM` are one."""
EXACT_MM = 1e-6
"""Tolerance of edges and vertices where curves meet as they should."""
_ASTRAY_MM = 5e-3
"""Curves stray less from what they stand for: so near its edge, a track's top may be passed by the wall under it."""


def solids(drawing: Subdivision, spans: Sequence[ZRange | None]) -> Iterator[Solid]:
    """The solids of a part, outward normals, each in one piece.

    Args:
        spans: what the part fills of every cell of the drawing.
    """
    arrangement = PlanarMap(drawing, spans)
    together = _connected(drawing, spans)
    number = {cell: k for k, cells in enumerate(together) for cell in cells}
    around: list[list[int]] = [[] for _ in together]
    for k, chain in enumerate(arrangement.chains):
        around[number[max(chain.left, chain.right)]].append(k)
    for cells, chains in zip(together, around, strict=True):
        yield _solid(arrangement, cells, chains, spans)


def _connected(drawing: Subdivision, spans: Sequence[ZRange | None]) -> list[list[int]]:
    """The cells of every solid."""
    filled = np.array([*(span is not None for span in spans), False])
    a, b = drawing.sides[filled[drawing.sides].all(axis=1)].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=2 * (len(spans),))
    group = connected_components(links, directed=False)[1]
    together: dict[int, list[int]] = defaultdict(list)
    for cell, number in enumerate(group.tolist()):
        if spans[cell]:
            together[number].append(cell)
    return list(together.values())


@dataclass(frozen=True)
class _Side:
    """An upright face over a chain."""

    chain: int
    low: Surface
    high: Surface
    solid_left: bool


def _solid(arrangement: PlanarMap, cells: list[int], chains: list[int], spans: Sequence[Any]) -> Solid:
    """The solid over cells that hang together, bounded by chains."""
    shell = _Shell(arrangement)
    shell.meet(chains, spans)
    sides = [side for k in chains for side in _sides(shell, k, spans)]
    for side in sides:
        shell.note(side)
    for side in sides:
        shell.rise(side)
    for upward in (True, False):
        together: dict[Surface, list[int]] = defaultdict(list)
        for cell in cells:
            together[spans[cell].top if upward else spans[cell].bottom].append(cell)
        for surface, own in together.items():
            for loops in arrangement.faces(own):
                shell.cover(surface, loops, upward)
    return Solid(shell.close())


def _sides(shell: "_Shell", k: int, spans: Sequence[Any]) -> Iterator[_Side]:
    """The upright faces over a chain: where one side is solid and the other is not."""
    chain = shell.arrangement.chains[k]
    for mine, other, left in ((chain.left, chain.right, True), (chain.right, chain.left, False)):
        if mine < 0:
            continue
        low, top = spans[mine]
        if other >= 0:
            low = max(low, spans[other].top, key=lambda surface: shell.over(k, surface))
        if shell.over(k, low) < shell.over(k, top):
            yield _Side(k, low, top, left)


class _Shell:
    """A shell in the making: faces that share vertices and edges."""

    def __init__(self, arrangement: PlanarMap) -> None:
        self.arrangement = arrangement
        self.slack_mm: list[float] = arrangement.slack_mm.tolist()
        self.steps: dict[tuple[int, Surface], Steps] = {}
        self.builder = BRep_Builder()
        self.shell = TopoDS_Shell()
        self.builder.MakeShell(self.shell)
        self.known: dict[Hashable, list[int]] = defaultdict(list)
        self.heights: dict[int, set[int]] = defaultdict(set)
        self.vertices: dict[tuple[int, int], Any] = {}
        self.edges: dict[Any, Any] = {}
        self.risings: dict[int, Wall] = {}

    def meet(self, chains: list[int], spans: Sequence[Any]) -> None:
        """Find out how far heights of walls may be off where they meet what is level: as far as curves stray there."""
        for k in chains:
            chain = self.arrangement.chains[k]
            ends = list(chain.nodes)
            for bottom, top in {spans[cell] for cell in (chain.left, chain.right) if cell >= 0}:
                for surface in (bottom, top):
                    if not isinstance(surface, tuple):
                        self.over(k, surface)  # known first: what leans comes to it
                        continue
                    walls, sheet = surface
                    off = walls.slope * self.arrangement.slack_mm[ends]
                    if surface == bottom and not isinstance(top, tuple):
                        above = walls.plane(sheet, self.arrangement.nodes[ends]) - top
                        off = np.maximum(off, np.where(above < walls.slope * _ASTRAY_MM, above, 0))
                    for node, each in zip(ends, off.tolist(), strict=True):
                        self.slack_mm[node] = max(self.slack_mm[node], each)

    def over(self, k: int, surface: Surface) -> Steps:
        """Heights of a surface over a chain."""
        if (k, surface) not in self.steps:
            chain = self.arrangement.chains[k]
            if isinstance(surface, tuple):
                middle = self.arrangement.pieces[chain.piece].at((chain.start + chain.end) / 2)
                places = np.vstack([self.arrangement.nodes[list(chain.nodes)], middle])
                heights = surface[0].plane(surface[1], places).tolist()
                off = [SAME_MM + self.slack_mm[node] for node in chain.nodes]
            else:
                heights, off = [surface] * 3, [SAME_MM] * 2
            ends = zip((*chain.nodes, (k,)), heights, (*off, SAME_MM), strict=True)
            start, end, half = (self._one(*each) for each in ends)
            self.steps[k, surface] = start, end, half
        return self.steps[k, surface]

    def _one(self, at: Hashable, height_mm: float, off_mm: float) -> int:
        """A height over a node or the middle of a chain in steps: the same for all that differ by rounding only."""
        step = round(height_mm / STEP_MM)
        known = self.known[at]
        near = [other for other in known if abs(other - step) < off_mm / STEP_MM]
        if near:
            return min(near, key=lambda other: abs(other - step))
        known.append(step)
        return step

    def note(self, side: _Side) -> None:
        """Remember where a side's corners are: uprights are divided there."""
        nodes = self.arrangement.chains[side.chain].nodes
        for surface in (side.low, side.high):
            for node, z in zip(nodes, self.over(side.chain, surface), strict=False):
                self.heights[node].add(z)

    def rise(self, side: _Side) -> None:
        """Add an upright face."""
        k, wall = side.chain, self._rising(side.chain)
        start, end = self.arrangement.chains[k].nodes
        low, high = self.over(k, side.low), self.over(k, side.high)
        surface = wall.surface(_height(side.low), _height(side.high))
        ups, downs = self._uprights(end, low[1], high[1]), self._uprights(start, low[0], high[0])[::-1]
        bottom, top = self._level(k, side.low), self._level(k, side.high)
        round_ = [
            (bottom, True),
            *((edge, True) for edge, _ in ups),
            (top, False),
            *((edge, False) for edge, _ in downs),
        ]
        if not wall.rightward:
            round_ = [(edge, not forward) for edge, forward in reversed(round_)]
        for edge, over in ((bottom, side.low), (top, side.high)):
            self._lie(edge, wall.across(_height(over)), surface)
        for at, uprights in ((1, ups), (0, downs)):
            for edge, z in uprights:
                self._lie(edge, wall.upright(at, z), surface)
        self._add(surface, [self._wire(round_)], side.solid_left != wall.rightward)

    def cover(self, surface: Surface, loops: list[BorderWire], upward: bool) -> None:
        """Add a face above (upward) or below, its loops counter-clockwise seen from above, the outer one first."""
        node = self.arrangement.chains[loops[0][0][0]].nodes[0]
        place = self.arrangement.nodes[node]
        if isinstance(surface, tuple):
            walls, sheet = surface
            plane = Geom_Plane(gp_Pnt(*place, float(walls.plane(sheet, place[None])[0])), gp_Dir(*walls.normal(sheet)))
        else:
            plane = Geom_Plane(gp_Pnt(*place, surface), gp_Dir(0, 0, 1))
        wires = [self._wire([(self._level(k, surface), forward) for k, forward in loop]) for loop in loops]
        self._add(plane, wires, not upward)

    def close(self) -> Any:
        """The solid inside the shell."""
        self.shell.Closed(True)
        solid = TopoDS_Solid()
        self.builder.MakeSolid(solid)
        self.builder.Add(solid, self.shell)
        return solid

    def _add(self, surface: Any, wires: list[Any], reverse: bool) -> None:
        face = TopoDS_Face()
        self.builder.MakeFace(face, surface, EXACT_MM)
        for wire in wires:
            self.builder.Add(face, wire)
        self.builder.Add(self.shell, face.Reversed() if reverse else face)

    def _wire(self, edges: list[tuple[Any, bool]]) -> Any:
        wire = TopoDS_Wire()
        self.builder.MakeWire(wire)
        for edge, forward in edges:
            self.builder.Add(wire, edge if forward else edge.Reversed())
        wire.Closed(True)
        return wire

    def _lie(self, edge: Any, curve: Any, surface: Any) -> None:
        """Say where an edge lies in a surface's parameters, unless that is a plane, which needs no such word."""
        if curve is not None:
            self.builder.UpdateEdge(edge, curve, surface, TopLoc_Location(), EXACT_MM)

    def _rising(self, k: int) -> Wall:
        if k not in self.risings:
            chain = self.arrangement.chains[k]
            ends = self.arrangement.nodes[list(chain.nodes)]
            self.risings[k] = make_wall(self.arrangement.pieces[chain.piece], chain, ends)
        return self.risings[k]

    def _level(self, k: int, surface: Surface) -> Any:
        """The edge over a chain on a surface, along its piece."""
        over = self.over(k, surface)
        if (k, over) not in self.edges:
            ends = [self._vertex(node, z) for node, z in zip(self.arrangement.chains[k].nodes, over, strict=False)]
            self.edges[k, over] = self._edge(*self._rising(k).curve(_height(surface)), ends, self._slack(k))
        return self.edges[k, over]

    def _uprights(self, node: int, low: int, high: int) -> list[tuple[Any, float]]:
        """The edges upwards over a node from one height to another, each with the height it begins at."""
        edges = []
        for a, b in pairwise(sorted(z for z in self.heights[node] if low <= z <= high)):
            if (node, a, b) not in self.edges:
                x, y = self.arrangement.nodes[node].tolist()
                ends, slack = [self._vertex(node, a), self._vertex(node, b)], self.slack_mm[node]
                line = upright_line(x, y, a * STEP_MM)
                self.edges[node, a, b] = self._edge(line, 0.0, (b - a) * STEP_MM, ends, slack)
            edges.append((self.edges[node, a, b], a * STEP_MM))
        return edges

    def _slack(self, k: int) -> float:
        return max(self.slack_mm[node] for node in self.arrangement.chains[k].nodes)

    def _edge(self, curve: Any, first: float, last: float, ends: list[Any], slack_mm: float) -> Any:
        edge = TopoDS_Edge()
        self.builder.MakeEdge(edge, curve, EXACT_MM + slack_mm)
        self.builder.Add(edge, ends[0])
        self.builder.Add(edge, ends[1].Oriented(TopAbs_REVERSED))
        self.builder.Range(edge, first, last)
        return edge

    def _vertex(self, node: int, z: int) -> Any:
        if (node, z) not in self.vertices:
            vertex, place = TopoDS_Vertex(), self.arrangement.nodes[node].tolist()
            tolerance = 2 * (EXACT_MM + self.slack_mm[node])
            self.builder.MakeVertex(vertex, gp_Pnt(*place, z * STEP_MM), tolerance)
            self.vertices[node, z] = vertex
        return self.vertices[node, z]


def _height(surface: Surface) -> Any:
    """A surface as heights over places."""
    if not isinstance(surface, tuple):
        return surface
    walls, sheet = surface
    return lambda places: walls.plane(sheet, places)
