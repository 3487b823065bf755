"""Plan of a mould as a planar map: outlines divide it into cells, and each part fills some cells between two heights.

The outlines are drawn finely enough for Shapely to find what meets what. Which smooth curve every drawn edge belongs to
is remembered, so that exact curves take its place and meet in common nodes. Lengths are mm; z = 0 is the underside of
the tray.
"""

import math
from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.mould import terraces
from padforge.fabricate.plan import Plan, polygon_rings

from .curves import FINE_MM, OutlineCurve, edge_curves, find_joints, insert_joints, outline_curves

Array = NDArray[np.float64]
Vertex = tuple[int, int]
"""Position on the grid, in grid steps."""
GridEdge = tuple[Vertex, Vertex]
Wire = list[tuple[int, bool]]
"""Closed loop of edges of a planar map, the face to its left: index of each, and whether it runs along its curve."""

GRID_MM = 1e-6
"""Grid to which vertices of outlines are snapped."""
_SLIVER_MM = 5e-6
"""Cells no wider come from snapping."""
_END_MM = 5e-6
"""Distance from the end of a curve within which an edge ends there."""
_SHORT_MM = 1e-5
"""Shorter edges come from snapping, or vanish where exact curves meet."""
_GAP_MM, _VANISHING_MM = 1e-6, 0.02
"""If curves miss each other by more than the first, an edge shorter than the second may vanish: they meet beyond it."""
_MAX_SHIFT_MM = 0.1
"""Exact curves meet no farther from where their drawings do."""
_NEWTON_STEPS = 12

FLOOR, RIM = -1, -2
"""Numbers of the floor and the rim among those of the walls' planes."""
PARTS = TRAY, HORIZONTAL_TRACKS, VERTICAL_TRACKS, NUMBERS = "tray", "horizontal tracks", "vertical tracks", "numbers"


class Subdivision:
    """Subdivision of the plane by lines.

    Args:
        lines: all lines, however they cross.
        curves: smooth curves that the lines were drawn from.

    Attributes:
        cells: polygons; shape (C,).
        interior_points: a point within each cell; shape (C, 2).
        edges: every edge between or around cells once; length E.
        sides: cells to the left and right of each edge, -1 for none; shape (E, 2).
        curve_of_edge: number of the curve that each edge was drawn from; shape (E,).
    """

    def __init__(self, lines: Sequence[BaseGeometry], curves: Sequence[OutlineCurve]) -> None:
        self.curves = curves
        noded = shapely.union_all(lines, grid_size=GRID_MM)
        self.cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded)))
        self.interior_points = shapely.get_coordinates(shapely.point_on_surface(self.cells))
        rings, cell_of_ring = shapely.get_rings(shapely.orient_polygons(self.cells), return_index=True)
        coordinates, ring = shapely.get_coordinates(rings, return_index=True)
        vertices, same_ring = _snap(coordinates), (ring[1:] == ring[:-1]).tolist()
        cells = cell_of_ring[ring].tolist()
        cell_beside = {(vertices[i], vertices[i + 1]): cells[i] for i, within in enumerate(same_ring) if within}
        self.edges = [edge for edge in cell_beside if edge[0] < edge[1] or edge[::-1] not in cell_beside]
        self.sides = np.array([(cell_beside[a, b], cell_beside.get((b, a), -1)) for a, b in self.edges])
        self.curve_of_edge = _nearest_curves(self.edges, curves)

    def find_slivers(self) -> dict[int, int]:
        """Return the cells that exist by snapping only, each with the cell it shares most of its boundary with."""
        sliver = np.append(2 * shapely.area(self.cells) < _SLIVER_MM * shapely.length(self.cells), False)
        shared: dict[int, dict[int, float]] = {cell: {} for cell in np.flatnonzero(sliver).tolist()}
        for k in np.flatnonzero(sliver[self.sides].sum(axis=1) == 1):
            cell, neighbour = self.sides[k].tolist() if sliver[self.sides[k, 0]] else self.sides[k, ::-1].tolist()
            if neighbour >= 0:
                shared[cell][neighbour] = shared[cell].get(neighbour, 0.0) + math.dist(*self.edges[k])
        return {cell: max(lengths, key=lengths.__getitem__) for cell, lengths in shared.items() if lengths}


def _snap(points: Array) -> list[Vertex]:
    return list(map(tuple, np.rint(points / GRID_MM).astype(np.int64).tolist()))


def _nearest_curves(edges: Sequence[GridEdge], curves: Sequence[OutlineCurve]) -> NDArray[np.intp]:
    midpoints = shapely.points(GRID_MM * np.array(edges, dtype=float).mean(axis=1))
    chords = [np.stack([curve.points[:-1], curve.points[1:]], axis=1) for curve in curves]
    owner = np.repeat(np.arange(len(curves)), [len(ends) for ends in chords])
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.concatenate(chords))))
    return owner[tree.query_nearest(midpoints, all_matches=False)[1]]


@dataclass(frozen=True)
class MapEdge:
    """Part of a curve between two nodes of a planar map.

    Attributes:
        curve: number of the curve.
        start: arc length along the curve where the edge begins.
        end: arc length where it ends, more than `start`.
        nodes: numbers of its nodes.
        left_cell: cell to its left, -1 for none.
        right_cell: cell to its right, -1 for none.
    """

    curve: int
    start: float
    end: float
    nodes: tuple[int, int]
    left_cell: int
    right_cell: int


@dataclass(frozen=True)
class _EdgeChain:
    """Drawn edges from node to node along one curve, and the arc lengths at its ends."""

    curve: int
    vertices: list[Vertex]
    ends: tuple[float, float]


class PlanarMap:
    """Some cells of a subdivision and the exact curves between them.

    Args:
        subdivision: cells and drawn edges.
        kinds: kind of every cell, None for those left out; neighbours of one kind have no border between them.

    Attributes:
        nodes: positions of the nodes; shape (V, 2), mm.
        tolerance_mm: distance by which the curves that meet in a node miss it; shape (V,).
        edges: borders between nodes.
    """

    def __init__(self, subdivision: Subdivision, kinds: Sequence[Hashable | None]) -> None:
        self._cells, self.curves = subdivision.cells, subdivision.curves
        sides = subdivision.sides
        codes: dict[Hashable | None, int] = {None: -1}
        code = np.array([*(codes.setdefault(kind, len(codes)) for kind in kinds), -1])
        border = np.flatnonzero(code[sides[:, 0]] != code[sides[:, 1]]).tolist()
        cells = np.where(code[sides] < 0, -1, sides)
        cell_beside: dict[GridEdge, int] = {}
        for k, (left, right) in zip(border, cells[border].tolist(), strict=True):
            a, b = subdivision.edges[k]
            cell_beside[a, b], cell_beside[b, a] = left, right
        curve_of_edge = {subdivision.edges[k]: int(subdivision.curve_of_edge[k]) for k in border}
        runs = _orient_runs(_join_runs(curve_of_edge), subdivision.curves)
        # Runs that vanish where exact curves meet are contracted, which may move other meetings: until none is left
        contracted = np.array([run.ends[1] - run.ends[0] < _SHORT_MM for run in runs])
        while True:
            nodes = _number_nodes(runs, contracted)
            self.nodes, self.tolerance_mm, ends = self._intersect(runs, nodes)
            vanished = _find_vanished(nodes, ends, self.tolerance_mm)
            if not vanished:
                break
            contracted[vanished] = True
        self.edges: list[MapEdge] = []
        self._edge_at: dict[GridEdge, tuple[int, bool]] = {}
        self._run_length: dict[GridEdge, int] = {}
        for run, (a, b), s in zip(runs, nodes, ends, strict=True):
            forward, backward = (run.vertices[0], run.vertices[1]), (run.vertices[-1], run.vertices[-2])
            self._run_length[forward] = self._run_length[backward] = len(run.vertices) - 1
            if a != b:
                self._edge_at[forward], self._edge_at[backward] = (len(self.edges), True), (len(self.edges), False)
                self.edges.append(
                    MapEdge(run.curve, *s, (a, b), cell_beside[forward], cell_beside[forward[1], forward[0]])
                )

    def faces(self, cells: Sequence[int]) -> Iterator[list[Wire]]:
        """Yield every connected region of the union of cells as its wires, the outer one first."""
        for rings in polygon_rings(shapely.coverage_union_all(self._cells[list(cells)])):
            outer, *holes = (self._wire(_snap(ring)) for ring in rings)
            if len(outer) > 1:  # a wire of fewer edges has shrunk to a node
                yield [outer, *(hole for hole in holes if len(hole) > 1)]

    def _wire(self, vertices: list[Vertex]) -> Wire:
        steps = list(zip(vertices, vertices[1:] + vertices[:1], strict=True))
        i = next(i for i, step in enumerate(steps) if step in self._run_length)
        wire, end = [], i + len(steps)
        while i < end:
            step = steps[i % len(steps)]
            if step in self._edge_at:
                wire.append(self._edge_at[step])
            i += self._run_length[step]
        return wire

    def _intersect(
        self, runs: Sequence[_EdgeChain], nodes: Sequence[tuple[int, int]]
    ) -> tuple[Array, Array, list[tuple[float, float]]]:
        """Positions of the nodes, their tolerances, and the arc lengths at the ends of every run."""
        lengths: dict[int, dict[int, float]] = defaultdict(dict)  # node -> curve -> arc length
        for run, ends in zip(runs, nodes, strict=True):
            for node, s in zip(ends, run.ends, strict=True):
                if ends[0] != ends[1]:
                    lengths[node].setdefault(run.curve, s)
        met = [self._intersect_curves(lengths[node]) for node in range(1 + max(map(max, nodes)))]
        ends = [
            (lengths[a][run.curve], lengths[b][run.curve]) if a != b else run.ends
            for run, (a, b) in zip(runs, nodes, strict=True)
        ]
        return np.array([point for point, _ in met]), np.array([tolerance for _, tolerance in met]), ends

    def _intersect_curves(self, lengths: dict[int, float]) -> tuple[Array, float]:
        """Common point of curves near the given arc lengths, which are corrected, and the largest distance from it."""
        if not lengths:
            return np.zeros(2), 0.0
        inner = [curve for curve, s in lengths.items() if 0 < s < self.curves[curve].length]
        if inner and len(lengths) > 1:
            self._cross(lengths, inner)
        points = [self.curves[curve].evaluate(s)[:2] for curve, s in lengths.items()]
        mean = np.mean(points, axis=0)
        return mean, max(math.dist(point, mean) for point in points)

    def _cross(self, lengths: dict[int, float], inner: list[int]) -> None:
        """Move the arc lengths of the two curves that cross most steeply to their intersection, by Newton's method."""
        values = {curve: self.curves[curve].evaluate(s) for curve, s in lengths.items()}
        pairs = [(a, b) for a in inner for b in lengths if a != b]
        first, second = max(pairs, key=lambda pair: abs(_sine(values[pair[0]], values[pair[1]])))
        a, b = self.curves[first], self.curves[second]
        s, u = guess = lengths[first], lengths[second]
        for _ in range(_NEWTON_STEPS):
            x, y, ax, ay = a.evaluate(s)
            other_x, other_y, bx, by = b.evaluate(u)
            det = bx * ay - ax * by
            if abs(det) < 1e-6:
                return
            dx, dy = other_x - x, other_y - y
            ds, du = (bx * dy - by * dx) / det, (ax * dy - ay * dx) / det
            s, u = min(max(s + ds, 0), a.length), min(max(u + du, 0), b.length)
            if max(abs(ds), abs(du)) < 1e-12:
                break
        gap = math.dist(a.evaluate(s)[:2], b.evaluate(u)[:2])
        if gap < 1e-9 and max(abs(s - guess[0]), abs(u - guess[1])) < _MAX_SHIFT_MM:
            lengths[first], lengths[second] = s, u


def _sine(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Sine of the angle between two curves, from points with derivatives."""
    return (a[2] * b[3] - a[3] * b[2]) / math.hypot(*a[2:]) / math.hypot(*b[2:])


def _join_runs(curve_of_edge: dict[GridEdge, int]) -> list[tuple[int, list[Vertex]]]:
    """Join edges to runs of one curve each that no third edge and no other curve meets."""
    neighbours: dict[Vertex, list[tuple[Vertex, int]]] = defaultdict(list)
    for (a, b), curve in curve_of_edge.items():
        neighbours[a].append((b, curve))
        neighbours[b].append((a, curve))
    passing = {v for v, ends in neighbours.items() if len(ends) == 2 and ends[0][1] == ends[1][1]}
    runs, done = [], set()
    for start in neighbours:
        if start in passing:
            continue
        for second, curve in neighbours[start]:
            if (start, second) in done:
                continue
            run = [start, second]
            while run[-1] in passing:
                (a, _), (b, _) = neighbours[run[-1]]
                run.append(b if a == run[-2] else a)
            done |= {(run[0], run[1]), (run[-1], run[-2])}
            runs.append((curve, run))
    return runs


def _orient_runs(runs: list[tuple[int, list[Vertex]]], curves: Sequence[OutlineCurve]) -> list[_EdgeChain]:
    """Turn runs to run along their curves."""
    lines = np.array([shapely.LineString(curve.points) for curve in curves])[[curve for curve, _ in runs]]
    ends = [shapely.points(GRID_MM * np.array([run[i] for _, run in runs], dtype=float)) for i in (0, -1)]
    s = np.stack([shapely.line_locate_point(lines, points) for points in ends], axis=1)
    length = np.array([curves[curve].length for curve, _ in runs])[:, None]
    s = np.where(s < _END_MM, 0, np.where(s > length - _END_MM, length, s))
    return [
        _EdgeChain(curve, run, (a, b)) if a <= b else _EdgeChain(curve, run[::-1], (b, a))
        for (curve, run), (a, b) in zip(runs, s.tolist(), strict=True)
    ]


def _number_nodes(runs: Sequence[_EdgeChain], contracted: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Numbers of the nodes at the ends of every run, one for both ends of a contracted run."""
    numbers: dict[Vertex, int] = {}
    ends = np.array([[numbers.setdefault(run.vertices[i], len(numbers)) for i in (0, -1)] for run in runs])
    a, b = ends[contracted].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(numbers), len(numbers)))
    return list(map(tuple, connected_components(links, directed=False)[1][ends].tolist()))


def _find_vanished(
    nodes: Sequence[tuple[int, int]], ends: Sequence[tuple[float, float]], tolerance_mm: Array
) -> list[int]:
    """Runs that vanish between exact curves: these meet in the other order, or beyond the run."""
    length = np.array([end - start if a != b else np.inf for (a, b), (start, end) in zip(nodes, ends, strict=True)])
    loose = [any(tolerance_mm[node] > _GAP_MM for node in pair) for pair in nodes]
    return np.flatnonzero((length < _SHORT_MM) | (loose & (length < _VANISHING_MM))).tolist()


@dataclass(frozen=True, eq=False)
class TrayWalls:
    """Floor and flared walls of a tray, as a height over every point.

    Attributes:
        hollows: rectangles on the floor that the silicone fills, as x_min, y_min, x_max, y_max; shape (k, 4).
        floor_mm: height of the floor.
        depth_mm: height of the rim above the floor.
        flare_mm: distance by which walls lean outwards up to the rim.
    """

    hollows: Array
    floor_mm: float
    depth_mm: float
    flare_mm: float

    @classmethod
    def from_plan(cls, plan: Plan) -> "TrayWalls":
        """Return the walls of a plan's tray."""
        hollows = np.array([shapely.bounds(hollow) for hollow in (plan.cavity, *plan.exits)])
        return cls(hollows, plan.settings.mould.floor_mm, plan.silicone_mm, plan.flare_mm)

    def planes(self, points: Array) -> NDArray[np.intp]:
        """Return what lies below points (n, 2): `FLOOR`, `RIM` or the number of a wall's plane; shape (n,)."""
        distances = self._distances(points)
        hollow = distances.max(axis=2).argmin(axis=1)
        nearest = distances[np.arange(len(points)), hollow]
        distance = nearest.max(axis=1)
        wall = 4 * hollow + nearest.argmax(axis=1)
        return np.where(distance <= 0, FLOOR, np.where(distance >= self.flare_mm, RIM, wall))

    def heights(self, points: Array) -> Array:
        """Return the heights of what lies below points (n, 2); shape (n,), mm."""
        distance = self._distances(points).max(axis=2).min(axis=1)
        fraction = np.clip(distance / self.flare_mm, 0, 1) if self.flare_mm else distance > 0
        return self.floor_mm + self.depth_mm * fraction

    @property
    def slope(self) -> float:
        """Rise of flared walls per mm outwards."""
        return self.depth_mm / self.flare_mm

    def plane_heights(self, plane: int, points: Array) -> Array:
        """Return the heights of a wall's plane over points (n, 2); shape (n,), mm."""
        hollow, side = divmod(plane, 4)
        return self.floor_mm + self.slope * self._distances(points)[:, hollow, side]

    def normal(self, plane: int) -> tuple[float, float, float]:
        """Return the upward normal of a wall's plane, not of unit length."""
        side = plane % 4
        along = self.slope if side < 2 else -self.slope
        return (along, 0.0, 1.0) if side % 2 == 0 else (0.0, along, 1.0)

    def outline(self, z: float) -> shapely.Polygon:
        """Return the opening between the walls at a height."""
        return shapely.Polygon(self._floor_ring + (z - self.floor_mm) / self.depth_mm * self.flare_mm * self._outward)

    def creases(self) -> list[shapely.LineString]:
        """Return the lines between planes: the floor's outline, and where two walls meet."""
        ring, top = self._floor_ring, self._floor_ring + self.flare_mm * self._outward
        corners = [shapely.LineString(ends) for ends in zip(ring, top, strict=True)] if self.flare_mm else []
        return [self.outline(self.floor_mm).exterior, *corners]

    def _distances(self, points: Array) -> Array:
        """Signed distances of points beyond every side of every hollow; shape (n, k, 4)."""
        low, high = self.hollows[:, :2], self.hollows[:, 2:]
        return np.concatenate([low - points[:, None], points[:, None] - high], axis=2)

    @cached_property
    def _floor_ring(self) -> Array:
        union = shapely.union_all(shapely.box(*self.hollows.T)).simplify(0)
        return polygon_rings(union)[0][0]

    @cached_property
    def _outward(self) -> Array:
        """Shift of the floor's corners for 1 mm of flare; its edges are parallel to the axes."""
        edges = np.roll(self._floor_ring, -1, axis=0) - self._floor_ring
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
        return normals + np.roll(normals, 1, axis=0)


Surface = float | tuple[TrayWalls, int]
"""A height, mm, or a plane of the walls."""
Fills = dict[str, list["ZRange | None"]]
"""What each of the `PARTS` fills of every cell; None for nothing."""


class ZRange(NamedTuple):
    """Surfaces that bound a part below and above."""

    bottom: Surface
    top: Surface


class _RaisedOutline(NamedTuple):
    """What stands on the floor."""

    part: str
    top_mm: float
    outline: BaseGeometry
    curves: list[OutlineCurve]


def fill_cells(plan: Plan, fit_mm: float, wells: Sequence[BaseGeometry] = ()) -> tuple[Subdivision, Fills]:
    """Divide the plan of a mould into cells, and fill them with its parts.

    Parts touch and do not overlap: tracks and numbers stand on the tray, and the taller track passes through at a
    crossing. Splines follow the drawn outlines within `fit_mm`; wells belong to the ridges of each layer.
    """
    walls = TrayWalls.from_plan(plan)
    rim_mm = walls.floor_mm + walls.depth_mm
    prisms = sorted([*_ridge_prisms(plan, fit_mm, wells), *_number_prisms(plan)], key=lambda prism: -prism.top_mm)
    openings = [walls.outline(z).boundary for z in sorted({*(prism.top_mm for prism in prisms), rim_mm})]
    straight = [plan.tray.boundary, *openings, *walls.creases(), plan.pillars.boundary]
    curves = [curve for line in straight for curve in edge_curves(line)]
    curves += [curve for prism in prisms for curve in prism.curves]
    cells = Subdivision([*straight, *(prism.outline.boundary for prism in prisms)], curves)

    points, planes = cells.interior_points, walls.planes(cells.interior_points).tolist()
    heights = walls.heights(points)
    ground: list[Surface] = [walls.floor_mm if k == FLOOR else rim_mm if k == RIM else (walls, k) for k in planes]
    for cell in np.flatnonzero(shapely.contains_xy(plan.pillars, points)):
        ground[cell] = heights[cell] = rim_mm
    fills: Fills = {name: [None] * len(ground) for name in PARTS}
    free = np.ones(len(ground), dtype=bool)
    for prism in prisms:
        shapely.prepare(prism.outline)
        for cell in np.flatnonzero(free & shapely.contains_xy(prism.outline, points) & (heights < prism.top_mm)):
            fills[prism.part][cell] = ZRange(ground[cell], prism.top_mm)
            free[cell] = False
    for cell in np.flatnonzero(shapely.contains_xy(plan.tray, points)):
        fills[TRAY][cell] = ZRange(0.0, ground[cell])
    for sliver, neighbour in cells.find_slivers().items():
        for z_ranges in fills.values():
            z_ranges[sliver] = z_ranges[neighbour]
    return cells, {name: z_ranges for name, z_ranges in fills.items() if any(z_ranges)}


def _ridge_prisms(plan: Plan, fit_mm: float, wells: Sequence[BaseGeometry]) -> Iterator[_RaisedOutline]:
    """Yield the terraces of the ridges of every layer."""
    mould = plan.settings.mould
    families = {layer: plan.family(fibre) for fibre, layer in enumerate(plan.layer_indices)}
    for layer, height_mm in enumerate(plan.heights_mm):
        for down_mm in terraces(height_mm, plan.settings.terrace_mm):
            outline = plan.outline(layer, down_mm, FINE_MM)
            if wells and not down_mm:
                outline = shapely.union_all([outline, wells[layer]], grid_size=GRID_MM)
            joints = find_joints(plan, layer, mould.ridge_width_mm / 2 + down_mm * plan.settings.ridge_slope)
            outline = insert_joints(outline, joints)
            top = mould.floor_mm + height_mm - down_mm
            curves = outline_curves(outline, joints, (mould.floor_mm, top), fit_mm)
            yield _RaisedOutline((HORIZONTAL_TRACKS, VERTICAL_TRACKS)[families[layer]], top, outline, curves)


def _number_prisms(plan: Plan) -> Iterator[_RaisedOutline]:
    top = plan.settings.mould.floor_mm + plan.settings.mould.shallow_ridge_height_mm
    for outline in plan.numbers:
        if outline is not None:
            yield _RaisedOutline(NUMBERS, top, outline, edge_curves(outline.boundary))


def compute_contact_area(cells: Subdivision, fills: Fills) -> float:
    """Return the area where parts touch, mm²: undersides, crossings, ends at upright walls."""
    area = 0.0
    owner = np.full(len(cells.cells) + 1, -1)  # the last entry stands for no cell
    bottom, top = np.zeros(len(owner)), np.zeros(len(owner))
    for number, name in enumerate(sorted(fills, key=lambda name: name != TRAY)):  # what stands on the tray hides it
        for cell, z_range in enumerate(fills[name]):
            if z_range is not None:
                owner[cell], bottom[cell], top[cell] = number, _base_height(z_range.bottom), _base_height(z_range.top)
                if name != TRAY:
                    ground = z_range.bottom
                    lean = math.hypot(*ground[0].normal(ground[1])) if isinstance(ground, tuple) else 1.0
                    area += lean * cells.cells[cell].area
    between = (owner[cells.sides] >= 0).all(axis=1) & (owner[cells.sides[:, 0]] != owner[cells.sides[:, 1]])
    (a, b), edges = cells.sides[between].T, np.array(cells.edges, dtype=float)[between]
    length = GRID_MM * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    return area + float(length @ np.maximum(0, np.minimum(top[a], top[b]) - np.maximum(bottom[a], bottom[b])))


def _base_height(surface: Surface) -> float:
    """Height of a surface, mm; of a flared wall its foot."""
    return surface[0].floor_mm if isinstance(surface, tuple) else surface
