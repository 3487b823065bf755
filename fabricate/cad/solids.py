"""Solids over the cells of a planar map, put together face by face: planes, cylinders and B-spline surfaces.

The faces of a solid share their edges and vertices. The CAD kernel intersects and fuses nothing, so thousands of edges
take a fraction of a second, and no fuzzy tolerance decides whether a solid closes. Lengths are mm.

Importing this module loads the CAD kernel (OCP): import it where it is used.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from OCP.BRep import BRep_Builder
from OCP.collections import Array1_double, Array1_gp_Pnt, Array1_gp_Pnt2d, Array1_int
from OCP.Geom import (
    Geom_BSplineCurve,
    Geom_Circle,
    Geom_CylindricalSurface,
    Geom_Ellipse,
    Geom_Line,
    Geom_Plane,
    Geom_SurfaceOfLinearExtrusion,
)
from OCP.Geom2d import Geom2d_BSplineCurve, Geom2d_Line
from OCP.gp import gp_Ax2, gp_Ax3, gp_Dir, gp_Dir2d, gp_Pnt, gp_Pnt2d
from OCP.TopAbs import TopAbs_REVERSED
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS_Edge, TopoDS_Face, TopoDS_Shell, TopoDS_Solid, TopoDS_Vertex, TopoDS_Wire
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .curves import Arc, OutlineCurve, trim_spline
from .planar_map import MapEdge, PlanarMap, Subdivision, Surface, Wire, ZRange

Array = NDArray[np.float64]
Height = float | Callable[[Array], Array]
"""A height, mm, or the heights (n,) of a plane that is not level over points (n, 2)."""
Steps = tuple[int, int, int]
"""Heights over start, end and middle of an edge, in steps of `_STEP_MM`."""

_STEP_MM, _SAME_MM = 1e-7, 1e-5
"""Heights are whole steps, and equal if they differ by less than `_SAME_MM`."""
_TOLERANCE_MM = 1e-6
"""Tolerance of edges and vertices where curves meet exactly."""
_MAX_DEVIATION_MM = 5e-3
"""More than curves deviate from outlines: so near its edge, the wall below may pass the top of a track."""
_UP = gp_Dir(0, 0, 1)
_ELLIPSE_SAMPLES = 65
"""Points that the parameters of an ellipse on its cylinder are interpolated through."""
_CACHE_SIZE = 256
"""Curves and surfaces kept for other edges of their outline curve."""


def build_solids(subdivision: Subdivision, z_ranges: Sequence[ZRange | None]) -> Iterator[Any]:
    """Yield the solids of a part, each connected, with outward normals.

    Args:
        subdivision: cells.
        z_ranges: what the part fills of every cell; None for nothing.
    """
    planar_map = PlanarMap(subdivision, z_ranges)
    groups = _connect_cells(subdivision, z_ranges)
    group_of_cell = {cell: k for k, cells in enumerate(groups) for cell in cells}
    borders: list[list[int]] = [[] for _ in groups]
    for k, edge in enumerate(planar_map.edges):
        borders[group_of_cell[max(edge.left_cell, edge.right_cell)]].append(k)
    for cells, edges in zip(groups, borders, strict=True):
        yield _build_solid(planar_map, cells, edges, z_ranges)


def _connect_cells(subdivision: Subdivision, z_ranges: Sequence[ZRange | None]) -> list[list[int]]:
    """Cells of every connected solid."""
    filled = np.array([*(z_range is not None for z_range in z_ranges), False])
    a, b = subdivision.sides[filled[subdivision.sides].all(axis=1)].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=2 * (len(z_ranges),))
    groups: dict[int, list[int]] = defaultdict(list)
    for cell, group in enumerate(connected_components(links, directed=False)[1].tolist()):
        if z_ranges[cell]:
            groups[group].append(cell)
    return list(groups.values())


@dataclass(frozen=True)
class _WallFace:
    """An upright face over an edge."""

    edge: int
    bottom: Surface
    top: Surface
    faces_right: bool


def _build_solid(planar_map: PlanarMap, cells: list[int], edges: list[int], z_ranges: Sequence[Any]) -> Any:
    """Build the solid over connected cells that are bounded by edges."""
    shell = _Shell(planar_map)
    shell.collect_tolerances(edges, z_ranges)
    faces = [face for k in edges for face in _wall_faces(shell, k, z_ranges)]
    for face in faces:
        shell.split_vertical_edges(face)
    for face in faces:
        shell.add_wall_face(face)
    for upward in (True, False):
        levels: dict[Surface, list[int]] = defaultdict(list)
        for cell in cells:
            levels[z_ranges[cell].top if upward else z_ranges[cell].bottom].append(cell)
        for surface, level_cells in levels.items():
            for wires in planar_map.faces(level_cells):
                shell.add_horizontal_face(surface, wires, upward)
    return shell.to_solid()


def _wall_faces(shell: "_Shell", k: int, z_ranges: Sequence[Any]) -> Iterator[_WallFace]:
    """Yield the upright faces over an edge: where one side is solid and the other is not."""
    edge = shell.planar_map.edges[k]
    left, right = edge.left_cell, edge.right_cell
    for cell, neighbour, faces_right in ((left, right, True), (right, left, False)):
        if cell < 0:
            continue
        bottom, top = z_ranges[cell]
        if neighbour >= 0:
            bottom = max(bottom, z_ranges[neighbour].top, key=lambda surface: shell.steps(k, surface))
        if shell.steps(k, bottom) < shell.steps(k, top):
            yield _WallFace(k, bottom, top, faces_right)


class _Shell:
    """A shell under construction, whose faces share vertices and edges."""

    def __init__(self, planar_map: PlanarMap) -> None:
        self.planar_map = planar_map
        self._tolerance_mm: list[float] = planar_map.tolerance_mm.tolist()
        self._builder, self._shell = BRep_Builder(), TopoDS_Shell()
        self._builder.MakeShell(self._shell)
        self._steps: dict[tuple[int, Surface], Steps] = {}
        self._heights: dict[Hashable, list[int]] = defaultdict(list)  # distinct heights over a node or edge
        self._corners: dict[int, set[int]] = defaultdict(set)  # heights over a node at which vertical edges are split
        self._vertices: dict[tuple[int, int], Any] = {}
        self._edges: dict[Any, Any] = {}
        self._walls: dict[int, _PlaneWall] = {}

    def collect_tolerances(self, edges: list[int], z_ranges: Sequence[Any]) -> None:
        """Widen the tolerances of nodes where sloped walls meet level surfaces, as curves deviate there."""
        for k in edges:
            edge = self.planar_map.edges[k]
            nodes = list(edge.nodes)
            for bottom, top in {z_ranges[cell] for cell in (edge.left_cell, edge.right_cell) if cell >= 0}:
                for surface in (bottom, top):
                    if not isinstance(surface, tuple):
                        self.steps(k, surface)  # level heights come first, sloped ones are matched to them
                        continue
                    walls, plane = surface
                    error = walls.slope * self.planar_map.tolerance_mm[nodes]
                    if surface == bottom and not isinstance(top, tuple):
                        excess = walls.plane_heights(plane, self.planar_map.nodes[nodes]) - top
                        error = np.maximum(error, np.where(excess < walls.slope * _MAX_DEVIATION_MM, excess, 0))
                    for node, node_error in zip(nodes, error.tolist(), strict=True):
                        self._tolerance_mm[node] = max(self._tolerance_mm[node], node_error)

    def steps(self, k: int, surface: Surface) -> Steps:
        """Return the heights of a surface over an edge."""
        if (k, surface) not in self._steps:
            edge = self.planar_map.edges[k]
            if isinstance(surface, tuple):
                middle = self.planar_map.curves[edge.curve].evaluate((edge.start + edge.end) / 2)[:2]
                points = np.vstack([self.planar_map.nodes[list(edge.nodes)], middle])
                heights = surface[0].plane_heights(surface[1], points).tolist()
                tolerances = [_SAME_MM + self._tolerance_mm[node] for node in edge.nodes]
            else:
                heights, tolerances = [surface] * 3, [_SAME_MM] * 2
            positions = zip((*edge.nodes, (k,)), heights, (*tolerances, _SAME_MM), strict=True)
            start, end, middle = (self._match_height(*position) for position in positions)
            self._steps[k, surface] = start, end, middle
        return self._steps[k, surface]

    def _match_height(self, key: Hashable, height_mm: float, tolerance_mm: float) -> int:
        """Return a height over a node or the middle of an edge in steps, one for all within the tolerance."""
        step = round(height_mm / _STEP_MM)
        heights = self._heights[key]
        near = [other for other in heights if abs(other - step) < tolerance_mm / _STEP_MM]
        if near:
            return min(near, key=lambda other: abs(other - step))
        heights.append(step)
        return step

    def split_vertical_edges(self, face: _WallFace) -> None:
        """Split vertical edges at the corners of an upright face."""
        nodes = self.planar_map.edges[face.edge].nodes
        for surface in (face.bottom, face.top):
            for node, z in zip(nodes, self.steps(face.edge, surface), strict=False):
                self._corners[node].add(z)

    def add_wall_face(self, face: _WallFace) -> None:
        """Add an upright face."""
        k, wall = face.edge, self._wall(face.edge)
        start, end = self.planar_map.edges[k].nodes
        low, high = self.steps(k, face.bottom), self.steps(k, face.top)
        surface = wall.surface(_height(face.bottom))
        rising = self._vertical_edges(end, low[1], high[1])
        falling = self._vertical_edges(start, low[0], high[0])[::-1]
        bottom, top = self._horizontal_edge(k, face.bottom), self._horizontal_edge(k, face.top)
        up, down = [(edge, True) for edge, _ in rising], [(edge, False) for edge, _ in falling]
        wire = [(bottom, True), *up, (top, False), *down]
        if not wall.normal_is_right:
            wire = [(edge, not forward) for edge, forward in reversed(wire)]
        for edge, height in ((bottom, face.bottom), (top, face.top)):
            self._add_pcurve(edge, wall.horizontal_pcurve(_height(height)), surface)
        for side, vertical in ((1, rising), (0, falling)):
            for edge, z in vertical:
                self._add_pcurve(edge, wall.vertical_pcurve(side, z), surface)
        self._add_face(surface, [self._make_wire(wire)], face.faces_right != wall.normal_is_right)

    def add_horizontal_face(self, surface: Surface, wires: list[Wire], upward: bool) -> None:
        """Add a face above (upward) or below; wires counter-clockwise seen from above, the outer one first."""
        point = self.planar_map.nodes[self.planar_map.edges[wires[0][0][0]].nodes[0]]
        if isinstance(surface, tuple):
            walls, number = surface
            z, normal = float(walls.plane_heights(number, point[None])[0]), walls.normal(number)
        else:
            z, normal = surface, (0, 0, 1)
        edges = ([(self._horizontal_edge(k, surface), forward) for k, forward in wire] for wire in wires)
        self._add_face(Geom_Plane(gp_Pnt(*point, z), gp_Dir(*normal)), list(map(self._make_wire, edges)), not upward)

    def to_solid(self) -> Any:
        """Return the solid inside the shell."""
        self._shell.Closed(True)
        solid = TopoDS_Solid()
        self._builder.MakeSolid(solid)
        self._builder.Add(solid, self._shell)
        return solid

    def _add_face(self, surface: Any, wires: list[Any], reverse: bool) -> None:
        face = TopoDS_Face()
        self._builder.MakeFace(face, surface, _TOLERANCE_MM)
        for wire in wires:
            self._builder.Add(face, wire)
        self._builder.Add(self._shell, face.Reversed() if reverse else face)

    def _make_wire(self, edges: list[tuple[Any, bool]]) -> Any:
        wire = TopoDS_Wire()
        self._builder.MakeWire(wire)
        for edge, forward in edges:
            self._builder.Add(wire, edge if forward else edge.Reversed())
        wire.Closed(True)
        return wire

    def _add_pcurve(self, edge: Any, curve: Any, surface: Any) -> None:
        """Set the curve of an edge in the parameters of a surface; planes need none."""
        if curve is not None:
            self._builder.UpdateEdge(edge, curve, surface, TopLoc_Location(), _TOLERANCE_MM)

    def _wall(self, k: int) -> "_PlaneWall":
        if k not in self._walls:
            edge = self.planar_map.edges[k]
            curve = self.planar_map.curves[edge.curve]
            if curve.spline is not None:
                self._walls[k] = _SplineWall(curve, curve.spline, edge)
            elif curve.arc is not None:
                self._walls[k] = _ArcWall(curve.arc, curve.length, edge)
            else:
                self._walls[k] = _PlaneWall(self.planar_map.nodes[list(edge.nodes)])
        return self._walls[k]

    def _horizontal_edge(self, k: int, surface: Surface) -> Any:
        """Return the edge over a map edge on a surface, along its curve."""
        steps = self.steps(k, surface)
        if (k, steps) not in self._edges:
            nodes = self.planar_map.edges[k].nodes
            ends = [self._vertex(node, z) for node, z in zip(nodes, steps, strict=False)]
            tolerance_mm = max(self._tolerance_mm[node] for node in nodes)
            self._edges[k, steps] = self._make_edge(*self._wall(k).curve(_height(surface)), ends, tolerance_mm)
        return self._edges[k, steps]

    def _vertical_edges(self, node: int, low: int, high: int) -> list[tuple[Any, float]]:
        """Return the edges upwards over a node between two heights, each with the height it begins at."""
        edges = []
        for a, b in pairwise(sorted(z for z in self._corners[node] if low <= z <= high)):
            if (node, a, b) not in self._edges:
                line = Geom_Line(gp_Pnt(*self.planar_map.nodes[node].tolist(), a * _STEP_MM), _UP)
                ends = [self._vertex(node, a), self._vertex(node, b)]
                length_mm = (b - a) * _STEP_MM
                self._edges[node, a, b] = self._make_edge(line, 0.0, length_mm, ends, self._tolerance_mm[node])
            edges.append((self._edges[node, a, b], a * _STEP_MM))
        return edges

    def _make_edge(self, curve: Any, first: float, last: float, ends: list[Any], tolerance_mm: float) -> Any:
        edge = TopoDS_Edge()
        self._builder.MakeEdge(edge, curve, _TOLERANCE_MM + tolerance_mm)
        self._builder.Add(edge, ends[0])
        self._builder.Add(edge, ends[1].Oriented(TopAbs_REVERSED))
        self._builder.Range(edge, first, last)
        return edge

    def _vertex(self, node: int, z: int) -> Any:
        if (node, z) not in self._vertices:
            vertex, point = TopoDS_Vertex(), gp_Pnt(*self.planar_map.nodes[node].tolist(), z * _STEP_MM)
            self._builder.MakeVertex(vertex, point, 2 * (_TOLERANCE_MM + self._tolerance_mm[node]))
            self._vertices[node, z] = vertex
        return self._vertices[node, z]


def _height(surface: Surface) -> Height:
    if not isinstance(surface, tuple):
        return surface
    walls, plane = surface
    return lambda points: walls.plane_heights(plane, points)


class _PlaneWall:
    """Upright surface over a straight edge of a planar map, and the curves on it; base of arcs' and splines' walls.

    Lines rise to planes, arcs to cylinders and splines to extrusions. The first parameter of a surface is that of the
    curve, the second grows with the height.

    Attributes:
        normal_is_right: whether the surface's own normal points to the right of the curve's direction.
    """

    normal_is_right = True

    def __init__(self, ends: Array) -> None:
        self._ends = ends

    def curve(self, z: Height) -> tuple[Any, float, float]:
        """Return the curve at a height, with its first and last parameter."""
        heights = _heights(z, self._ends)
        start, end = (gp_Pnt(*xy, height) for xy, height in zip(self._ends.tolist(), heights, strict=True))
        direction = gp_Dir(end.X() - start.X(), end.Y() - start.Y(), end.Z() - start.Z())
        return Geom_Line(start, direction), 0.0, start.Distance(end)

    def surface(self, z: Height) -> Any:
        """Return the upright surface through the curve at a height, unbounded."""
        (x0, y0), (x1, y1) = self._ends.tolist()
        return Geom_Plane(gp_Pnt(x0, y0, _heights(z, self._ends)[0]), gp_Dir(y1 - y0, x0 - x1, 0))

    def horizontal_pcurve(self, z: Height) -> Any:
        """Return the curve at a height in the surface's parameters; None, as a plane needs none."""

    def vertical_pcurve(self, side: int, z: float) -> Any:
        """Return the line upwards from a height at the start (0) or end (1) in the surface's parameters, or None."""


class _ArcWall(_PlaneWall):
    """Its parameter is the angle, counted clockwise for a clockwise arc."""

    def __init__(self, arc: Arc, length: float, edge: MapEdge) -> None:
        *self._centre, self._radius, start, sweep = arc
        self.normal_is_right = sweep > 0
        self._sign = 1 if sweep > 0 else -1
        first, last = (self._sign * (start + sweep * s / length) for s in (edge.start, edge.end))
        turns = 2 * math.pi * math.floor(first / (2 * math.pi))
        self._range = first - turns, last - turns

    def curve(self, z: Height) -> tuple[Any, float, float]:
        if callable(z):
            return self._ellipse(z)
        frame = gp_Ax2(gp_Pnt(*self._centre, z), gp_Dir(0, 0, self._sign), gp_Dir(1, 0, 0))
        return Geom_Circle(frame, self._radius), *self._range

    def _ellipse(self, z: Callable[[Array], Array]) -> tuple[Any, float, float]:
        """Section by a sloped plane; its parameter is the angle from where the plane rises."""
        middle, rise, angle = self._slope(z)
        x, y = math.cos(angle), math.sin(angle)
        normal = gp_Dir(-rise * x * self._sign, -rise * y * self._sign, self._radius * self._sign)
        frame = gp_Ax2(gp_Pnt(*self._centre, middle), normal, gp_Dir(self._radius * x, self._radius * y, rise))
        first, last = (parameter - self._sign * angle for parameter in self._range)
        return Geom_Ellipse(frame, math.hypot(self._radius, rise), self._radius), first, last

    def _slope(self, z: Callable[[Array], Array]) -> tuple[float, float, float]:
        """Height of a plane over the centre, its rise over the radius, and the angle of its gradient."""
        middle, x, y = z(np.add(self._centre, self._radius * np.array([[0, 0], [1, 0], [0, 1]]))).tolist()
        return middle, math.hypot(x - middle, y - middle), math.atan2(y - middle, x - middle)

    def surface(self, z: Height) -> Any:
        return Geom_CylindricalSurface(gp_Ax3(gp_Pnt(*self._centre, 0), _UP, gp_Dir(1, 0, 0)), self._radius)

    def horizontal_pcurve(self, z: Height) -> Any:
        if not callable(z):
            return Geom2d_Line(gp_Pnt2d(0, z), gp_Dir2d(self._sign, 0))
        middle, rise, angle = self._slope(z)
        parameters = np.linspace(*self._ellipse(z)[1:], _ELLIPSE_SAMPLES)
        points = np.stack([self._sign * parameters + angle, middle + rise * np.cos(parameters)], axis=1)
        curve = make_interp_spline(parameters, points, k=3)
        return _spline_2d(curve, curve.c)

    def vertical_pcurve(self, side: int, z: float) -> Any:
        return Geom2d_Line(gp_Pnt2d(self._sign * self._range[side], z), gp_Dir2d(0, 1))


class _SplineWall(_PlaneWall):
    """Extrusion of a spline from the foot of its wall; its parameters are the arc length and the height above the foot.

    At the foot and the top the edges share the full curve, which files hold once; elsewhere each has a part.
    """

    def __init__(self, curve: OutlineCurve, spline: BSpline, edge: MapEdge) -> None:
        self._z_range, self._spline = curve.z_range, spline
        self._foot_mm = curve.z_range[0] if math.isfinite(curve.z_range[0]) else 0.0
        self._range = edge.start, edge.end

    @cached_property
    def _trimmed(self) -> BSpline:
        return trim_spline(self._spline, *self._range)

    def curve(self, z: Height) -> tuple[Any, float, float]:
        if not callable(z) and z in self._z_range:
            return _level_curve(self._spline, z), *self._range
        return _raised_curve(self._trimmed, _heights(z, self._trimmed.c)), *self._range

    def surface(self, z: Height) -> Any:
        return _extrusion(self._spline, self._foot_mm)

    def horizontal_pcurve(self, z: Height) -> Any:
        if not callable(z):
            return Geom2d_Line(gp_Pnt2d(0, z - self._foot_mm), gp_Dir2d(1, 0))
        spline = self._trimmed
        greville = (spline.t[1:-3] + spline.t[2:-2] + spline.t[3:-1]) / 3
        heights = np.array(_heights(z, spline.c)) - self._foot_mm
        return _spline_2d(spline, np.column_stack([greville, heights]))

    def vertical_pcurve(self, side: int, z: float) -> Any:
        return Geom2d_Line(gp_Pnt2d(self._range[side], z - self._foot_mm), gp_Dir2d(0, 1))


def _heights(z: Height, points: Array) -> list[float]:
    return z(points).tolist() if callable(z) else [z] * len(points)


@lru_cache(_CACHE_SIZE)
def _level_curve(spline: BSpline, z: float) -> Any:
    return _raised_curve(spline, [z] * len(spline.c))


def _raised_curve(spline: BSpline, heights: list[float]) -> Any:
    poles = Array1_gp_Pnt(1, len(spline.c))
    for i, ((x, y), z) in enumerate(zip(spline.c.tolist(), heights, strict=True), 1):
        poles.SetValue(i, gp_Pnt(x, y, z))
    return Geom_BSplineCurve(poles, *_knots(spline), 3)


@lru_cache(_CACHE_SIZE)
def _extrusion(spline: BSpline, z: float) -> Any:
    return Geom_SurfaceOfLinearExtrusion(_level_curve(spline, z), _UP)


def _spline_2d(spline: BSpline, poles: Array) -> Any:
    """Spline with the knots of another and poles (n, 2), in a surface's parameters."""
    points = Array1_gp_Pnt2d(1, len(poles))
    for i, (u, v) in enumerate(poles.tolist(), 1):
        points.SetValue(i, gp_Pnt2d(u, v))
    return Geom2d_BSplineCurve(points, *_knots(spline), 3)


@lru_cache(_CACHE_SIZE)
def _knots(spline: BSpline) -> tuple[Any, Any]:
    """Knots of a spline and their multiplicities, as the kernel's arrays."""
    knots, multiplicities = np.unique(spline.t, return_counts=True)
    return _fill(Array1_double, knots.tolist()), _fill(Array1_int, multiplicities.tolist())


def _fill(kind: Any, values: Sequence[float]) -> Any:
    array = kind(1, len(values))
    for i, value in enumerate(values, 1):
        array.SetValue(i, value)
    return array
