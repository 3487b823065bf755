"""What every check says: of a sound pad, and of one with the fault that it is for, in whole sentences."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from manifold3d import Manifold

from padforge.common.settings import Spec
from padforge.design.morphology import Morphology
from padforge.design.settings import Contact
from padforge.fabricate.checks import Finding
from padforge.fabricate.checks.plan_checks import check_plan
from padforge.fabricate.fibre_placement import check_toolpath, plan_toolpath
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import FabricationSettings
from tests.fabricate.checks.trays import CROSS, block, check_body, line, prism, ridge, together, tray
from tests.fabricate.planted import level_pad, with_settings

STRAIGHT = Morphology.straight(2)


def make_curved_pad(*knots: tuple[float, float], pitch_mm: float = 10.0) -> Morphology:
    """A pad of 1 x 1 whose vertical fibre runs through knots (grid units); its horizontal one is straight."""
    level = np.stack([np.linspace(0, 2, len(knots)), np.ones(len(knots))], axis=1)
    return Morphology(np.stack([level, np.array(knots, float)]), pitch_mm)


def square(half: float, x: float = 0.0, y: float = 0.0) -> list[list[float]]:
    return [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]


def designed_for(**contact: object) -> FabricationSettings:
    return FabricationSettings.from_spec(Spec({"contact": contact, "mould": {"silicone_mm": 6.0}}))


PLANS: dict[str, Callable[[], Plan]] = {
    "straight": lambda: Plan(STRAIGHT),
    "layers of 0.16 mm": lambda: Plan(STRAIGHT, with_settings(printer={"layer_mm": 0.16})),
    "resin, two pixels wider than a ridge": lambda: Plan(
        STRAIGHT, with_settings(printer={"resin": True, "nozzle_mm": 0.21})
    ),
    "a thick fibre": lambda: Plan(STRAIGHT, with_settings(fibre={"diameter_mm": 0.41})),
    "tall ridges": lambda: Plan(STRAIGHT, with_settings({"deep_ridge_height_mm": 4.1, "silicone_mm": 5.0})),
    "large numbers": lambda: Plan(Morphology.straight((5, 1), 4.0), with_settings({"number_mm": 9.0, "exit_mm": 0.0})),
    "a family that crosses itself": lambda: Plan(level_pad(1.8, 1.2), with_settings({"silicone_mm": 2.5})),
    "two depths alone": lambda: Plan(level_pad(1.8, 1.2), with_settings({"levels": "two"})),
    "tracks near each other": lambda: Plan(level_pad(1.481, 1.52)),
    "tracks near the wall": lambda: Plan(level_pad(0.058, 2.0)),
    "a shallow crossing": lambda: Plan(make_curved_pad((1, 0), (0.5, 0.8), (1.5, 1.2), (1, 2), pitch_mm=20.0)),
    "a fold": lambda: Plan(
        make_curved_pad((1, 0), (1, 0.8), (1.2, 1), (1, 1.2), (1, 2)),
        with_settings({"ridge_width_mm": 0.9, "exit_width_mm": 2.0}),
    ),
    "holes": lambda: Plan(
        STRAIGHT,
        with_settings(pad={"keep_out_mm": [square(0.15), square(2.0, 5.625, 5.625), [0.0, -9.0, 3.0, 9.0]]}),
    ),
    "a cut": lambda: Plan(
        STRAIGHT, with_settings(pad={"keep_out_mm": [[[-1.0, -20.0], [1.0, -20.0], [1.0, 20.0], [-1.0, 20.0]]]})
    ),
    "bent": lambda: Plan(STRAIGHT, with_settings(pad={"bent_radius_mm": 20.0}, fibre={"max_strain": 0.05})),
}


def finding_lines(findings: Iterable[Finding], passed: bool) -> list[str]:
    """A line for each finding; those that pass only if they are asked for."""
    lines = []
    for finding in findings:
        if passed or finding.status != "pass":
            values = f"{finding.measured} / {finding.limit}"
            places = "".join(f" ({x:.1f}, {y:.1f})" for x, y in finding.positions_mm[:4])
            lines.append(f"  {finding.status} {finding.name} {values}: {finding.message};{places}")
    return lines


def test_sentences_of_checks_of_plans(golden):
    lines = []
    for title, make_plan in PLANS.items():
        lines += [title, *finding_lines(check_plan(make_plan()), passed=title == "straight")]
    contact = {"settings": {"contact": Contact(fibre_depths_mm=(1.45, 0.25), thickness_mm=8.0).model_dump(mode="json")}}
    believed = Morphology.from_layout(STRAIGHT.knots, STRAIGHT.layout, contact)
    lines += ["designed for another layer", *finding_lines(check_plan(Plan(believed)), passed=False)]
    machine = Plan(STRAIGHT, with_settings(dispenser={"tip_mm": 0.5, "origin_mm": [20.0, 110.0]}))
    lines += ["placed by a machine", *finding_lines(check_toolpath(machine, plan_toolpath(machine, 0.3)), passed=True)]
    golden("fabricate/findings_of_plans.txt", "\n".join(lines))


def make_meshes() -> dict[str, Any]:
    box = block(10, 20, 5)
    faces = np.array(box.faces)
    thin = Manifold.cube((5, 40, 20), True).translate((12.8, 0, 5))
    head = prism(line((2, -6), (7, -6), width=1.5), 2.8, 3.2)
    return {
        "tray": tray(*CROSS),
        "open box": type(box)(box.vertices, faces[1:]),
        "two boxes": type(box)(*together(box, block(2, 2, 2, at=(30, 7, 0)))),
        "a box in a box": type(box)(*together(box, block(2, 2, 2))),
        "large": block(300, 20, 5),
        "small": block(0.3, 0.2, 0.05),
        "on its side": tray(*CROSS).rotate((90, 0, 0)),
        "thin wall, head, leak": tray(*CROSS, ridge(line((2, -6), (7, -6)), 1.2), head, draft_deg=0)
        - thin
        - prism(line((9, 2), (14, 2), width=1.0), 2.0, 9.0),
        "narrow": tray(*CROSS, ridge(line((2, -6), (7, -5), width=0.3)), ridge(line((-9, -6), (9, -6))), floor=0.3),
        "leaning inwards": tray(*CROSS, draft_deg=-3),
    }


def test_sentences_of_checks_of_meshes(golden):
    lines = []
    for title, mesh in make_meshes().items():
        lines += [title, *finding_lines(check_body(mesh, genus=0).values(), passed=title == "tray")]
    golden("fabricate/findings_of_meshes.txt", "\n".join(lines))
