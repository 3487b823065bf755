"""A solid from a height map: flat areas at several heights, joined by upright walls.

The boundary is put together face by face with shared edges. Nothing is intersected or fused, so thousands of edges
take a fraction of a second and no tolerance decides whether the solid closes. Lengths are mm.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from build123d import Solid
from OCP.BRep import BRep_Builder
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakeFace, BRepBuilderAPI_MakeVertex
from OCP.gp import gp_Dir, gp_Pln, gp_Pnt
from OCP.TopoDS import TopoDS_Shell, TopoDS_Solid, TopoDS_Wire
from shapely.geometry.base import BaseGeometry

from design.errors import InputError

from .outlines import polygon_rings

Place = tuple[int, int]
"""x and y in steps of the grid: exact, so that vertices of neighbouring areas are equal or apart."""

Corner = tuple[Place, float]
"""A vertex of the solid: place and z."""


def stepped_solid(plateaus: Sequence[tuple[BaseGeometry, float]], snap_mm: float) -> Solid:
    """The solid from z = 0 up to the given areas.

    Args:
        plateaus: areas and the z > 0 of their tops; they do not overlap, and neighbours share their vertices.
        snap_mm: grid that all vertices lie on.

    Returns:
        A closed solid with outward normals.

    Raises:
        InputError: the boundary does not close, or pieces of it meet in a single upright line.
    """
    tops = [(z, _loops(rings, snap_mm)) for area, z in plateaus for rings in _valid_rings(area)]
    left = {edge: z for z, loops in tops for loop in loops for edge in _edges(loop)}
    steps = _steps_at(left)
    shell = _Shell(snap_mm)
    for z, loops in tops:
        shell.add(gp_Dir(0, 0, 1), [[(place, z) for place in loop] for loop in loops])
    for (a, b), z in left.items():
        low = left.get((b, a), 0.0)
        if low < z:
            up = [(b, step) for step in steps[b] if low <= step <= z]
            down = [(a, step) for step in reversed(steps[a]) if low <= step <= z]
            shell.add(gp_Dir(b[1] - a[1], a[0] - b[0], 0), [up + down])
    for rings in polygon_rings(shapely.coverage_union_all([area for area, _ in plateaus])):
        loops = [loop[::-1] for loop in _loops(rings, snap_mm)]
        shell.add(gp_Dir(0, 0, -1), [[(place, 0.0) for place in loop] for loop in loops])
    return Solid(shell.close())


def _valid_rings(area: BaseGeometry) -> list[list[np.ndarray]]:
    """Rings of every polygon of `area`, none of which may touch itself along the way."""
    if not shapely.is_valid(area):
        raise InputError(f"mould: no closed solid, {shapely.is_valid_reason(area)}; try another [mould] tolerance_mm")
    return polygon_rings(area)


def _loops(rings: list[np.ndarray], snap_mm: float) -> list[list[Place]]:
    return [[(int(x), int(y)) for x, y in np.rint(ring / snap_mm)] for ring in rings]


def _edges(loop: list[Place]) -> list[tuple[Place, Place]]:
    return list(zip(loop, loop[1:] + loop[:1], strict=True))


def _steps_at(left: dict[tuple[Place, Place], float]) -> dict[Place, list[float]]:
    """The heights that meet at each place, ascending: where the upright line there is divided."""
    steps: dict[Place, set[float]] = {}
    for (a, b), z in left.items():
        heights = (z, left.get((b, a), 0.0))
        steps.setdefault(a, set()).update(heights)
        steps.setdefault(b, set()).update(heights)
    return {place: sorted(heights) for place, heights in steps.items()}


class _Shell:
    """A shell in the making: plane faces that share vertices and edges."""

    def __init__(self, snap_mm: float) -> None:
        self.snap_mm = snap_mm
        self.builder = BRep_Builder()
        self.shell = TopoDS_Shell()
        self.builder.MakeShell(self.shell)
        self.vertices: dict[Corner, Any] = {}
        self.edges: dict[tuple[Corner, Corner], Any] = {}
        self.used: dict[tuple[Corner, Corner], int] = {}

    def add(self, normal: Any, loops: list[list[Corner]]) -> None:
        """Add a plane face, its loops counter-clockwise about `normal`, the outer one first."""
        wires = [self._wire(loop) for loop in loops]
        face = BRepBuilderAPI_MakeFace(gp_Pln(self._point(loops[0][0]), normal), wires[0], False)
        for hole in wires[1:]:
            face.Add(hole)
        self.builder.Add(self.shell, face.Face())

    def close(self) -> Any:
        """The solid inside the shell.

        Every edge must have been passed exactly once each way: that, with faces that are valid in their planes,
        is what a closed and outward boundary means. The CAD kernel's own check takes the square of a face's edges,
        seconds for the floor between dense fibres.
        """
        for (start, end), count in self.used.items():
            if count != 1 or self.used.get((end, start)) != 1:
                x, y = np.array(start[0]) * self.snap_mm
                raise InputError(
                    f"mould: no closed solid, outlines touch at ({x:.3f}, {y:.3f}) mm; try another [mould] tolerance_mm"
                )
        self.shell.Closed(True)
        solid = TopoDS_Solid()
        self.builder.MakeSolid(solid)
        self.builder.Add(solid, self.shell)
        return solid

    def _wire(self, loop: list[Corner]) -> Any:
        wire = TopoDS_Wire()
        self.builder.MakeWire(wire)
        for start, end in zip(loop, loop[1:] + loop[:1], strict=True):
            self.builder.Add(wire, self._edge(start, end))
        wire.Closed(True)
        return wire

    def _edge(self, start: Corner, end: Corner) -> Any:
        self.used[start, end] = self.used.get((start, end), 0) + 1
        if (start, end) not in self.edges:
            edge = BRepBuilderAPI_MakeEdge(self._vertex(start), self._vertex(end)).Edge()
            self.edges[start, end], self.edges[end, start] = edge, edge.Reversed()
        return self.edges[start, end]

    def _vertex(self, corner: Corner) -> Any:
        if corner not in self.vertices:
            self.vertices[corner] = BRepBuilderAPI_MakeVertex(self._point(corner)).Vertex()
        return self.vertices[corner]

    def _point(self, corner: Corner) -> Any:
        (x, y), z = corner
        return gp_Pnt(x * self.snap_mm, y * self.snap_mm, z)
