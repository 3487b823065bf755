import re
from pathlib import Path

import numpy as np
import pytest

from design.pad.morphology import Morphology
from fabricate.dispensing.files import dispensing
from fabricate.mould.plan import Plan
from fabricate.report.laying import guide
from tests.fabricate.dispensing.machines import Run, apart, exact_course, run_gcode, run_urscript
from tests.fabricate.planted import level_pad, with_settings

ARM = with_settings(mould={"exit_mm": 0.0, "border_mm": 1.5, "lead_mm": 10.0}, pad={"deep_family": "vertical"})

PLANS = {
    "straight": lambda: Plan(Morphology.straight(2)),
    "random": lambda: Plan(Morphology.random(3, 5, seed=2)),
    "other settings": lambda: Plan(Morphology.random(2, 3, seed=5, pitch_mm=8.0), ARM),
    "shrunk": lambda: Plan(Morphology.straight(1), with_settings(silicone={"shrinkage": 0.03})),
    "many levels": lambda: Plan(level_pad(1.8, 1.2)),
}


def require_laid(plan: Plan, run: Run, limit_mm: float, shift: tuple[float, float]) -> None:
    """Every fibre is laid once, in the order of the laying page, at its depth, along its course, lead to lead."""
    bench = guide.document(plan, 1.0)
    laid = run.laid()
    assert [fibre + 1 for fibre, _ in laid] == [number for step in bench["laying_order"] for number in step]
    for fibre, way in laid:
        page = bench["fibres"][fibre]
        z = plan.settings.fibre.material.diameter_mm - page["depth_mm"]
        assert way.corners[:, 2] == pytest.approx(z, abs=1e-6)
        assert apart(way.corners[:, :2] - shift, exact_course(plan, fibre), 10_000 // len(laid)) < limit_mm


def require_travels_above(plan: Plan, run: Run) -> None:
    """With an empty needle it goes sideways only at the height of travel."""
    fibres = {fibre for fibre, _ in run.laid()}
    assert len(fibres) == 2 * plan.pad.grid
    for message, way in zip(run.asked, run.ways, strict=True):
        if "fasten" not in message:
            for start, end in zip(way.corners, way.corners[1:], strict=False):
                sideways = abs(start[:2] - end[:2]).max() > 1e-9
                assert not sideways or start[2] == end[2] == plan.settings.dispenser.travel_height_mm


@pytest.mark.parametrize("name", PLANS)
def test_gcode_lays_every_fibre_along_its_course(name):
    plan = PLANS[name]()
    run = run_gcode(dispensing(plan, ["gcode"]).texts["laying.gcode"])
    require_laid(plan, run, 0.006, plan.settings.dispenser.origin_mm)
    require_travels_above(plan, run)


@pytest.mark.parametrize("name", PLANS)
def test_urscript_lays_every_fibre_along_its_course(name):
    plan = PLANS[name]()
    run = run_urscript(dispensing(plan, ["urscript"]).texts["laying.script"])
    require_laid(plan, run, 0.011, (0, 0))
    require_travels_above(plan, run)


@pytest.mark.parametrize("name", ["1para", "5para_dis", "20para"])
def test_published_pads_are_laid(published: Path, name: str):
    plan = Plan(Morphology.load(published / f"{name}.mat"))
    texts = dispensing(plan, ["gcode", "urscript"]).texts
    require_laid(plan, run_gcode(texts["laying.gcode"]), 0.006, plan.settings.dispenser.origin_mm)
    require_laid(plan, run_urscript(texts["laying.script"]), 0.011, (0, 0))


def test_the_person_is_asked_in_the_order_of_the_work():
    plan = Plan(level_pad(1.8, 1.2))  # three layers
    texts = dispensing(plan, ["gcode", "urscript"]).texts
    asked = run_gcode(texts["laying.gcode"]).asked
    assert asked[1:] == run_urscript(texts["laying.script"]).asked[2:]  # one more: the place of the pad is unknown
    words = [re.sub(r".*?(fasten|cut|seal|zero).*", r"\1", message) for message in asked]
    fibre = ["fasten", "cut"]
    layers = [len(step) for step in guide.document(plan, 1.0)["laying_order"]]
    assert words == ["zero", *(word for count in layers for word in (*(fibre * count), "seal"))]
    assert asked[-1].startswith(f"layer {len(layers)} of {len(layers)}, 0.4 mm deep: seal")


def test_nothing_that_a_firmware_would_misread():
    texts = dispensing(Plan(Morphology.straight(4)), ["gcode", "urscript"]).texts
    assert all(text.isascii() for text in texts.values())
    waits = [line for line in texts["laying.gcode"].splitlines() if line.startswith("M0")]
    assert len(waits) == 1 + 2 * 8 + 2
    for line in waits:
        assert re.fullmatch(r"M0 \([^();]+\)", line)
        assert not re.search(r"[sSpP]\s*\d", line)
    assert max(len(line) for line in texts["laying.gcode"].splitlines() if line[0] in "GM") < 80


def test_what_is_asked_for_is_made_and_the_same_again():
    plan = Plan(Morphology.random(1, 2, seed=1))
    assert dispensing(plan, ["stl", "png"]).texts == {}
    assert not dispensing(plan, ["stl", "png"]).findings
    both = dispensing(plan, ["urscript", "gcode"])
    assert list(both.texts) == ["laying.gcode", "laying.script", "dispensing.svg"]
    assert list(dispensing(plan, ["urscript"]).texts) == ["laying.script", "dispensing.svg"]
    assert dispensing(Plan(Morphology.random(1, 2, seed=1)), ["gcode", "urscript"]).texts == both.texts
    assert {finding.name for finding in both.findings} == {"dispenser_box", "dispenser_tip"}


def test_the_fibre_of_the_settings_sets_depth_and_pace():
    pad = Morphology.random(1, 3, seed=2)

    def seconds(**fibre: object) -> float:
        run = run_gcode(dispensing(Plan(pad, with_settings(fibre=fibre)), ["gcode"]).texts["laying.gcode"])
        ways = [way for _, way in run.laid()]
        assert ways[0].corners[:, 2] == pytest.approx(float(str(fibre.get("diameter_mm", 0.3))) - 1.2)
        return sum((np.linalg.norm(np.diff(way.corners, axis=0), axis=1) / way.speeds).sum() for way in ways)

    assert seconds(largest_stretch=0.05) > 1.2 * seconds(largest_stretch=2.0)
    assert seconds(diameter_mm=0.2) < seconds(diameter_mm=0.39)
