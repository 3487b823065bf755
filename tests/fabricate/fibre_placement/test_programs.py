"""G-code that places fibres, run by a machine that knows its words only, and the drawing of the toolpath."""

import re

import numpy as np
import pytest

from padforge.design.morphology import Morphology
from padforge.fabricate.export import Fabrication
from padforge.fabricate.fibre_placement import gcode
from padforge.fabricate.outputs.laying_page import laying_document
from padforge.fabricate.plan import Plan
from tests.fabricate.fibre_placement.machines import Run, exact_path, max_distance, run_gcode
from tests.fabricate.planted import level_pad, with_settings

OTHER = with_settings(mould={"exit_mm": 0.0, "border_mm": 1.5, "lead_mm": 10.0}, pad={"deep_family": "vertical"})
PLANS = {
    "other settings": lambda: Plan(Morphology.random(2, 3, seed=5, pitch_mm=8.0), OTHER),
    "shrunk": lambda: Plan(Morphology.straight(1), with_settings(silicone={"shrinkage": 0.03})),
    "many levels": lambda: Plan(level_pad(1.8, 1.2)),
}


def program(plan: Plan) -> str:
    return gcode(plan, Fabrication(plan, [], []).toolpath)


def require_placed(plan: Plan, run: Run) -> None:
    """Every fibre is placed once, in the order of the laying page, at its depth, along its path, lead to lead."""
    bench = laying_document(plan, 1.0)
    placed = run.placed_fibres()
    assert [fibre + 1 for fibre, _ in placed] == [number for step in bench["laying_order"] for number in step]
    for fibre, way in placed:
        z = plan.settings.fibre.material.diameter_mm - bench["fibres"][fibre]["depth_mm"]
        assert way.corners[:, 2] == pytest.approx(z, abs=1e-6)
        positions = way.corners[:, :2] - plan.settings.dispenser.origin_mm
        assert max_distance(positions, exact_path(plan, fibre), 10_000 // len(placed)) < 0.006


def require_travels_above(plan: Plan, run: Run) -> None:
    """With an empty needle it goes sideways only at the height of travel."""
    for message, way in zip(run.asked, run.ways, strict=True):
        if "fasten" not in message:
            for start, end in zip(way.corners, way.corners[1:], strict=False):
                sideways = abs(start[:2] - end[:2]).max() > 1e-9
                assert not sideways or start[2] == end[2] == plan.settings.dispenser.travel_height_mm


@pytest.mark.parametrize("name", [*PLANS, pytest.param("5para_dis", marks=pytest.mark.slow)])
def test_gcode_places_every_fibre_along_its_path(request, name):
    if name in PLANS:
        plan = PLANS[name]()
    else:
        plan = Plan(Morphology.load(request.getfixturevalue("published") / f"{name}.mat"))
    run = run_gcode(program(plan))
    require_placed(plan, run)
    require_travels_above(plan, run)


def test_gcode_has_nothing_that_a_firmware_misreads():
    text = program(Plan(Morphology.straight(2)))
    lines = text.splitlines()
    assert text.isascii()
    waits = [line for line in lines if line.startswith("M0")]
    assert len(waits) == 1 + 2 * 4 + 2
    for line in waits:
        assert re.fullmatch(r"M0 \([^();]+\)", line)
        assert not re.search(r"[sSpP]\s*\d", line)
    assert max(len(line) for line in lines if line[0] in "GM") < 80


@pytest.mark.parametrize(
    ("fibres", "start"), [((2, 0), "on the right, nearest"), ((0, 2), "on the right, at the near side")]
)
def test_gcode_of_one_family_says_where_fibre_1_starts(fibres, start):
    text = program(Plan(Morphology.straight(fibres)))
    assert f"; fibre 1 starts {start}\n" in text
    ends = np.vstack([way.corners[[0, -1], :2] for _, way in run_gcode(text).placed_fibres()])
    assert ends[0] == pytest.approx((ends[:, 0].max(), ends[:, 1].min()))


def test_fibre_settings_set_depth_and_speed():
    pad = Morphology.random(1, 3, seed=2)

    def seconds(**fibre: object) -> float:
        ways = [way for _, way in run_gcode(program(Plan(pad, with_settings(fibre=fibre)))).placed_fibres()]
        assert ways[0].corners[:, 2] == pytest.approx(float(str(fibre.get("diameter_mm", 0.3))) - 1.2)
        return sum((np.linalg.norm(np.diff(way.corners, axis=0), axis=1) / way.speeds).sum() for way in ways)

    assert seconds(max_strain=0.05) > 1.2 * seconds(max_strain=2.0)
    assert seconds(diameter_mm=0.2) < seconds(diameter_mm=0.39)
