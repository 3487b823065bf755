"""Deviation of the mould's surface from the exact tracks against run time and file size."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import shapely
from build123d import GeomType, PositionMode
from numpy.typing import NDArray

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import flatten
from padforge.fabricate.cad.model import FIT_TOLERANCES_MM, assemble, body_solid, mould_parts
from padforge.fabricate.cad.step_file import write_step
from padforge.fabricate.mesh import mould_mesh
from padforge.fabricate.mould import INTO_FLOOR_MM, mould_body
from padforge.fabricate.plan import Plan, offset_box
from padforge.fabricate.settings import DEFAULTS, MouldSettings

GRID, KNOTS = 4, (1, 5, 20)
TOLERANCES_MM = (0.05, 0.01, 0.002)
MAX_FUSED_KNOTS = 5  # beyond as many knots per fibre, Boolean operations of the CAD kernel take minutes
SEED = 0
EXACT_MM = 1e-5  # flattening tolerance of the exact curves, mm
MARGIN_MM = 1.0  # distance from the walls within which outlines belong to exits and are not compared, mm
POINTS = 33  # points along every curve of a CAD solid at which its deviation is measured


def trials() -> Iterator[BenchTrial]:
    """Yield all ways at all tolerances, from the fibres of random pads to the solid.

    The error is the largest deviation in mm, the size the tolerance in micrometres. "faces" are triangles of the mesh
    or faces of the CAD solid, "file_bytes" the size of its STL or STEP.
    """
    for knots in KNOTS:
        pad, case = Morphology.random(GRID, knots, SEED), f"N={knots}"
        for tolerance_mm in TOLERANCES_MM:
            plan = partial(_plan, pad, tolerance_mm)
            for way, (work, evaluate) in WAYS.items():
                if way != "fused CAD" or knots <= MAX_FUSED_KNOTS:
                    yield BenchTrial(case, way, 1000 * tolerance_mm, partial(work, plan), partial(evaluate, plan))
        plan = partial(_plan, pad)
        work = partial(_build_curved, plan)
        yield BenchTrial(case, "curved CAD", 1000 * FIT_TOLERANCES_MM[0], work, partial(_evaluate_solid, plan))


def _plan(pad: Morphology, tolerance_mm: float = DEFAULTS.mould.tolerance_mm) -> Plan:
    return Plan(pad, replace(DEFAULTS, mould=MouldSettings(tolerance_mm=tolerance_mm, number_mm=0)))


def _build_curved(new_plan: Callable[[], Plan]) -> Any:
    plan = new_plan()
    return assemble({"mould": mould_parts(plan, "mould")}, plan)


def _evaluate_mesh(new_plan: Callable[[], Plan], mesh: Any) -> Mapping[str, float]:
    plan = new_plan()
    rings = mesh.slice(plan.settings.mould.floor_mm + plan.heights_mm[0] / 2).to_polygons()
    # vertices and middles of edges, where a chord is farthest from its arc
    points = np.vstack([np.vstack([ring, (ring + np.roll(ring, -1, axis=0)) / 2]) for ring in map(np.asarray, rings)])
    faces = mesh.num_tri()
    return {"error": _max_deviation_mm(plan, points), "faces": faces, "file_bytes": 84 + 50 * faces}


def _evaluate_solid(new_plan: Callable[[], Plan], solid: Any) -> Mapping[str, float]:
    plan = new_plan()
    floor_mm = plan.settings.mould.floor_mm  # ridges of one solid end there, those of their own begin below it
    points = np.vstack([*_horizontal_edges(solid, floor_mm), *_horizontal_edges(solid, floor_mm - INTO_FLOOR_MM)])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mould.step"
        write_step(path, solid)
        size = path.stat().st_size
    return {"error": _max_deviation_mm(plan, points), "faces": len(solid.faces()), "file_bytes": size}


WAYS: dict[str, tuple[Callable[..., Any], Callable[..., Mapping[str, float]]]] = {
    "manifold3d": (lambda new_plan: mould_mesh(new_plan()), _evaluate_mesh),
    "fused CAD": (lambda new_plan: body_solid(mould_body(new_plan())), _evaluate_solid),
}


def _horizontal_edges(solid: Any, z: float) -> Iterator[NDArray[np.float64]]:
    """Yield points along every edge of a solid at a height; shape (n, 2), mm."""
    for edge in solid.edges():

        def sample(count: int, edge: Any = edge) -> NDArray[np.float64]:
            positions = np.linspace(0, 1, count).tolist()
            return np.array([tuple(edge.position_at(at, position_mode=PositionMode.PARAMETER)) for at in positions])

        points = sample(3)
        if np.abs(points[:, 2] - z).max() < 1e-6:
            yield (points if edge.geom_type == GeomType.LINE else sample(POINTS))[:, :2]


def _max_deviation_mm(plan: Plan, points: NDArray[np.float64]) -> float:
    """Return the largest deviation of ridge outlines from half a ridge's width beside the fibres of a layer, mm."""
    inside = shapely.points(points[shapely.contains_xy(offset_box(plan.cavity, -MARGIN_MM), points)])
    curves = [plan.pad.to_mm(line) for line in flatten(plan.pad, EXACT_MM / plan.pad.unit_mm)]
    deviations = []
    for layer in range(len(plan.heights_mm)):
        fibres = [curve for curve, level in zip(curves, plan.layer_indices, strict=True) if level == layer]
        edges = np.concatenate([np.stack([curve[:-1], curve[1:]], axis=1) for curve in fibres])
        tree = shapely.STRtree(np.asarray(shapely.linestrings(edges)))
        _, distance = tree.query_nearest(inside, return_distance=True, all_matches=False)
        deviations.append(np.abs(distance - plan.settings.mould.ridge_width_mm / 2))
    return float(np.min(deviations, axis=0).max())


BENCH = Bench(
    "mould",
    trials,
    "deviation from the exact tracks (mm)",
    reference=("fused CAD", 10),
    default=("manifold3d", 10),
    baselines=("fused CAD",),
)
