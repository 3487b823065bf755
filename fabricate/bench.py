"""How near the mould's surface comes to the exact tracks, against the time and the size of the file it takes."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from design.bench_table import Row, write_bench
from design.curves import flatten
from design.morphology import Morphology

from .mould import mould_body
from .outlines import Plan
from .settings import DEFAULTS, Mould

KNOTS = (1, 5, 20)
TOLERANCES_MM = (0.05, 0.02, 0.01, 0.002)
FUSED_UP_TO = 5
"""Beyond so many knots a fibre, Boolean operations of the CAD kernel take minutes."""

SEED = 0
_EXACT_MM = 1e-5
"""What exact curves are flattened to for comparison."""

_QUICK_S = 1.0

_CLEAR_MM = 1.0
"""Near the walls outlines belong to exits."""


@dataclass(frozen=True)
class MouldRow(Row):
    """One mould; `error` is the greatest deviation, mm, and `size` the tolerance, micrometres.

    Attributes:
        faces: triangles of the mesh, or faces of the CAD solid.
        file_bytes: size of its STL, or of its STEP.
    """

    faces: int
    file_bytes: int


def bench_mould(out: Path, report: Callable[[str], None]) -> dict[str, Any]:
    """Every way at every tolerance for random pads of N in KNOTS; files in `out`.

    Times are from the fibres to the solid; imports and caches are warm wherever they could be told from it.
    """
    rows = []
    for knots in KNOTS:
        pad = Morphology.random(4, knots, SEED)
        for tolerance in TOLERANCES_MM:
            mould = Mould(tolerance_mm=tolerance, number_mm=0)
            settings = replace(DEFAULTS, mould=mould)
            for way, measure in _ways(knots).items():
                report(f"mould, N = {knots}, {way} at {1000 * tolerance:g} um")
                rows.append(measure(f"N={knots}", 1000 * tolerance, lambda s=settings, p=pad: Plan(p, s)))
    return write_bench("mould", rows, out, "deviation from the exact tracks (mm)", reference=("manifold3d", 10))


Measure = Callable[[str, float, Callable[[], Plan]], MouldRow]


def _ways(knots: int) -> dict[str, Measure]:
    ways: dict[str, Measure] = {"manifold3d": _meshed, "direct CAD": _direct}
    return ways | {"fused CAD": _fused} if knots <= FUSED_UP_TO else ways


def _meshed(case: str, size: float, new_plan: Callable[[], Plan]) -> MouldRow:
    from .mould import plan_mesh

    solid, seconds = _timed(lambda: plan_mesh(new_plan()))
    plan = new_plan()
    outline = solid.slice(plan.settings.mould.floor_mm + plan.heights_mm[0] / 2).to_polygons()
    points = np.vstack([_with_middles(np.asarray(ring)) for ring in outline])
    faces = solid.num_tri()
    return MouldRow(case, "manifold3d", size, _deviation(plan, points), seconds, None, faces, 84 + 50 * faces)


def _direct(case: str, size: float, new_plan: Callable[[], Plan]) -> MouldRow:
    from .facets import faceted_solid
    from .mould import plan_mesh

    solid, seconds = _timed(lambda: faceted_solid(plan_mesh(new_plan())))
    return _cad_row(case, "direct CAD", size, new_plan(), solid, seconds)


def _fused(case: str, size: float, new_plan: Callable[[], Plan]) -> MouldRow:
    from .fused import fused_solid

    solid, seconds = _timed(lambda: fused_solid(mould_body(new_plan())))
    return _cad_row(case, "fused CAD", size, new_plan(), solid, seconds)


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What `work` returns and how long it took; a quick one is done again, so that caches are warm."""
    start = time.perf_counter()
    result = work()
    seconds = time.perf_counter() - start
    if seconds < _QUICK_S:
        start = time.perf_counter()
        work()
        seconds = time.perf_counter() - start
    return result, seconds


def _cad_row(case: str, way: str, size: float, plan: Plan, solid: Any, seconds: float) -> MouldRow:
    from .writers import write_step

    floor = plan.settings.mould.floor_mm
    points = np.vstack([_with_middles(ends, closed=False) for ends in _level_edges(solid, floor)])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mould.step"
        write_step(path, solid)
        written = path.stat().st_size
    return MouldRow(case, way, size, _deviation(plan, points), seconds, None, len(solid.faces()), written)


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
    curves = np.asarray(shapely.linestrings(np.concatenate([_segments(line) for line in lines])))
    inside = np.abs(points).max(axis=1) < plan.cavity.bounds[2] - _CLEAR_MM
    _, distance = shapely.STRtree(curves).query_nearest(
        shapely.points(points[inside]), return_distance=True, all_matches=False
    )
    return float(np.abs(distance - width / 2).max())


def _segments(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n - 1, 2, 2) ends of the segments of a polyline (n, 2)."""
    return np.stack([line[:-1], line[1:]], axis=1)
