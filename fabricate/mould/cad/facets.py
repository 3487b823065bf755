"""A CAD solid from a closed mesh: triangles of one plane become one face, bounded by shared edges.

The boundary is put together face by face. Nothing is intersected or fused, so thousands of edges take a fraction of
a second and no tolerance decides whether the solid closes. Lengths are mm.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

from typing import Any

import numpy as np
import shapely
from build123d import Solid
from manifold3d import Manifold
from numpy.typing import NDArray
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeVertex
from OCP.gp import gp_Dir, gp_Pln, gp_Pnt
from OCP.TopoDS import TopoDS_Shell, TopoDS_Solid, TopoDS_Wire
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

Ints = NDArray[np.int64]
Loops = list[list[int]]
"""Closed rounds of vertex numbers, the face to the left of each."""

SHORTEST_MM = 2e-7
"""Edges below this are contracted: the CAD kernel takes points within 1e-7 mm for one."""


def faceted_solid(solid: Manifold) -> Solid:
    """The boundary representation of a mesh, every face a plane polygon with its holes.

    Args:
        solid: a closed mesh, mm.

    Returns:
        A closed solid with outward normals; its vertices are those of the mesh, in double precision.
    """
    mesh = solid.to_mesh64()
    vertices, triangles = np.asarray(mesh.vert_properties), np.asarray(mesh.tri_verts, dtype=np.int64)
    source = np.repeat(np.asarray(mesh.run_original_id, dtype=np.int64), np.diff(mesh.run_index) // 3)
    kept = _contracted(vertices, triangles)
    shell = _Shell(vertices, _together(vertices))
    for loops, normal in _faces(vertices, triangles, np.stack([source, np.asarray(mesh.face_id, np.int64)], axis=1)):
        steady = [loop[loop != np.roll(loop, 1)].tolist() for loop in map(kept.__getitem__, loops)]  # without repeats
        simple = [part for loop in steady for part in shell.parted(loop) if len(part) > 2]
        for outer, holes in _nested(simple, vertices, normal):
            shell.add(normal, [outer, *holes])
    return Solid(shell.close())


def _contracted(vertices: NDArray[np.float64], triangles: Ints) -> Ints:
    """(n,) number of the vertex that stands for each: the same one for the two ends of an edge too short for CAD."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    short = np.linalg.norm(vertices[start] - vertices[end], axis=1) < SHORTEST_MM
    return _first_linked(len(vertices), np.stack([start[short], end[short]]))


def _together(vertices: NDArray[np.float64]) -> Ints:
    """(n,) number that stands for all vertices at one place: where the solid touches itself there are several."""
    pairs = KDTree(vertices).query_pairs(SHORTEST_MM, output_type="ndarray").reshape(-1, 2)
    return _first_linked(len(vertices), pairs.T)


def _first_linked(count: int, pairs: Ints) -> Ints:
    """(count,) number of the first of all that pairs (2, k) link with each."""
    links = coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(count, count))
    _, first, group = np.unique(connected_components(links, directed=False)[1], return_index=True, return_inverse=True)
    return first[group]


def _nested(loops: Loops, vertices: NDArray[np.float64], normal: NDArray[np.float64]) -> list[tuple[list[int], Loops]]:
    """Every outer loop of a face with the holes inside it."""
    areas = [_area(vertices[loop], normal) for loop in loops]
    outers = [loop for loop, area in zip(loops, areas, strict=True) if area > 0]
    holes = [loop for loop, area in zip(loops, areas, strict=True) if area < 0]
    if len(outers) < 2 or not holes:
        return [(outer, holes) for outer in outers]
    flat = vertices @ np.linalg.svd(normal[None])[2][1:].T  # in the plane of the face
    shapes = [shapely.Polygon(flat[outer]) for outer in outers]
    inside = [[hole for hole in holes if shape.covers(shapely.LinearRing(flat[hole]))] for shape in shapes]
    return list(zip(outers, inside, strict=True))


def _faces(vertices: NDArray[np.float64], triangles: Ints, plane: Ints) -> list[tuple[Loops, NDArray[np.float64]]]:
    """Every plane face as its loops, outer ones counter-clockwise about its normal, and that normal.

    Args:
        vertices: (n, 3). triangles: (m, 3) of a closed mesh.
        plane: (m, 2) mark of the plane each triangle lies in, equal for those that may be joined.
    """
    start = triangles.ravel()  # halfedge h runs from start[h] to end[h] with triangle h // 3 on its left
    end = np.roll(triangles, -1, axis=1).ravel()
    halfedge = np.arange(len(start))
    following = halfedge + 1 - 3 * (halfedge % 3 == 2)
    order = np.argsort(start * len(vertices) + end)
    twin = order[np.searchsorted(start * len(vertices) + end, end * len(vertices) + start, sorter=order)]
    mine, other = halfedge // 3, twin // 3
    inside = (plane[mine] == plane[other]).all(axis=1)
    count, face = connected_components(
        coo_array((np.ones(inside.sum()), (mine[inside], other[inside])), shape=2 * (len(triangles),)), directed=False
    )
    left = ~inside
    after = following.copy()  # the next edge of a face's boundary: round the vertex, across the edges inside the face
    turning = np.flatnonzero(left & inside[following])
    while len(turning):
        after[turning] = following[twin[after[turning]]]
        turning = turning[inside[after[turning]]]

    corners = vertices[triangles]
    normals = np.zeros((count, 3))
    np.add.at(normals, face, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    loops: list[Loops] = [[] for _ in range(count)]
    for first in np.flatnonzero(left).tolist():
        loop, h = [], first
        while left[h]:
            left[h] = False
            loop.append(int(start[h]))
            h = int(after[h])
        if loop:
            loops[face[first // 3]].append(loop)
    return list(zip(loops, normals, strict=True))


def _area(points: NDArray[np.float64], normal: NDArray[np.float64]) -> float:
    """Twice the area inside a loop (n, 3), positive if it runs counter-clockwise about `normal`."""
    away = points - points[0]
    return float(np.cross(away, np.roll(away, -1, axis=0)).sum(axis=0) @ normal)


class _Shell:
    """A shell in the making: plane faces that share vertices and edges."""

    def __init__(self, points: NDArray[np.float64], together: Ints) -> None:
        self.points = points.tolist()
        self.together = together.tolist()
        self.builder = BRep_Builder()
        self.shell = TopoDS_Shell()
        self.builder.MakeShell(self.shell)
        self.vertices: dict[int, Any] = {}
        self.edges: dict[tuple[int, int], Any] = {}

    def parted(self, loop: list[int]) -> Loops:
        """A loop as loops that pass no place twice; the CAD kernel knows no loop that touches itself."""
        parts: Loops = []
        path: list[int] = []
        at: dict[int, int] = {}
        for vertex in loop:
            place = self.together[vertex]
            if place in at:
                parts.append(path[at[place] :])
                for passed in path[at[place] :]:
                    del at[self.together[passed]]
                path = path[: len(path) - len(parts[-1])]
            at[place] = len(path)
            path.append(vertex)
        return [*parts, path]

    def add(self, normal: NDArray[np.float64], loops: Loops) -> None:
        """Add a plane face, its loops counter-clockwise about `normal`, the outer one first."""
        wires = [self._wire(loop) for loop in loops]
        plane = gp_Pln(gp_Pnt(*self.points[loops[0][0]]), gp_Dir(*normal.tolist()))
        face = BRepBuilderAPI_MakeFace(plane, wires[0], False)
        for hole in wires[1:]:
            face.Add(hole)
        self.builder.Add(self.shell, face.Face())

    def close(self) -> Any:
        """The solid inside the shell."""
        self.shell.Closed(True)
        solid = TopoDS_Solid()
        self.builder.MakeSolid(solid)
        self.builder.Add(solid, self.shell)
        return solid

    def _wire(self, loop: list[int]) -> Any:
        wire = TopoDS_Wire()
        self.builder.MakeWire(wire)
        for start, end in zip(loop, loop[1:] + loop[:1], strict=True):
            self.builder.Add(wire, self._edge(start, end))
        wire.Closed(True)
        return wire

    def _edge(self, start: int, end: int) -> Any:
        if (start, end) not in self.edges:
            edge = BRepBuilderAPI_MakeEdge(self._vertex(start), self._vertex(end)).Edge()
            self.builder.UpdateEdge(edge, 2 * SHORTEST_MM)
            self.edges[start, end], self.edges[end, start] = edge, edge.Reversed()
        return self.edges[start, end]

    def _vertex(self, number: int) -> Any:
        number = self.together[number]
        if number not in self.vertices:
            vertex = BRepBuilderAPI_MakeVertex(gp_Pnt(*self.points[number])).Vertex()
            self.builder.UpdateVertex(vertex, 2 * SHORTEST_MM)
            self.vertices[number] = vertex
        return self.vertices[number]
