"""How near the mould's surface comes to the exact tracks, against the time and the size of the file it takes."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import shapely
from build123d import Edge, GeomType, PositionMode
from numpy.typing import NDArray

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import flatten
from padforge.fabricate.mould.assembly import mould_body, plan_mesh
from padforge.fabricate.mould.cad.bodies import body_solid
from padforge.fabricate.mould.cad.facets import faceted_solid
from padforge.fabricate.mould.cad.model import FITS_MM, mould_model
from padforge.fabricate.mould.cad.step_file import write_step
from padforge.fabricate.mould.plan import Plan, box_around
from padforge.fabricate.settings import DEFAULTS, MouldSettings

GRID, KNOTS = 4, (1, 5, 20)
TOLERANCES_MM = (0.05, 0.01, 0.002)
FUSED_UP_TO = 5
"""Beyond so many knots a fibre, Boolean operations of the CAD kernel take minutes."""
SEED = 0
_EXACT_MM = 1e-5
"""What exact curves are flattened to for comparison."""
_CLEAR_MM = 1.0
"""Near the walls outlines belong to exits."""
_PLACES = 33
"""In so many places of every curve of a CAD solid it is looked how far it strays."""


def trials() -> Iterator[BenchTrial]:
    """Every way at every tolerance for random pads of N in KNOTS, from the fibres to the solid.

    The error is the greatest deviation, mm, and the size the tolerance, micrometres: true curves have one of their own.
    "faces" are triangles of the mesh or faces of the CAD solid, "file_bytes" the size of its STL or of its STEP.
    """
    for knots in KNOTS:
        pad = Morphology.random(GRID, knots, SEED)
        for tolerance in TOLERANCES_MM:
            for way, (work, judge) in (DIRECT if knots > FUSED_UP_TO else DIRECT | FUSED).items():
                plan = partial(_plan, pad, tolerance)
                yield BenchTrial(f"N={knots}", way, 1000 * tolerance, partial(work, plan), partial(judge, plan))
        plan = partial(_plan, pad)
        yield BenchTrial(f"N={knots}", "curved CAD", 1000 * FITS_MM[0], partial(_curved, plan), partial(_cad_row, plan))


def _plan(pad: Morphology, tolerance_mm: float = DEFAULTS.mould.tolerance_mm) -> Plan:
    return Plan(pad, replace(DEFAULTS, mould=MouldSettings(tolerance_mm=tolerance_mm, number_mm=0)))


def _curved(new_plan: Callable[[], Plan]) -> Any:
    return mould_model(new_plan(), "mould").shape


def _mesh_row(new_plan: Callable[[], Plan], solid: Any) -> Mapping[str, float]:
    plan = new_plan()
    outline = solid.slice(plan.settings.mould.floor_mm + plan.heights_mm[0] / 2).to_polygons()
    points = np.vstack([_with_middles(np.asarray(ring)) for ring in outline])
    faces = solid.num_tri()
    return {"error": _deviation(plan, points), "faces": faces, "file_bytes": 84 + 50 * faces}


def _cad_row(new_plan: Callable[[], Plan], solid: Any) -> Mapping[str, float]:
    plan = new_plan()
    points = np.vstack(list(_level_curves(solid, plan.settings.mould.floor_mm)))
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
FUSED: dict[str, Way] = {"fused CAD": (lambda new_plan: body_solid(mould_body(new_plan())), _cad_row)}


def _level_curves(solid: Any, z: float) -> Iterator[NDArray[np.float64]]:
    """Points (n, 2) along every edge of a solid that lies at a height: of straight ones the ends and the middle."""
    for edge in solid.edges():
        points = _along(edge, 3)
        if np.abs(points[:, 2] - z).max() < 1e-6:
            yield (points if edge.geom_type == GeomType.LINE else _along(edge, _PLACES))[:, :2]


def _along(edge: Edge, count: int) -> NDArray[np.float64]:
    """Points (count, 3) along an edge, its ends among them."""
    places = np.linspace(0, 1, count).tolist()
    return np.array([tuple(edge.position_at(at, position_mode=PositionMode.PARAMETER)) for at in places])


def _with_middles(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """The vertices of a ring and the middles of its edges, where a chord is furthest from its arc."""
    return np.vstack([ring, (ring + np.roll(ring, -1, axis=0)) / 2])


def _deviation(plan: Plan, points: NDArray[np.float64]) -> float:
    """How far ridge outlines stray, at most, from where they belong: half a ridge's width from a level's fibres."""
    inside = shapely.points(points[shapely.contains_xy(box_around(plan.cavity, -_CLEAR_MM), points)])
    curves = [plan.pad.to_mm(line) for line in flatten(plan.pad, _EXACT_MM / plan.pad.unit_mm)]
    off = []
    for level in range(len(plan.heights_mm)):
        own = [curve for curve, at in zip(curves, plan.levels, strict=True) if at == level]
        edges = np.concatenate([np.stack([curve[:-1], curve[1:]], axis=1) for curve in own])
        tree = shapely.STRtree(np.asarray(shapely.linestrings(edges)))
        _, distance = tree.query_nearest(inside, return_distance=True, all_matches=False)
        off.append(np.abs(distance - plan.settings.mould.ridge_width_mm / 2))
    return float(np.min(off, axis=0).max())


BENCH = Bench(
    "mould",
    trials,
    "deviation from the exact tracks (mm)",
    ("fused CAD", 10),
    ("manifold3d", 10),
    plain=("fused CAD", "direct CAD"),
)
