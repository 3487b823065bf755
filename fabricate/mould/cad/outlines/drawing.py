"""All outlines of a mould in one drawing, where they divide each other into cells.

The outlines are drawn finely enough for shapely to find out what meets what; which smooth piece every edge of the
drawing is of is kept, so that the true curves can be put in its place.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from padforge.fabricate.mould.plan import polygon_rings

from .pieces import Piece

Array = NDArray[np.float64]
Vertex = tuple[int, int]
"""A place on the grid, in steps of it."""
Edge = tuple[Vertex, Vertex]

GRID_MM = 1e-6
"""Grid that the vertices of the drawing are moved to."""
_THIN_MM = 5e-6
"""Cells no wider than this come of moving vertices to the grid."""


class Drawing:
    """Lines that divide the plane.

    Args:
        lines: all of them, however they cross. pieces: what they were drawn from.

    Attributes:
        cells: (C,) polygons. middles: (C, 2) a place within each.
        edges: every edge between or around cells once. sides: (E, 2) the cells to the left and right of each, -1 for
            none. pieces_of: (E,) number of the piece each was drawn from.
    """

    def __init__(self, lines: Sequence[BaseGeometry], pieces: Sequence[Piece]) -> None:
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


def edges(ring: Array) -> Iterator[Edge]:
    """The edges of a ring (n, 2), on the grid."""
    vertices = list(map(tuple, np.rint(ring / GRID_MM).astype(np.int64).tolist()))
    return zip(vertices, vertices[1:] + vertices[:1], strict=True)


def _pieces_of(drawn: Sequence[Edge], pieces: Sequence[Piece]) -> NDArray[np.intp]:
    middles = shapely.points(GRID_MM * np.array(drawn, dtype=float).mean(axis=1))
    ends = [np.stack([piece.points[:-1], piece.points[1:]], axis=1) for piece in pieces]
    owner = np.repeat(np.arange(len(pieces)), [len(each) for each in ends])
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.concatenate(ends))))
    nearest = tree.query_nearest(middles, all_matches=False)
    return owner[nearest[1]]
