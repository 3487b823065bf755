"""How near the mould's surface comes to the exact tracks, against the time and the size of the file it takes."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import shapely
from build123d import Face, Solid, Vector, Wire
from numpy.typing import NDArray
from shapely import affinity

from design.benchmarking.harness import Bench, BenchTrial
from design.pad.courses.curves import flatten
from design.pad.morphology import Morphology
from fabricate.settings import DEFAULTS, MouldSettings

from .assembly import mould_body, plan_mesh
from .cad_solid import faceted_solid
from .plan import Plan, polygon_rings
from .prisms import Body, Prism

GRID, KNOTS = 4, (1, 5, 20)
TOLERANCES_MM = (0.05, 0.01, 0.002)
FUSED_UP_TO = 5
"""Beyond so many knots a fibre, Boolean operations of the CAD kernel take minutes."""
SEED = 0
_EXACT_MM = 1e-5
"""What exact curves are flattened to for comparison."""
_CLEAR_MM = 1.0
"""Near the walls outlines belong to exits."""


def trials() -> Iterator[BenchTrial]:
    """Every way at every tolerance for random pads of N in KNOTS, from the fibres to the solid.

    The error is the greatest deviation, mm, and the size the tolerance, micrometres; "faces" are triangles of the mesh
    or faces of the CAD solid, "file_bytes" the size of its STL or of its STEP.
    """
    for knots in KNOTS:
        pad = Morphology.random(GRID, knots, SEED)
        for tolerance in TOLERANCES_MM:
            settings = replace(DEFAULTS, mould=MouldSettings(tolerance_mm=tolerance, number_mm=0))
            plan = partial(Plan, pad, settings)
            for way, (work, judge) in (DIRECT if knots > FUSED_UP_TO else DIRECT | FUSED).items():
                yield BenchTrial(f"N={knots}", way, 1000 * tolerance, partial(work, plan), partial(judge, plan))


def _mesh_row(new_plan: Callable[[], Plan], solid: Any) -> Mapping[str, float]:
    plan = new_plan()
    outline = solid.slice(plan.settings.mould.floor_mm + plan.heights_mm[0] / 2).to_polygons()
    points = np.vstack([_with_middles(np.asarray(ring)) for ring in outline])
    faces = solid.num_tri()
    return {"error": _deviation(plan, points), "faces": faces, "file_bytes": 84 + 50 * faces}


def _cad_row(new_plan: Callable[[], Plan], solid: Any) -> Mapping[str, float]:
    from fabricate.mesh_files import write_step

    plan = new_plan()
    points = np.vstack(
        [_with_middles(ends, closed=False) for ends in _level_edges(solid, plan.settings.mould.floor_mm)]
    )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mould.step"
        write_step(path, solid)
        written = path.stat().st_size
    return {"error": _deviation(plan, points), "faces": len(solid.faces()), "file_bytes": written}


Way = tuple[Callable[..., Any], Callable[..., Mapping[str, float]]]
DIRECT: dict[str, Way] = {
    "manifold3d": (lambda new_plan: plan_mesh(new_plan()), _mesh_row),
    "direct CAD": (lambda new_plan: faceted_solid(plan_mesh(new_plan())), _cad_row),
}
FUSED: dict[str, Way] = {"fused CAD": (lambda new_plan: fused_solid(mould_body(new_plan())), _cad_row)}


def _level_edges(solid: Any, z: float) -> Iterator[NDArray[np.float64]]:
    """The ends (2, 2) of every edge of a solid that lies at a height."""
    for edge in solid.edges():
        ends = np.array([[p.X, p.Y, p.Z] for p in (edge.start_point(), edge.end_point())])
        if np.abs(ends[:, 2] - z).max() < 1e-6:
            yield ends[:, :2]


def _with_middles(points: NDArray[np.float64], closed: bool = True) -> NDArray[np.float64]:
    """The vertices of a line or ring and the middles of its edges, where a chord is furthest from its arc."""
    after = np.roll(points, -1, axis=0) if closed else points[1:]
    return np.vstack([points, (points[: len(after)] + after) / 2])


def _deviation(plan: Plan, points: NDArray[np.float64]) -> float:
    """How far ridge outlines stray, at most, from where they belong: half a ridge's width from the nearest curve."""
    pad, width = plan.pad, plan.settings.mould.ridge_width_mm
    lines = [pad.to_mm(line) for line in flatten(pad, _EXACT_MM / pad.pitch_mm)]
    curves = np.asarray(shapely.linestrings(np.concatenate([np.stack([a[:-1], a[1:]], axis=1) for a in lines])))
    inside = np.abs(points).max(axis=1) < plan.cavity.bounds[2] - _CLEAR_MM
    _, distance = shapely.STRtree(curves).query_nearest(
        shapely.points(points[inside]), return_distance=True, all_matches=False
    )
    return float(np.abs(distance - width / 2).max())


BENCH = Bench(
    "mould", trials, "deviation from the exact tracks (mm)", ("fused CAD", 10), ("manifold3d", 10), plain=("fused CAD",)
)


def fused_solid(body: Body) -> Any:
    """A body as a build123d `Solid`, or a `Compound` of several, by Boolean operations; lengths in mm."""
    solid: Any
    solid, *more = _prisms(body.base)
    if more:
        solid = solid.fuse(*more)
    if body.cuts:
        solid = solid.cut(*_prisms(body.cuts))
    return solid.fuse(*_prisms(body.adds)) if body.adds else solid


def _prisms(prisms: Iterable[Prism]) -> list[Solid]:
    return [solid for prism in prisms for solid in _solids(prism)]


def _solids(prism: Prism) -> list[Solid]:
    """One solid for every polygon of a prism's area."""
    polygons = [[_wire(ring, prism.bottom_mm) for ring in rings] for rings in polygon_rings(prism.area)]
    if not prism.flare_mm:
        up = Vector(0, 0, prism.top_mm - prism.bottom_mm)
        return [Solid.extrude(Face(outer, holes), up) for outer, *holes in polygons]
    low, high = np.reshape(prism.area.bounds, (2, 2))
    x, y = 1 + 2 * prism.flare_mm / (high - low)
    grown = affinity.scale(prism.area, x, y, origin=tuple((low + high) / 2))
    (((outer,),), ((ring,),)) = polygons, polygon_rings(grown)
    return [Solid.make_loft([outer, _wire(ring, prism.top_mm)], ruled=True)]


def _wire(ring: np.ndarray, z: float) -> Wire:
    return Wire.make_polygon([Vector(x, y, z) for x, y in ring.tolist()], close=True)
