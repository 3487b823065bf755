"""Checks of plans with a known shape or a known fault."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.common.settings import Spec
from padforge.design.morphology import Morphology
from padforge.design.settings import Contact, RulesSettings
from padforge.fabricate.checks import Finding
from padforge.fabricate.checks.plan_checks import check, check_plan, compute_bending_strains
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import DEFAULTS, FabricationSettings
from tests.fabricate.planted import level_pad, with_settings


def find(pad: Morphology, name: str, settings: FabricationSettings = DEFAULTS) -> Finding:
    return {finding.name: finding for finding in check_plan(Plan(pad, settings))}[name]


def test_check_passes_a_straight_pad():
    findings = check(Morphology.straight(2))
    assert {finding.status for finding in findings} == {"pass"}
    assert len({finding.name for finding in findings}) == len(findings)
    assert "fibre_strain" not in {finding.name for finding in findings}  # it lies flat


RESIN = {"nozzle_mm": 0.2, "resin": True}
UNEVEN = {"floor_mm": 2.05, "shallow_ridge_height_mm": 0.45, "deep_ridge_height_mm": 1.25}
SHRINKING = {"silicone": {"shrinkage": 0.02}, "fibre": {"diameter_mm": 0.395}}


@pytest.mark.parametrize(
    ("name", "settings", "status", "measured", "limit"),
    [
        ("layers", {"printer": {"layer_mm": 0.16}}, "warn", 2.5, ...),
        *(("layers", {"mould": {key: mm}}, "warn", ..., ...) for key, mm in UNEVEN.items()),
        ("layers", {"printer": {"layer_mm": 0.3}}, "fail", 4 / 3, ...),
        ("ridge_width", {"printer": RESIN}, "pass", 0.4, 0.4),
        ("ridge_width", {"printer": RESIN | {"nozzle_mm": 0.21}}, "fail", 0.4, 0.42),
        ("track_size", {"fibre": {"diameter_mm": 0.4}}, "pass", 0.4, 0.4),
        ("track_size", {"mould": {"shallow_ridge_height_mm": 0.6}, "fibre": {"diameter_mm": 0.41}}, "fail", 0.4, 0.41),
        # Tracks shrink and fibres do not: 0.408 mm are rounded to 4 layers, and shrink.
        ("track_size", SHRINKING, "fail", 0.392, 0.395),
        ("ridge_width", SHRINKING, "pass", 0.4 / 0.98, ...),
        ("crossing_gap", SHRINKING, "warn", 0.98 * 0.8 - 0.395, ...),
        ("crossing_gap", {"mould": {"deep_ridge_height_mm": 1.09}}, "warn", 0.39, ...),
        ("slenderness", {"mould": {"deep_ridge_height_mm": 2.04}}, "warn", 5.1, ...),
        ("slenderness", {"mould": {"deep_ridge_height_mm": 4.04}}, "fail", 10.1, ...),
        ("cover", {"mould": {"silicone_mm": 2.19}}, "warn", 0.99, ...),
    ],
)
def test_findings_of_a_straight_pad_by_settings(name, settings, status, measured, limit):
    finding = find(Morphology.straight(1), name, with_settings(**settings))
    assert finding.status == status
    assert measured is ... or finding.measured == pytest.approx(measured, abs=1e-9)
    assert limit is ... or finding.limit == pytest.approx(limit)
    if name in ("ridge_width", "slenderness"):
        assert len(finding.positions_mm) == (0 if status == "pass" else {"ridge_width": 2, "slenderness": 1}[name])


class TestFibres:
    @pytest.mark.parametrize(("levels", "status"), [("as_needed", "warn"), ("two", "fail")])
    def test_same_family_crossings_by_levels(self, levels, status):
        finding = find(level_pad(1.8, 1.2), "same_family_crossings", with_settings({"levels": levels}))
        assert (finding.status, finding.measured) == (status, 2)
        assert all(isinstance(value, float) for position in finding.to_dict()["positions_mm"] for value in position)
        assert find(level_pad(1.8, 1.2), "silicone_wall").status == "pass"  # they lie at two depths
        (x, y), (other_x, _) = finding.positions_mm
        assert x == pytest.approx(-other_x, abs=1e-3)
        assert y == pytest.approx(0, abs=1e-3)

    @pytest.mark.parametrize(("bears", "rule", "status", "limit"), [(20, 1, "fail", 20), (9, 12, "pass", 12)])
    def test_fibre_bend_by_material_and_rule(self, bears, rule, status, limit):
        """Fibres that swing gently: their bends are of some 13 mm."""
        knots = np.array([[0, 1], [0.1, 1.01], [0.5, 1.1], [1.5, 0.9], [1.9, 0.99], [2, 1]])
        pad = Morphology(np.stack([knots, knots[:, ::-1]]), 15.0)
        settings = with_settings(
            rules={"min_mean_bend_radius_mm": float(rule)}, fibre={"min_bend_radius_mm": float(bears)}
        )
        finding = find(pad, "fibre_bend", settings)
        assert (finding.status, finding.limit) == (status, limit)

    @pytest.mark.parametrize(("rise", "status", "leads"), [(0.5, "pass", "one side"), (0.6, "fail", "edges")])
    def test_fibre_bend_at_a_lead_fails_above_half_a_radian(self, rise, status, leads):
        """A straight climb from the left end of the horizontal on; leads begin straight."""
        at = np.array([0, 0.4, 0.8, 1.4, 2])
        climb = np.stack([at, 1 + rise * np.array([0, 0.4, 0.8, 0, 0])], axis=1)
        pad = Morphology(np.stack([climb, np.stack([np.ones(5), at], axis=1)]), 11.25)
        bends = find(pad, "fibre_bend", with_settings(pad={"leads": leads}))
        assert bends.status == status
        assert bends.measured == pytest.approx(min(0.5 / np.arctan(rise), 1.0), rel=2e-3)
        assert len(bends.positions_mm) == (status == "fail")
        if bends.positions_mm:
            assert bends.positions_mm[0] == pytest.approx((-11.25, 0), abs=0.02)

    def test_fibre_bend_includes_leads(self):
        one_side = with_settings(pad={"leads": "one side"}, rules={"min_mean_bend_radius_mm": 3.0})
        assert find(Morphology.straight(2), "fibre_bend", one_side).status == "pass"
        tighter = replace(one_side, rules=RulesSettings(min_mean_bend_radius_mm=3.1))
        plan = Plan(Morphology.straight(2), tighter)
        plan.__dict__["leads"] = Plan(Morphology.straight(2), one_side).leads  # planted: those of the other radius
        finding = {finding.name: finding for finding in check_plan(plan)}["fibre_bend"]
        assert (finding.status, finding.measured) == ("fail", pytest.approx(3.0, rel=1e-3))


class TestSilicone:
    @pytest.mark.parametrize(("gap_mm", "status"), [(0.42, "pass"), (0.38, "warn")])
    def test_silicone_wall_between_two_tracks(self, gap_mm, status):
        away = (gap_mm + 0.4) / 20
        finding = find(level_pad(1.5 - away, 1.5 + away), "silicone_wall")
        assert finding.status == status
        assert finding.measured == pytest.approx(gap_mm, abs=max(0.015, 0.02 * gap_mm))
        assert all(abs(y) < gap_mm for _, y in finding.positions_mm)
        assert bool(finding.positions_mm) == (status != "pass")

    @pytest.mark.parametrize(
        ("width", "length", "status"), [(0.2, 2.0, "pass"), (0.4, 2.0, "warn"), (0.4, None, "off")]
    )
    def test_common_tracks_at_a_shallow_crossing(self, width, length, status):
        """Half-way between two turning points a PCHIP is half as steep again: they cross at 14.9 degrees."""
        vertical = np.array([[1, 0], [0.5, 0.8], [1.5, 1.2], [1, 2]])
        pad = Morphology(np.stack([np.stack([[0, 0.5, 1.5, 2], np.ones(4)], axis=1), vertical]), 20.0)
        settings = with_settings(
            {"ridge_width_mm": width}, {"nozzle_mm": width}, rules={"max_common_track_mm": length or "any"}
        )
        findings = {finding.name: finding for finding in check_plan(Plan(pad, settings))}
        if status == "off":
            assert "common_tracks" not in findings
            return
        finding = findings["common_tracks"]
        assert (finding.status, finding.limit) == (status, 2.0)
        assert finding.measured == pytest.approx(2 * width / np.sin(np.arctan(0.4 / 1.5)), rel=0.05)
        assert "fibre 2 over 1 at (0.0, 0.0) mm" in finding.message
        assert len(finding.positions_mm) == (status == "warn")

    def test_silicone_wall_of_a_fibre_that_turns_back(self):
        turns = np.array([[0, 1], [0.95, 1], [0.98, 1.8], [1.04, 0.2], [1.07, 1], [2, 1]])
        pad = Morphology(np.stack([turns, np.stack([np.ones(6), np.linspace(0, 2, 6)], axis=1)]), 11.25)
        assert find(pad, "silicone_wall").status != "pass"

    @pytest.mark.parametrize(("from_wall_mm", "status"), [(0.62, "pass"), (0.58, "warn"), (0.1, "fail")])
    def test_tray_wall_beside_a_track(self, from_wall_mm, status):
        finding = find(level_pad(from_wall_mm / 10, 2.0), "tray_wall")
        assert finding.status == status
        assert finding.measured == pytest.approx(from_wall_mm - 0.2, abs=0.01)
        assert all(y == pytest.approx(-15 + from_wall_mm, abs=0.01) for _, y in finding.positions_mm)


class TestFolds:
    """Bends so tight that the inner wall of a track would run back through itself."""

    def build_pad(self, travel, cross, family: int) -> Morphology:
        """A pad of 1 x 1, pitch 10 mm, with one fibre through the given knots and one that is straight."""
        level = np.stack([np.linspace(0, 2, len(travel)), np.ones(len(travel))], axis=1)
        fibres = [np.stack([travel, cross], axis=1), level]
        horizontal, vertical = fibres if family == 0 else fibres[::-1]
        return Morphology(np.stack([horizontal, vertical[:, ::-1]]), 10.0)

    @pytest.mark.parametrize(("family", "up"), [(0, 1), (1, -1)])
    def test_folds_by_bend_radius(self, family, up):
        # Two spans from 0.8 over 1 to 1.2, level at every knot: at each the curvature is 6 x 0.2 / 0.2^2 per grid unit.
        bump = self.build_pad([0, 0.8, 1, 1.2, 2], [1, 1, 1 + 0.2 * up, 1, 1], family)
        radius_mm = 10 * 0.2**2 / (6 * 0.2)
        near: dict[str, object] = {"tolerance_mm": 1e-3, "exit_width_mm": 2.0}
        narrow, wide = ({**near, "ridge_width_mm": 2 * radius_mm * ratio} for ratio in (0.98, 1.25))
        assert find(bump, "folds", with_settings(narrow)).status == "pass"
        finding = find(bump, "folds", with_settings(wide))
        assert (finding.status, finding.measured) == ("warn", 3)
        knots = np.array([(-2, 0), (0, 2 * up), (2, 0)])[:, :: -1 if family else 1]
        assert np.array(finding.positions_mm) == pytest.approx(knots, abs=0.3)
        assert find(bump, "folds", with_settings({**narrow, "ridge_draft_deg": 10.0})).status == "warn"  # at the foot

    @pytest.mark.parametrize(("family", "rise"), [(0, -0.6), (1, 0.8)])
    def test_folds_at_a_corner(self, family, rise):
        # Straight to a corner at 0.8, where the slope climbs from `rise` to 4/3 of it and falls to 0 within 1e-6.
        cross = 1 + rise * np.array([0, 0.8 - 1e-6, 0.8, 0.8, 0])
        pad = self.build_pad([0, 0.8 - 1e-6, 0.8, 1.2, 2], cross, family)
        cut = 0.2 * (1 - np.cos(np.arctan(4 / 3 * rise) / 2))
        finding = find(pad, "folds", with_settings({"tolerance_mm": 0.97 * cut}))
        assert (finding.status, finding.measured) == ("warn", 1)
        corner = np.array([-2, 10 * 0.8 * rise])[:: -1 if family else 1]
        assert np.array(finding.positions_mm[0]) == pytest.approx(corner, abs=1e-3)
        assert f"{cut:.2f} mm" in finding.message
        assert find(pad, "folds", with_settings({"tolerance_mm": 1.03 * cut})).status == "pass"


def bent(pad: Morphology, radius: float, **settings: dict[str, Any]) -> Plan:
    return Plan(pad, with_settings(pad={**pad.layout.settings, "bent_radius_mm": radius}, **settings))


def test_bending_strain_of_straight_fibres():
    """Horizontals, 1.2 mm deep, lie 3 - 1.2 + 0.15 mm above the middle of 6 mm; verticals stay as they are."""
    shallow, deep = compute_bending_strains(bent(Morphology.straight((3, 2), (8.0, 15.0)), 30.0))
    assert shallow[:2] == (0.4, 0.0)
    assert deep[1] == pytest.approx(1.95 / 33)


def test_bending_strain_falls_with_the_squared_cosine():
    knots = Morphology.straight((0, 1), 10.0).knots
    middle = np.array([[[0.7, 0.3], [1.3, 0.7]]])
    pad = Morphology(np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1), 10.0, fibres=(0, 1))
    ((_, strain, _),) = compute_bending_strains(bent(pad, 20.0))
    steps = np.concatenate([np.diff(line.coords, axis=0) for line in bent(pad, 20.0).lines])
    steepest = np.abs(steps[:, 0] / steps[:, 1]).max()
    assert strain == pytest.approx((3 - 0.4 + 0.15) / 23 * steepest**2 / (1 + steepest**2))


@pytest.mark.parametrize(("stretch", "status"), [(1.0, "pass"), (0.1, "warn"), (0.05, "fail")])
def test_fibre_strain_by_material(stretch, status):
    plan = bent(Morphology.straight(2, 10.0), 20.0, fibre={"max_strain": stretch})
    (finding,) = (finding for finding in check_plan(plan) if finding.name == "fibre_strain")
    assert finding.status == status
    assert finding.measured == pytest.approx(1.95 / 23)


def designed_for(contact: Contact, **settings: Any) -> dict[str, Finding]:
    """Findings on straight fibres designed for a contact, by name."""
    origin = {"settings": {"contact": contact.model_dump(mode="json")}}
    pad = Morphology.from_layout(Morphology.straight(2).knots, Morphology.straight(2).layout, origin)
    return {finding.name: finding for finding in check_plan(Plan(pad, with_settings(**settings)))}


@pytest.mark.parametrize(
    ("contact", "settings", "thickness", "depths"),
    [
        (Contact(), {}, "pass", "pass"),
        (Contact(fibre_depths_mm=(4.95, 5.75)), {}, "pass", "pass"),  # pressed on the other face
        (Contact(), {"silicone": {"shrinkage": 0.01}}, "pass", "pass"),
        (Contact(), {"mould": {"silicone_mm": 8.0}}, "warn", "pass"),
        (Contact(), {"pad": {"deep_family": "vertical"}}, "pass", "warn"),
        (Contact(), {"mould": {"deep_ridge_height_mm": 1.6}}, "pass", "warn"),
    ],
)
def test_mould_is_compared_with_the_layer_that_the_design_believes(contact, settings, thickness, depths):
    findings = designed_for(contact, **settings)
    assert (findings["silicone_thickness"].status, findings["fibre_depths"].status) == (thickness, depths)


def test_contact_of_settings_counts_if_the_pad_has_none():
    tables: dict[str, dict[str, object]] = {"mould": {"silicone_mm": 8.0}}
    pad, settings = Morphology.straight(2), FabricationSettings.from_spec(Spec(tables))
    assert find(pad, "silicone_thickness", replace(settings, contact=Contact())).status == "warn"
    for contact in ({"radius": 0.6}, {}):
        settings = FabricationSettings.from_spec(Spec(tables | {"contact": contact}))
        assert "silicone_thickness" not in {finding.name for finding in check_plan(Plan(pad, settings))}


def test_fibre_bend_is_that_of_the_tightest_fibre():
    """Of two, one turns within 0.3 mm and the other within 0.9 mm: both are tighter than allowed."""
    knots = [np.array([[0, 1], [0.9, 1], [0.9 + run, 1.05], [1.5, 1.05], [2, 1]]) for run in (0.08, 0.03)]
    pads = [Morphology(np.stack([first, second[:, ::-1]]), 11.25) for first, second in (knots, knots[::-1])]
    gentle, tight = (Morphology(np.stack([each, each[:, ::-1]]), 11.25) for each in knots)
    radii = [float(np.asarray(find(pad, "fibre_bend").measured)) for pad in (gentle, tight)]
    assert radii[1] < 0.7 * radii[0] < 0.6
    for pad in pads:
        both = find(pad, "fibre_bend")
        assert (both.measured, len(both.positions_mm)) == (pytest.approx(radii[1], rel=1e-3), 2)
        assert both.message == f"fibres 1, 2 bent as tightly as {radii[1]:.2f} mm, in the mean over 0.5 mm"
