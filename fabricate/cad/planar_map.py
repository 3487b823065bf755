"""Which part of a mould fills every cell of its drawing, from what height to what height.

Parts touch and do not overlap: tracks and numbers stand on the tray, and where tracks cross the taller one goes
through. Lengths are mm, z = 0 is the underside of the tray.
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

from padforge.fabricate.cad.curves import FINE_MM, OutlineCurve, joints, outline_pieces, straight_pieces, with_joints
from padforge.fabricate.mould import terraces
from padforge.fabricate.plan import Plan, polygon_rings

Array = NDArray[np.float64]
Vertex = tuple[int, int]
"""A place on the grid, in steps of it."""
MapEdge = tuple[Vertex, Vertex]

GRID_MM = 1e-6
"""Grid that the vertices of the drawing are moved to."""
_THIN_MM = 5e-6
"""Cells no wider than this come of moving vertices to the grid."""


class Subdivision:
    """Lines that divide the plane.

    Args:
        lines: all of them, however they cross. pieces: what they were drawn from.

    Attributes:
        cells: (C,) polygons. middles: (C, 2) a place within each.
        edges: every edge between or around cells once. sides: (E, 2) the cells to the left and right of each, -1 for
            none. pieces_of: (E,) number of the piece each was drawn from.
    """

    def __init__(self, lines: Sequence[BaseGeometry], pieces: Sequence[OutlineCurve]) -> None:
        self.pieces = pieces
        drawn = shapely.union_all(lines, grid_size=GRID_MM)
        self.cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(drawn)))
        self.middles = shapely.get_coordinates(shapely.point_on_surface(self.cells))
        left = {
            edge: number
            for number, cell in enumerate(self.cells)
            for ring in polygon_rings(cell)[0]
            for edge in edges(ring)
        }
        self.edges = [edge for edge in left if edge[0] < edge[1] or edge[::-1] not in left]
        self.sides = np.array([(left[a, b], left.get((b, a), -1)) for a, b in self.edges])
        self.pieces_of = _pieces_of(self.edges, pieces)

    def thin(self) -> dict[int, int]:
        """Cells that are there by rounding only, each with the cell it shares most of its boundary with."""
        thin = np.append(2 * shapely.area(self.cells) < _THIN_MM * shapely.length(self.cells), False)
        shared: dict[int, dict[int, float]] = {cell: {} for cell in np.flatnonzero(thin).tolist()}
        for k in np.flatnonzero(thin[self.sides].sum(axis=1) == 1):
            cell, beside = self.sides[k].tolist() if thin[self.sides[k, 0]] else self.sides[k, ::-1].tolist()
            if beside >= 0:
                shared[cell][beside] = shared[cell].get(beside, 0.0) + math.dist(*self.edges[k])
        return {cell: max(beside, key=beside.__getitem__) for cell, beside in shared.items() if beside}


def edges(ring: Array) -> Iterator[MapEdge]:
    """The edges of a ring (n, 2), on the grid."""
    vertices = list(map(tuple, np.rint(ring / GRID_MM).astype(np.int64).tolist()))
    return zip(vertices, vertices[1:] + vertices[:1], strict=True)


def _pieces_of(drawn: Sequence[MapEdge], pieces: Sequence[OutlineCurve]) -> NDArray[np.intp]:
    middles = shapely.points(GRID_MM * np.array(drawn, dtype=float).mean(axis=1))
    ends = [np.stack([piece.points[:-1], piece.points[1:]], axis=1) for piece in pieces]
    owner = np.repeat(np.arange(len(pieces)), [len(each) for each in ends])
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.concatenate(ends))))
    nearest = tree.query_nearest(middles, all_matches=False)
    return owner[nearest[1]]


Array = NDArray[np.float64]
BorderWire = list[tuple[int, bool]]
"""A closed round of chains, the face to its left: number of each, and whether it runs along its piece."""

_AT_END_MM = 5e-6
_SHORT_MM = 1e-5
"""Runs shorter than this come of moving vertices to the grid, or are none where curves meet."""
_LOOSE_MM, _HARDLY_MM = 1e-6, 0.02
"""Where curves stay further apart than the first, a run shorter than the second may be none: they meet beyond it."""
_MEET_MM = 0.1
"""Curves meet no further than this from where their drawings do."""
_STEPS = 12


@dataclass(frozen=True)
class BorderEdge:
    """A stretch of a piece between two nodes, from length `start` along it to `end`, `start` < `end`.

    Attributes:
        left, right: the cells beside it, -1 for none.
    """

    piece: int
    start: float
    end: float
    nodes: tuple[int, int]
    left: int
    right: int


@dataclass(frozen=True)
class _Run:
    """Edges of the drawing from node to node, along their piece, and the lengths along it where they begin and end."""

    piece: int
    vertices: list[Vertex]
    reach: tuple[float, float]


class PlanarMap:
    """Some cells of a drawing and what is between them.

    Args:
        kinds: of every cell, None for those left out; there is no border between neighbours of one kind.

    Attributes:
        nodes: (V, 2) places, mm. slack_mm: (V,) how far the curves that meet in a node stay away from it.
    """

    def __init__(self, drawing: Subdivision, kinds: Sequence[Hashable | None]) -> None:
        self._cells, self.pieces = drawing.cells, drawing.pieces
        codes: dict[Hashable | None, int] = {None: -1}
        kind = np.array([*(codes.setdefault(each, len(codes)) for each in kinds), -1])
        between = np.flatnonzero(kind[drawing.sides[:, 0]] != kind[drawing.sides[:, 1]]).tolist()
        sides = np.where(kind[drawing.sides] < 0, -1, drawing.sides)
        left = {drawing.edges[k]: cell for k, cell in zip(between, sides[between, 0].tolist(), strict=True)}
        left |= {drawing.edges[k][::-1]: cell for k, cell in zip(between, sides[between, 1].tolist(), strict=True)}
        runs = _forward(_runs({drawing.edges[k]: int(drawing.pieces_of[k]) for k in between}), drawing.pieces)
        none = np.array([run.reach[1] - run.reach[0] < _SHORT_MM for run in runs])
        while True:
            ends = _end_nodes(runs, none)
            self.nodes, self.slack_mm, reached = self._met(runs, ends)
            over = _over(ends, reached, self.slack_mm)
            if not over:
                break
            none[over] = True
        self.chains: list[BorderEdge] = []
        self._first: dict[MapEdge, tuple[int, bool]] = {}
        self._counts: dict[MapEdge, int] = {}
        for run, (a, b), reach in zip(runs, ends, reached, strict=True):
            there, back = (run.vertices[0], run.vertices[1]), (run.vertices[-1], run.vertices[-2])
            self._counts[there] = self._counts[back] = len(run.vertices) - 1
            if a != b:
                self._first[there], self._first[back] = (len(self.chains), True), (len(self.chains), False)
                self.chains.append(BorderEdge(run.piece, *reach, (a, b), left[there], left[there[::-1]]))

    def faces(self, cells: Sequence[int]) -> Iterator[list[BorderWire]]:
        """Every connected part of cells taken together, as its loops, the outer one first."""
        for rings in polygon_rings(shapely.coverage_union_all(self._cells[list(cells)])):
            outer, *holes = (self._loop(list(edges(ring))) for ring in rings)
            if len(outer) > 1:  # a loop of fewer has shrunk to a node
                yield [outer, *(hole for hole in holes if len(hole) > 1)]

    def _loop(self, steps: list[MapEdge]) -> BorderWire:
        at = next(i for i, step in enumerate(steps) if step in self._counts)
        loop, end = [], at + len(steps)
        while at < end:
            step = steps[at % len(steps)]
            if step in self._first:
                loop.append(self._first[step])
            at += self._counts[step]
        return loop

    def _met(
        self, runs: Sequence[_Run], ends: Sequence[tuple[int, int]]
    ) -> tuple[Array, Array, list[tuple[float, float]]]:
        """Where curves meet: places of nodes, how far curves stay away from them, and where every run ends."""
        at_node: dict[int, dict[int, float]] = defaultdict(dict)
        for run, nodes in zip(runs, ends, strict=True):
            for node, s in zip(nodes, run.reach, strict=True):
                if nodes[0] != nodes[1]:
                    at_node[node].setdefault(run.piece, s)
        met = [self._meet(at_node[node]) for node in range(1 + max(map(max, ends)))]
        reached = [
            (at_node[a][run.piece], at_node[b][run.piece]) if a != b else run.reach
            for run, (a, b) in zip(runs, ends, strict=True)
        ]
        return np.array([place for place, _ in met]), np.array([slack for _, slack in met]), reached

    def _meet(self, lengths: dict[int, float]) -> tuple[Array, float]:
        """Where pieces meet near the given lengths along them, which are put right, and how far they stay away."""
        if not lengths:
            return np.zeros(2), 0.0
        inner = [piece for piece, s in lengths.items() if 0 < s < self.pieces[piece].length]
        if inner and len(lengths) > 1:
            self._cross(lengths, inner)
        points = [self.pieces[piece].run(s)[:2] for piece, s in lengths.items()]
        place = np.mean(points, axis=0)
        return place, max(math.dist(point, place) for point in points)

    def _cross(self, lengths: dict[int, float], inner: list[int]) -> None:
        """Move lengths to the common point of the two pieces that cross most steeply, by Newton's method."""
        runs = {piece: self.pieces[piece].run(s) for piece, s in lengths.items()}
        pairs = [(a, b) for a in inner for b in lengths if a != b]
        first, second = max(pairs, key=lambda pair: abs(_turn(runs[pair[0]], runs[pair[1]])))
        a, b = self.pieces[first], self.pieces[second]
        s, u = begun = lengths[first], lengths[second]
        for _ in range(_STEPS):
            x, y, ax, ay = a.run(s)
            other_x, other_y, bx, by = b.run(u)
            det = bx * ay - ax * by
            if abs(det) < 1e-6:
                return
            away_x, away_y = other_x - x, other_y - y
            forth, back = (bx * away_y - by * away_x) / det, (ax * away_y - ay * away_x) / det
            s, u = min(max(s + forth, 0), a.length), min(max(u + back, 0), b.length)
            if max(abs(forth), abs(back)) < 1e-12:
                break
        if math.dist(a.run(s)[:2], b.run(u)[:2]) < 1e-9 and max(abs(s - begun[0]), abs(u - begun[1])) < _MEET_MM:
            lengths[first], lengths[second] = s, u


def _turn(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Sine of the angle between two pieces, from how they run."""
    return (a[2] * b[3] - a[3] * b[2]) / math.hypot(*a[2:]) / math.hypot(*b[2:])


def _runs(pieces: dict[MapEdge, int]) -> list[tuple[int, list[Vertex]]]:
    """Edges joined to runs of one piece each, as far as no third edge and no other piece meets them."""
    beside: dict[Vertex, list[tuple[Vertex, int]]] = defaultdict(list)
    for (a, b), piece in pieces.items():
        beside[a].append((b, piece))
        beside[b].append((a, piece))
    through = {v for v, others in beside.items() if len(others) == 2 and others[0][1] == others[1][1]}
    runs, done = [], set()
    for start in beside:
        if start in through:
            continue
        for second, piece in beside[start]:
            if (start, second) in done:
                continue
            run = [start, second]
            while run[-1] in through:
                (a, _), (b, _) = beside[run[-1]]
                run.append(b if a == run[-2] else a)
            done |= {(run[0], run[1]), (run[-1], run[-2])}
            runs.append((piece, run))
    return runs


def _forward(runs: list[tuple[int, list[Vertex]]], pieces: Sequence[OutlineCurve]) -> list[_Run]:
    """The runs along their pieces."""
    lines = np.array([shapely.LineString(piece.points) for piece in pieces])[[piece for piece, _ in runs]]
    ends = [shapely.points(GRID_MM * np.array([run[i] for _, run in runs], dtype=float)) for i in (0, -1)]
    lengths = np.stack([shapely.line_locate_point(lines, each) for each in ends], axis=1)
    whole = np.array([pieces[piece].length for piece, _ in runs])[:, None]
    lengths = np.where(lengths < _AT_END_MM, 0, np.where(lengths > whole - _AT_END_MM, whole, lengths))
    return [
        _Run(piece, run, (a, b)) if a <= b else _Run(piece, run[::-1], (b, a))
        for (piece, run), (a, b) in zip(runs, lengths.tolist(), strict=True)
    ]


def _over(ends: Sequence[tuple[int, int]], reached: Sequence[tuple[float, float]], slack_mm: Array) -> list[int]:
    """Runs that end where they have hardly begun: others meet in the other order, or beyond them."""
    lengths = np.array([end - start if a != b else np.inf for (a, b), (start, end) in zip(ends, reached, strict=True)])
    loose = [any(slack_mm[node] > _LOOSE_MM for node in nodes) for nodes in ends]
    return np.flatnonzero((lengths < _SHORT_MM) | (loose & (lengths < _HARDLY_MM))).tolist()


def _end_nodes(runs: Sequence[_Run], none: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The nodes at the ends of every run, one for both where the run is marked as none."""
    numbers: dict[Vertex, int] = {}
    ends = np.array([[numbers.setdefault(run.vertices[i], len(numbers)) for i in (0, -1)] for run in runs])
    a, b = ends[none].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(numbers), len(numbers)))
    return list(map(tuple, connected_components(links, directed=False)[1][ends].tolist()))


Array = NDArray[np.float64]

FLOOR, RIM = -1, -2
"""The floor between the walls, and the rim on top of them, among the numbers of the walls' planes."""


@dataclass(frozen=True, eq=False)
class TrayWalls:
    """The tray's floor and its leaning walls, as a height over every place.

    Args:
        hollows: (k, 4) least x and y and greatest x and y, on the floor, of the rectangles the silicone fills.
        floor_mm: height of the floor. depth_mm: of the rim above it. flare_mm: how far walls lean outwards up to there.
    """

    hollows: Array
    floor_mm: float
    depth_mm: float
    flare_mm: float

    def sheets(self, places: Array) -> NDArray[np.intp]:
        """(n,) what lies under places (n, 2): `FLOOR`, `RIM` or the number of a wall's plane."""
        beyond = self._beyond(places)
        hollow = beyond.max(axis=2).argmin(axis=1)
        nearest = beyond[np.arange(len(places)), hollow]
        away = nearest.max(axis=1)
        return np.where(away <= 0, FLOOR, np.where(away >= self.flare_mm, RIM, 4 * hollow + nearest.argmax(axis=1)))

    def heights(self, places: Array) -> Array:
        """(n,) heights of what lies under places (n, 2), mm."""
        away = self._beyond(places).max(axis=2).min(axis=1)
        rise = np.clip(away / self.flare_mm, 0, 1) if self.flare_mm else away > 0
        return self.floor_mm + self.depth_mm * rise

    @property
    def slope(self) -> float:
        """How steeply walls that lean rise, mm for every mm outwards."""
        return self.depth_mm / self.flare_mm

    def plane(self, sheet: int, places: Array) -> Array:
        """(n,) heights of a wall's plane over places (n, 2), mm."""
        hollow, side = divmod(sheet, 4)
        return self.floor_mm + self.slope * self._beyond(places)[:, hollow, side]

    def normal(self, sheet: int) -> tuple[float, float, float]:
        """Upward normal of a wall's plane, not of unit length."""
        side = sheet % 4
        along = self.slope if side < 2 else -self.slope
        return (along, 0.0, 1.0) if side % 2 == 0 else (0.0, along, 1.0)

    def outline(self, z: float) -> shapely.Polygon:
        """What is open at a height, seen from above."""
        ring = self._floor_ring
        return shapely.Polygon(ring + (z - self.floor_mm) / self.depth_mm * self.flare_mm * self._outward)

    def creases(self) -> list[shapely.LineString]:
        """Lines between the planes: the floor's outline and where two walls meet."""
        ring, top = self._floor_ring, self._floor_ring + self.flare_mm * self._outward
        corners = [shapely.LineString(ends) for ends in zip(ring, top, strict=True)] if self.flare_mm else []
        return [self.outline(self.floor_mm).exterior, *corners]

    def _beyond(self, places: Array) -> Array:
        """(n, k, 4) how far places lie beyond every side of every hollow."""
        low, high = self.hollows[:, :2], self.hollows[:, 2:]
        return np.concatenate([low - places[:, None], places[:, None] - high], axis=2)

    @cached_property
    def _floor_ring(self) -> Array:
        union = shapely.union_all(shapely.box(*self.hollows.T)).simplify(0)
        return polygon_rings(union)[0][0]

    @cached_property
    def _outward(self) -> Array:
        """(n, 2) how the corners of the floor's outline move for 1 mm of lean; its edges are upright or level."""
        edges = np.roll(self._floor_ring, -1, axis=0) - self._floor_ring
        away = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
        return away + np.roll(away, 1, axis=0)


def walls_of(plan: Plan) -> TrayWalls:
    """The walls of a plan's tray."""
    hollows = np.array([shapely.bounds(each) for each in (plan.cavity, *plan.exits)])
    return TrayWalls(hollows, plan.settings.mould.floor_mm, plan.silicone_mm, plan.flare_mm)


Surface = float | tuple[TrayWalls, int]
"""A height, mm, or one of the walls' planes."""
TRAY, HORIZONTAL_TRACKS, VERTICAL_TRACKS, NUMBERS = PARTS = ("tray", "horizontal tracks", "vertical tracks", "numbers")


class ZRange(NamedTuple):
    """What bounds a part below and above."""

    bottom: Surface
    top: Surface


@dataclass(frozen=True)
class PartFill:
    """A named part: of every cell of the drawing what it fills, None for nothing."""

    name: str
    spans: Sequence[ZRange | None]


class _Standing(NamedTuple):
    """What stands on the floor: of which part, up to where, and its outline."""

    part: str
    top_mm: float
    outline: BaseGeometry
    pieces: list[OutlineCurve]


def fill_cells(plan: Plan, fit_mm: float, wells: Sequence[BaseGeometry] = ()) -> tuple[Subdivision, list[PartFill]]:
    """The drawing of a mould and its parts.

    Args:
        fit_mm: how near splines stay to the finely drawn outlines.
        wells: outlines that belong to the ridges of each level; none for a pad whose fibres are laid.
    """
    walls = walls_of(plan)
    rim_mm = walls.floor_mm + walls.depth_mm
    standing = sorted([*_ridges(plan, fit_mm, wells), *_numbers(plan)], key=lambda each: -each.top_mm)
    opened = [walls.outline(z).boundary for z in sorted({*(each.top_mm for each in standing), rim_mm})]
    straight = [plan.tray.boundary, *opened, *walls.creases(), plan.pillars.boundary]
    pieces = [piece for line in straight for piece in straight_pieces(line)]
    pieces += [piece for each in standing for piece in each.pieces]
    drawing = Subdivision([*straight, *(each.outline.boundary for each in standing)], pieces)

    sheets = walls.sheets(drawing.middles).tolist()
    under: list[Surface] = [walls.floor_mm if k == FLOOR else rim_mm if k == RIM else (walls, k) for k in sheets]
    heights = walls.heights(drawing.middles)
    for cell in np.flatnonzero(shapely.contains_xy(plan.pillars, drawing.middles)):
        under[cell] = heights[cell] = rim_mm
    spans: dict[str, list[ZRange | None]] = {name: [None] * len(under) for name in PARTS}
    free = np.ones(len(under), dtype=bool)
    for each in standing:
        shapely.prepare(each.outline)
        for cell in np.flatnonzero(free & shapely.contains_xy(each.outline, drawing.middles) & (heights < each.top_mm)):
            spans[each.part][cell] = ZRange(under[cell], each.top_mm)
            free[cell] = False
    for cell in np.flatnonzero(shapely.contains_xy(plan.tray, drawing.middles)):
        spans[TRAY][cell] = ZRange(0.0, under[cell])
    for thin, beside in drawing.thin().items():
        for each in spans.values():
            each[thin] = each[beside]
    return drawing, [PartFill(name, each) for name, each in spans.items() if any(each)]


def _ridges(plan: Plan, fit_mm: float, wells: Sequence[BaseGeometry]) -> Iterator[_Standing]:
    """The terraces of the ridges of every level."""
    families = {level: plan.family(fibre) for fibre, level in enumerate(plan.layer_indices)}
    for level, height_mm in enumerate(plan.heights_mm):
        for down_mm in terraces(height_mm, plan.settings.terrace_mm):
            outline = plan.outline(level, down_mm, FINE_MM)
            if wells and not down_mm:
                outline = shapely.union_all([outline, wells[level]], grid_size=GRID_MM)
            at = joints(plan, level, plan.settings.mould.ridge_width_mm / 2 + down_mm * plan.settings.ridge_slope)
            outline = with_joints(outline, at)
            top = plan.settings.mould.floor_mm + height_mm - down_mm
            yield _Standing(
                (HORIZONTAL_TRACKS, VERTICAL_TRACKS)[families[level]],
                top,
                outline,
                outline_pieces(outline, at, (plan.settings.mould.floor_mm, top), fit_mm),
            )


def _numbers(plan: Plan) -> Iterator[_Standing]:
    top = plan.settings.mould.floor_mm + plan.settings.mould.shallow_ridge_height_mm
    for outline in plan.numbers:
        if outline is not None:
            yield _Standing(NUMBERS, top, outline, straight_pieces(outline.boundary))


def contact_mm2(drawing: Subdivision, parts: Sequence[PartFill]) -> float:
    """The area where parts touch each other: undersides of what stands, crossings, ends at upright walls."""
    area = 0.0
    owner = np.full(len(drawing.cells) + 1, -1)  # the last stands for no cell
    low, top = np.zeros(len(owner)), np.zeros(len(owner))
    for number, part in enumerate(sorted(parts, key=lambda part: part.name != TRAY)):  # what stands on it hides it
        for cell, span in enumerate(part.spans):
            if span is not None:
                owner[cell], low[cell], top[cell] = number, _level(span.bottom), _level(span.top)
                if part.name != TRAY:
                    lean = math.hypot(*span.bottom[0].normal(span.bottom[1])) if isinstance(span.bottom, tuple) else 1.0
                    area += lean * drawing.cells[cell].area
    between = (owner[drawing.sides] >= 0).all(axis=1) & (owner[drawing.sides[:, 0]] != owner[drawing.sides[:, 1]])
    (left, right), edges = drawing.sides[between].T, np.array(drawing.edges, dtype=float)[between]
    long = GRID_MM * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    return area + float(long @ np.maximum(0, np.minimum(top[left], top[right]) - np.maximum(low[left], low[right])))


def _level(surface: Surface) -> float:
    """The height of a surface, mm; of a leaning wall its foot."""
    return surface[0].floor_mm if isinstance(surface, tuple) else surface
