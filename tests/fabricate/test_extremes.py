import json
from collections.abc import Mapping

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate import Plan, check
from padforge.fabricate.checks.mesh_checks import check_solid
from padforge.fabricate.checks.surface import TriangleMesh
from padforge.fabricate.mesh import build_mesh, mesh_arrays
from padforge.fabricate.mould import mould_body
from tests.design.wild_pads import KINDS, wild_knots
from tests.fabricate.planted import with_settings
from tests.helpers.refusals import require_one_line

ENDS = """\
floor_mm 0.4 50, wall_mm 0.8 50, wall_draft_deg 0 30, silicone_mm 1e-3 100, border_mm 1e-9 100, ridge_width_mm 0.1 3, \
ridge_draft_deg 1e-9 20, deep_ridge_height_mm 1e-9 5.99, shallow_ridge_height_mm 1e-300 1.1999999999, \
exit_mm 0 1e-9 50, exit_width_mm 0.4000001 11, number_mm 0 1e-9 20, lead_mm 0 1000, tolerance_mm 1e-3 0.0999"""


def wild(kind: str) -> Morphology:
    return Morphology(wild_knots(kind, 2, 4, np.random.default_rng(3)))


def require_closed(pad: Morphology, mould: Mapping[str, object]) -> None:
    try:
        plan = Plan(pad, with_settings(dict(mould)))
        vertices, triangles = mesh_arrays(build_mesh(mould_body(plan)))
    except InputError as error:
        require_one_line(error)
        return
    findings = check_solid(TriangleMesh.weld(vertices, triangles))
    assert not [finding.message for finding in findings if finding.status == "fail"]
    size = np.ptp(vertices.astype(float), axis=0)
    assert min(size[:2]) > pad.layout.size_mm[0] + 2 * plan.settings.mould.border_mm
    assert size[2] > plan.settings.mould.floor_mm


@pytest.mark.parametrize("kind", KINDS)
def test_mould_of_wild_pads_is_closed(kind):
    require_closed(wild(kind), {"border_mm": 1.0})


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_check_of_wild_pads_is_finite_or_refused(kind):
    try:
        findings = check(wild(kind))
    except InputError as error:
        require_one_line(error)
    else:
        json.dumps([finding.to_dict() for finding in findings], allow_nan=False)


@pytest.mark.parametrize("ends", ENDS.split(", "))
def test_mould_of_extreme_settings_is_closed_or_refused(ends):
    key, *values = ends.split()
    for value in map(float, values):
        require_closed(Morphology.random(1, 1, seed=1), {key: value})
