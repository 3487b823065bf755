"""The gradient search: it beats the square grid within the rules, and says what resists where they cannot be met."""

import numpy as np
import pytest

from design import Contact, Morphology
from design.common.computing import one_torch_thread
from design.criteria.rules import check_rules
from design.criteria.score import score
from design.evaluation.expected_error import expected_errors
from design.optimisers import gradient_search
from design.optimisers.problem import SearchProblem
from design.optimisers.search import search
from design.settings import (
    PUBLISHED_CONTACT,
    PUBLISHED_PAD,
    PUBLISHED_SEARCH,
    PadSettings,
    RulesSettings,
    SearchSettings,
)

SMALL = SearchSettings(knots=3, starts=1, steps=20, lost=1)


def test_descent_beats_the_square_grid_within_the_rules():
    settings = PUBLISHED_SEARCH.model_copy(update={"knots": 9, "starts": 1, "steps": 60, "lost": 1})
    found = search(PUBLISHED_PAD, PUBLISHED_CONTACT, settings)
    pads = found.morphology, Morphology.straight(4)
    pad, grid = (score(m, PUBLISHED_CONTACT, lost=1, noise=0.02, size=PadSettings(sensed_mm="fibres")) for m in pads)
    assert found.violations == []
    assert pad["ambiguity_lost_0"] < 0.5 * grid["ambiguity_lost_0"]
    assert pad["ambiguity_lost_1"] < 0.5 * grid["ambiguity_lost_1"]


@pytest.mark.parametrize(("grid", "pitch"), [(1, 20.0), (2, 5.0), (3, 20.0)])
def test_small_and_odd_pads_are_searched_too(grid, pitch):
    found = search(PadSettings(grid=grid, pitch_mm=pitch), settings=SMALL)
    assert found.morphology.grid == grid
    assert found.morphology.pitch_mm == pitch
    assert found.violations == []


def test_several_contacts_serve_both_better_than_one_alone():
    one = PUBLISHED_SEARCH.model_copy(update={"starts": 1, "steps": 60, "lost": 0, "knots": 4})
    large = Contact(radius=1.2)
    both = one.model_copy(update={"contacts": (large,)})
    for_one, for_both = (search(PadSettings(grid=2), PUBLISHED_CONTACT, settings) for settings in (one, both))
    alone, together = (
        expected_errors(found.morphology, large, one, PadSettings(grid=2)) for found in (for_one, for_both)
    )
    assert together < alone


def test_rules_that_cannot_hold_are_named(monkeypatch):
    monkeypatch.setattr(gradient_search, "REPAIR_STEPS", 100)
    found = search(settings=SMALL, rules=RulesSettings(max_length_mm=20))
    assert {v.rule for v in found.violations} == {"max_length_mm"}
    assert len(found.violations) == 8


@pytest.mark.parametrize(
    ("rules", "resists"),
    [
        ({"min_gap_mm": 30.0}, "min_gap_mm"),
        ({"min_bend_radius_mm": 900.0, "min_gap_mm": 11.2, "border_mm": 12.0}, "border_mm"),
        ({"max_crossings": 3}, "max_crossings"),
        ({"border_mm": 500.0}, "border_mm"),
    ],
)
def test_rules_that_cannot_be_met_end_with_what_resists(rules, resists, monkeypatch):
    monkeypatch.setattr(gradient_search, "REPAIR_STEPS", 100)
    found = search(PadSettings(grid=2), settings=SMALL, rules=RulesSettings(**rules))
    assert resists in {violation.rule for violation in found.violations}
    assert all(np.isfinite(violation.measured) for violation in found.violations)


@pytest.fixture(scope="module")
def as_usual():
    """What is found within the rules that hold unless others are asked for, with flat crossings."""
    return found_within(RulesSettings(max_common_track_mm=None))


@one_torch_thread()
def found_within(rules):
    """By steps alone, the better of two starts: with so few steps straight fibres are as good, and break no rule."""
    settings = PUBLISHED_SEARCH.model_copy(update={"starts": 1, "steps": 60, "lost": 1, "knots": 6})
    problem = SearchProblem(PadSettings(grid=2, sensed_mm="fibres"), (PUBLISHED_CONTACT,), settings, rules)
    starts = [gradient_search.GradientSearch(problem, number) for number in (0, 1)]
    for start in starts:
        start.advance(1000)
        assert start.done
    return min((start.morphology() for start in starts), key=lambda pad: len(check_rules(pad, rules)))


@pytest.mark.parametrize(
    "rules",
    [{"max_crossings": 4}, {"min_crossing_angle_deg": 50.0}, {"min_gap_mm": 4.0}, {"max_length_mm": 39.0}],
)
def test_each_further_rule_is_kept(rules, as_usual):
    asked = RulesSettings(**rules)
    assert check_rules(as_usual, asked) != []
    assert check_rules(found_within(asked), asked) == []
