"""Scores, rules, penalties and plans of pads as wild as the class allows: steps, needles, fibres on each other."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.design.objectives.penalties import penalties
from padforge.design.objectives.rules import check_rules
from padforge.design.objectives.score import score
from padforge.design.optimize.gradient import Parametrization
from padforge.design.report import draw_plan
from padforge.design.settings import PadSettings, RulesSettings
from tests.design.wild_pads import KINDS, wild_knots

CONTACTS = [
    Contact(),
    Contact(radius=1e-9, sides=None),
    Contact(radius=0.1, sides=3, weight="inverse", length="euclidean"),
    Contact(radius=7.0, sides=30, weight="inverse_square"),
    Contact(radius=1e4, sides=4),
]
RULES = [
    RulesSettings(max_crossings=3, min_crossing_angle_deg=45.0, min_gap_mm=5.0),
    RulesSettings(
        min_mean_bend_radius_mm=0, min_gap_mm=1e-9, same_family_crossings=2, border_mm=0, min_crossing_angle_deg=1e-9
    ),
    RulesSettings(
        min_mean_bend_radius_mm=1000, min_gap_mm=1000, border_mm=1000, max_length_mm=1e-3, min_crossing_angle_deg=90
    ),
]


def wild_pad(kind, seed):
    rng = np.random.default_rng(seed)
    count = 0 if kind == "no knots" else int(rng.integers(1, 7))
    return Morphology(wild_knots(kind, 1 + seed % 2, count, rng), rng.choice([0.1, 11.25, 1000.0]))


@pytest.mark.parametrize("kind", [*KINDS, "no knots"])
def test_score_rules_and_plan_of_wild_pads_are_finite(kind, little_scored):
    seed = [*KINDS, "no knots"].index(kind)
    pad, contact, rules = wild_pad(kind, seed), CONTACTS[seed % 5], RULES[seed % 3]
    terms = score(pad, contact, seed % 9, (1e-9, 0.1, 10.0)[seed % 3], rules)
    assert np.isfinite([*terms.values()]).all()
    assert 0 <= terms["published_entropy"] <= 2 * np.log2(49) + 1e-9
    findings = check_rules(pad, rules)
    assert np.isfinite([[finding.measured, finding.limit] for finding in findings]).all()
    draw_plan(pad, contact, findings).draw_without_rendering()
    assert pad.tiled(2).grid == 2 * pad.grid


@pytest.mark.parametrize("kind", KINDS)
def test_penalties_and_gradients_of_wild_pads_are_finite(kind):
    pad = wild_pad(kind, 0)
    for rules in RULES:
        fibres = Parametrization.from_knots(pad.knots, pad.layout, 0.01)
        assert np.isfinite(fibres.knots()).all()
        along, across = fibres.axes()
        values, *gradient = penalties(along, across, PadSettings(grid=pad.grid, pitch_mm=pad.pitch_mm), rules)
        assert all(np.isfinite(value) and value >= 0 for value in values.values())
        assert np.isfinite(gradient).all()
