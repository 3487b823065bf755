"""What the checks of plans find on pads with a known shape or a known fault, by the title of each, as whole lines."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from padforge.common.settings import Spec
from padforge.design import Contact, Morphology, RulesSettings
from padforge.fabricate import FabricationSettings, Plan
from padforge.fabricate.checks.plan_checks import check_plan, compute_bending_strains
from padforge.fabricate.fibre_placement import check_toolpath, plan_toolpath
from tests.design.objectives.pads import climbing, square
from tests.fabricate.checks.test_mesh_checks import finding_lines
from tests.fabricate.planted import level_pad, with_settings

STRAIGHT = Morphology.straight(2)


def one_fibre(along: ArrayLike, across: ArrayLike, family: int = 0, pitch_mm: float = 10.0) -> Morphology:
    """A pad of 1 x 1 whose fibre of a family runs through knots (grid units); the other one is straight."""
    knots = np.stack([along, across], axis=1)
    fibres = [knots, np.stack([np.linspace(0, 2, len(knots)), np.ones(len(knots))], axis=1)]
    horizontal, vertical = fibres if family == 0 else fibres[::-1]
    return Morphology(np.stack([horizontal, vertical[:, ::-1]]), pitch_mm)


def both(*knots: tuple[float, float], pitch_mm: float = 11.25) -> Morphology:
    """A pad of 1 x 1 whose fibres run through the same knots along their axes."""
    return Morphology(np.stack([knots, np.array(knots)[:, ::-1]]), pitch_mm)


def tight(*runs: float) -> Morphology:
    """A pad of 1 x 1 whose fibres climb by 0.05 within runs (grid units)."""
    horizontal, vertical = (np.array([[0, 1], [0.9, 1], [0.9 + run, 1.05], [1.5, 1.05], [2, 1]]) for run in runs)
    return Morphology(np.stack([horizontal, vertical[:, ::-1]]), 11.25)


def corner(family: int, rise: float) -> Morphology:
    """Straight to a corner at 0.8, where the slope climbs from `rise` to 4/3 of it and falls to 0 within 1e-6."""
    return one_fibre([0, 0.8 - 1e-6, 0.8, 1.2, 2], 1 + rise * np.array([0, 0.8 - 1e-6, 0.8, 0.8, 0]), family)


def bump(family: int, up: int) -> Morphology:
    """Level at 0.8, 1 and 1.2, where the curvature is 6 x 0.2 / 0.2^2 per grid unit: a radius of 0.333 mm."""
    return one_fibre([0, 0.8, 1, 1.2, 2], [1, 1, 1 + 0.2 * up, 1, 1], family)


def narrow_bump(ratio: float, **mould: object) -> dict[str, Any]:
    return {"mould": {"tolerance_mm": 1e-3, "exit_width_mm": 2.0, "ridge_width_mm": 2 / 3 * ratio} | mould}


def cut_mm(rise: float) -> float:
    return 0.2 * (1 - np.cos(np.arctan(4 / 3 * rise) / 2))


def beside(gap_mm: float) -> Morphology:
    return level_pad(1.5 - (gap_mm + 0.4) / 20, 1.5 + (gap_mm + 0.4) / 20)


def designed_for(**contact: Any) -> Morphology:
    origin = {"settings": {"contact": Contact(**contact).model_dump(mode="json")}}
    return Morphology.from_layout(STRAIGHT.knots, STRAIGHT.layout, origin)


SHALLOW = one_fibre([0, 0.8, 1.2, 2], [1, 0.5, 1.5, 1], 1, 20.0)
"""Half-way between two turning points a PCHIP is half as steep again: its fibres cross at 14.9 degrees."""
GENTLE = both((0, 1), (0.1, 1.01), (0.5, 1.1), (1.5, 0.9), (1.9, 0.99), (2, 1), pitch_mm=15.0)
"""Fibres whose bends are of some 13 mm."""
TURNING = one_fibre([0, 0.95, 0.98, 1.04, 1.07, 2], [1, 1, 1.8, 0.2, 1, 1], pitch_mm=11.25)
SHRINKING = {"silicone": {"shrinkage": 0.02}, "fibre": {"diameter_mm": 0.395}}
ONE_SIDE: dict[str, Any] = {"pad": {"leads": "one side"}}
CASES: dict[str, tuple[Morphology, dict[str, Any]]] = {
    "straight": (STRAIGHT, {}),
    "layers of 0.16 mm": (STRAIGHT, {"printer": {"layer_mm": 0.16}}),
    "layers of 0.3 mm": (STRAIGHT, {"printer": {"layer_mm": 0.3}}),
    "floor of 20.5 layers": (STRAIGHT, {"mould": {"floor_mm": 2.05}}),
    "lower ridges of 4.5 layers": (STRAIGHT, {"mould": {"shallow_ridge_height_mm": 0.45}}),
    "upper ridges of 12.5 layers": (STRAIGHT, {"mould": {"deep_ridge_height_mm": 1.25}}),
    "resin, two pixels as wide as a ridge": (STRAIGHT, {"printer": {"resin": True, "nozzle_mm": 0.2}}),
    "resin, two pixels wider than a ridge": (STRAIGHT, {"printer": {"resin": True, "nozzle_mm": 0.21}}),
    "fibre as thick as a track is wide": (STRAIGHT, {"fibre": {"diameter_mm": 0.4}}),
    "fibre thicker than a track is wide": (STRAIGHT, {"fibre": {"diameter_mm": 0.41}}),
    "tracks shrink to 0.98 of 0.4 mm, fibres do not": (STRAIGHT, SHRINKING),
    "gap of 0.39 mm at crossings": (STRAIGHT, {"mould": {"deep_ridge_height_mm": 1.09}}),
    "ridges 5.1 times as tall as wide": (STRAIGHT, {"mould": {"deep_ridge_height_mm": 2.04}}),
    "ridges 10.1 times as tall as wide": (STRAIGHT, {"mould": {"deep_ridge_height_mm": 4.04}}),
    "cover of 0.99 mm": (STRAIGHT, {"mould": {"silicone_mm": 2.19}}),
    "large numbers": (Morphology.straight((5, 1), 4.0), {"mould": {"number_mm": 9.0, "exit_mm": 0.0}}),
    "a family that crosses itself": (level_pad(1.8, 1.2), {"mould": {"silicone_mm": 2.5}}),
    "two depths alone": (level_pad(1.8, 1.2), {"mould": {"levels": "two"}}),
    "silicone of 0.42 mm between tracks": (beside(0.42), {}),
    "silicone of 0.38 mm between tracks": (beside(0.38), {}),
    "silicone of -0.01 mm between tracks": (level_pad(1.481, 1.52), {}),
    "a fibre that turns back": (TURNING, {}),
    "0.62 mm from the wall": (level_pad(0.062, 2.0), {}),
    "0.58 mm from the wall": (level_pad(0.058, 2.0), {}),
    "0.1 mm from the wall": (level_pad(0.01, 2.0), {}),
    "a shallow crossing": (SHALLOW, {}),
    "a shallow crossing of narrow tracks": (SHALLOW, {"mould": {"ridge_width_mm": 0.2}, "printer": {"nozzle_mm": 0.2}}),
    "a shallow crossing of any length": (SHALLOW, {"rules": {"max_common_track_mm": "any"}}),
    "bends of 13 mm, the fibre bears 20 mm": (GENTLE, {"fibre": {"min_bend_radius_mm": 20.0}}),
    "bends of 13 mm, 12 mm are allowed": (GENTLE, {"rules": {"min_mean_bend_radius_mm": 12.0}}),
    "half a radian at a lead": (climbing(0.5, 0, 0), ONE_SIDE),
    "0.54 radians at a lead": (climbing(0.6, 0, 0), {}),
    "bends of two radii": (tight(0.08, 0.03), {}),
    "bends of two radii, exchanged": (tight(0.03, 0.08), {}),
    "leads that bend by 3 mm": (STRAIGHT, ONE_SIDE | {"rules": {"min_mean_bend_radius_mm": 3.0}}),
    "bend of 1.02 half widths": (bump(0, 1), narrow_bump(0.98)),
    "bend of 0.8 half widths": (bump(0, 1), narrow_bump(1.25)),
    "bend of 0.8 half widths, of the vertical fibre downwards": (bump(1, -1), narrow_bump(1.25)),
    "bend of 1.02 half widths of a ridge with a wider foot": (bump(0, 1), narrow_bump(0.98, ridge_draft_deg=10.0)),
    "corner that is cut a little": (corner(0, -0.6), {"mould": {"tolerance_mm": 1.03 * cut_mm(-0.6)}}),
    "corner that is cut": (corner(0, -0.6), {"mould": {"tolerance_mm": 0.97 * cut_mm(-0.6)}}),
    "corner of the vertical fibre that is cut": (corner(1, 0.8), {"mould": {"tolerance_mm": 0.97 * cut_mm(0.8)}}),
    "holes": (STRAIGHT, {"pad": {"keep_out_mm": [square(0, 0, 0.3), square(5.625, 5.625, 4), [0, -9, 3, 9]]}}),
    "a cut": (STRAIGHT, {"pad": {"keep_out_mm": [[[-1, -20], [1, -20], [1, 20], [-1, 20]]]}}),
    "bent, the fibre bears all": (STRAIGHT, {"pad": {"bent_radius_mm": 20.0}, "fibre": {"max_strain": 1.0}}),
    "bent, the fibre bears 10 %": (STRAIGHT, {"pad": {"bent_radius_mm": 20.0}, "fibre": {"max_strain": 0.1}}),
    "bent, the fibre bears 5 %": (STRAIGHT, {"pad": {"bent_radius_mm": 20.0}, "fibre": {"max_strain": 0.05}}),
    "designed for this layer": (designed_for(), {}),
    "designed for this layer, pressed on the other face": (designed_for(fibre_depths_mm=(4.95, 5.75)), {}),
    "designed for this layer, which shrinks": (designed_for(), {"silicone": {"shrinkage": 0.01}}),
    "designed for a thinner layer": (designed_for(), {"mould": {"silicone_mm": 8.0}}),
    "designed for the other order of depths": (designed_for(), {"pad": {"deep_family": "vertical"}}),
    "designed for other depths": (designed_for(fibre_depths_mm=(1.45, 0.25), thickness_mm=8.0), {}),
}


EDGE_MM = 33.75 / 2 + 2 + 30
"""From the middle of the straight pad to the ends of its leads."""
DISPENSERS: dict[str, dict[str, Any]] = {
    "needle of 0.5 mm, origin too near": {"dispenser": {"tip_mm": 0.5, "origin_mm": [20.0, 110.0]}},
    "box without room": {"dispenser": {"origin_mm": [EDGE_MM, EDGE_MM]}},
    "box 2 mm too short": {"dispenser": {"box_mm": [0.0, 220.0, 0.0, 110 + EDGE_MM - 2, -5.0, 9.0]}},
    "box 0.4 mm too shallow": {"dispenser": {"box_mm": [0.0, 220.0, 0.0, 220.0, -0.5, 9.0]}},
    "travel 1 mm too high": {"dispenser": {"travel_height_mm": 10.0, "box_mm": [0.0, 220.0, 0.0, 220.0, -5.0, 9.0]}},
    "needle of 0.64 mm, tracks of 0.7 mm": {"dispenser": {"tip_mm": 0.64}, "mould": {"ridge_width_mm": 0.7}},
}


def test_findings_of_plans(golden):
    lines = []
    for title, (pad, settings) in CASES.items():
        findings = check_plan(Plan(pad, with_settings(**settings)))
        lines += [title, *finding_lines(findings, passed=title == "straight")]
    for title, settings in DISPENSERS.items():
        plan = Plan(STRAIGHT, with_settings(**settings))
        lines += [title, *finding_lines(check_toolpath(plan, plan_toolpath(plan, 0.3)), passed=True)]
    golden("fabricate/findings_of_plans.txt", "\n".join(lines))


def test_fibre_bend_includes_leads():
    """Planted: leads of another radius than the rules have."""
    one_side = with_settings(**ONE_SIDE, rules={"min_mean_bend_radius_mm": 3.0})
    plan = Plan(STRAIGHT, replace(one_side, rules=RulesSettings(min_mean_bend_radius_mm=3.1)))
    plan.__dict__["leads"] = Plan(STRAIGHT, one_side).leads
    finding = {finding.name: finding for finding in check_plan(plan)}["fibre_bend"]
    assert (finding.status, finding.measured) == ("fail", pytest.approx(3.0, rel=1e-3))


def bent(pad: Morphology, radius: float) -> Plan:
    return Plan(pad, with_settings(pad={**pad.layout.settings, "bent_radius_mm": radius}))


def test_bending_strains_have_closed_forms():
    """Horizontals, 1.2 mm deep, lie 3 - 1.2 + 0.15 mm above the middle of 6 mm; verticals stay as they are."""
    shallow, deep = compute_bending_strains(bent(Morphology.straight((3, 2), (8.0, 15.0)), 30.0))
    assert shallow[:2] == (0.4, 0.0)
    assert deep[1] == pytest.approx(1.95 / 33)
    knots = Morphology.straight((0, 1), 10.0).knots
    middle = np.array([[[0.7, 0.3], [1.3, 0.7]]])
    pad = Morphology(np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1), 10.0, fibres=(0, 1))
    ((_, strain, _),) = compute_bending_strains(bent(pad, 20.0))
    steps = np.concatenate([np.diff(line.coords, axis=0) for line in bent(pad, 20.0).lines])
    steepest = np.abs(steps[:, 0] / steps[:, 1]).max()
    assert strain == pytest.approx((3 - 0.4 + 0.15) / 23 * steepest**2 / (1 + steepest**2))


def test_contact_of_settings_counts_if_the_pad_has_none():
    tables: dict[str, dict[str, object]] = {"mould": {"silicone_mm": 8.0}}
    thick = FabricationSettings.from_spec(Spec(tables))
    statuses = {f.name: f.status for f in check_plan(Plan(STRAIGHT, replace(thick, contact=Contact())))}
    assert statuses["silicone_thickness"] == "warn"
    for contact in ({"radius": 0.6}, {}):
        settings = FabricationSettings.from_spec(Spec(tables | {"contact": contact}))
        assert "silicone_thickness" not in {finding.name for finding in check_plan(Plan(STRAIGHT, settings))}
