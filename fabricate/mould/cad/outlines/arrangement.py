"""The cells of a drawing that belong to one part, their borders as chains of true curves that meet in nodes."""

import math
from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from padforge.fabricate.mould.plan import polygon_rings

from .drawing import GRID_MM, Drawing, Edge, Vertex, edges
from .pieces import Piece

Array = NDArray[np.float64]
Loop = list[tuple[int, bool]]
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
class Chain:
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


class Arrangement:
    """Some cells of a drawing and what is between them.

    Args:
        kinds: of every cell, None for those left out; there is no border between neighbours of one kind.

    Attributes:
        nodes: (V, 2) places, mm. slack_mm: (V,) how far the curves that meet in a node stay away from it.
    """

    def __init__(self, drawing: Drawing, kinds: Sequence[Hashable | None]) -> None:
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
        self.chains: list[Chain] = []
        self._first: dict[Edge, tuple[int, bool]] = {}
        self._counts: dict[Edge, int] = {}
        for run, (a, b), reach in zip(runs, ends, reached, strict=True):
            there, back = (run.vertices[0], run.vertices[1]), (run.vertices[-1], run.vertices[-2])
            self._counts[there] = self._counts[back] = len(run.vertices) - 1
            if a != b:
                self._first[there], self._first[back] = (len(self.chains), True), (len(self.chains), False)
                self.chains.append(Chain(run.piece, *reach, (a, b), left[there], left[there[::-1]]))

    def faces(self, cells: Sequence[int]) -> Iterator[list[Loop]]:
        """Every connected part of cells taken together, as its loops, the outer one first."""
        for rings in polygon_rings(shapely.coverage_union_all(self._cells[list(cells)])):
            outer, *holes = (self._loop(list(edges(ring))) for ring in rings)
            if len(outer) > 1:  # a loop of fewer has shrunk to a node
                yield [outer, *(hole for hole in holes if len(hole) > 1)]

    def _loop(self, steps: list[Edge]) -> Loop:
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


def _runs(pieces: dict[Edge, int]) -> list[tuple[int, list[Vertex]]]:
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


def _forward(runs: list[tuple[int, list[Vertex]]], pieces: Sequence[Piece]) -> list[_Run]:
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
