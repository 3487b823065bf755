"""Every check on the mould of a pad: those of its mesh, of its tracks, and of what else is asked of the pad.

Nothing here changes a mould or stops its making: a pass, warn or fail with what was measured is all there is. The
checks here need the plan; those that a mesh of any origin goes through are in `mesh_checks`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from padforge.design.morphology import Morphology
from padforge.fabricate.checks.findings import Finding
from padforge.fabricate.checks.mesh_checks import inspect_mesh
from padforge.fabricate.mesh_files import read_mesh
from padforge.fabricate.mould.assembly import plan_mesh
from padforge.fabricate.mould.plan import Plan
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

from .fibre_strain import fibre_strain
from .pillars import pillars
from .tracks import check_tracks

Inspected = tuple[NDArray[np.floating], NDArray[np.integer], list[Finding]]
"""Vertices (n, 3) mm, triangles (m, 3) vertex numbers, and what the checks found."""


def check(pad: Morphology, settings: FabricationSettings = DEFAULTS) -> list[Finding]:
    """Every check on the mould of a pad.

    Raises:
        InputError: settings that contradict each other.
    """
    return meshed(Plan(pad, settings))[-1]


def inspect_file(source: Path, settings: FabricationSettings = DEFAULTS) -> Inspected:
    """The mesh in a .stl or .3mf, or of the mould of the morphology in any other file, and every check on it.

    Raises:
        InputError: the file cannot be read, or settings contradict each other.
    """
    if source.suffix.lower() not in (".stl", ".3mf"):
        return meshed(Plan(Morphology.load(source), settings))
    vertices, triangles = read_mesh(source)
    return vertices, triangles, inspect_mesh(vertices, triangles, settings.printer, settings.mould.min_silicone_mm)


def meshed(plan: Plan) -> Inspected:
    """The mesh of a plan, and every check on both."""
    from padforge.fabricate.mould.mesh import arrays

    vertices, triangles = arrays(plan_mesh(plan.enlarged))
    return vertices, triangles, inspect(plan, vertices, triangles)


def inspect(plan: Plan, vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> list[Finding]:
    """Every check on a plan and its mesh: vertices (n, 3) mm, triangles (m, 3) vertex numbers."""
    of_mesh = inspect_mesh(vertices, triangles, plan.settings.printer, genus=0, unplanned=False)
    return [*of_mesh, *check_plan(plan)]


def check_plan(plan: Plan) -> list[Finding]:
    """The checks that need no mesh; of keep-outs and of bending only where there are any."""
    return [*check_tracks(plan), *pillars(plan), *fibre_strain(plan)]
