"""Searches of rectangles: within the rules around a hole, with a family that is empty, and for one fibre."""

import numpy as np
import pytest

from design import Contact, InputError, search
from design.criteria.rules import check_rules
from design.criteria.score import score
from design.evaluation.localisation_error import localisation_error
from design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings

HOLE = ((-4.0, 2.0), (4.0, 2.0), (4.0, 10.0), (-4.0, 10.0))
REPAIR = "design.optimisers.gradient_search.REPAIR_STEPS"
HOLED = PadSettings(horizontals=3, verticals=6, pitch_mm=(8.0, 15.0), keep_out_mm=(HOLE,))


def test_a_short_search_around_a_hole_obeys_the_rules(monkeypatch):
    monkeypatch.setattr(REPAIR, 40)
    settings, rules = SearchSettings(knots=9, starts=1, steps=15, lost=1), RulesSettings()
    found = search(HOLED, None, settings, rules)
    assert found.violations == check_rules(found.morphology, rules, HOLED) == []
    assert found.morphology.layout == HOLED.layout
    assert found.terms["penalty_keep_out_mm"] < 0.01


def test_a_hole_that_leaves_no_room_is_a_broken_rule_and_no_crash(monkeypatch):
    """Seven verticals are to pass in 3 mm to either side, of which border and clearance leave nothing."""
    monkeypatch.setattr(REPAIR, 20)
    wide = ((-21.0, -3.0), (21.0, -3.0), (21.0, 3.0), (-21.0, 3.0))
    pad = PadSettings(horizontals=2, verticals=7, pitch_mm=(6.0, 10.0), keep_out_mm=(wide,))
    found = search(pad, None, SearchSettings(knots=9, starts=1, steps=5, lost=0), RulesSettings())
    assert {violation.rule for violation in found.violations} & {"keep_out_mm", "border_mm", "min_gap_mm"}


@pytest.mark.parametrize(
    ("method", "counts"),
    [("descent", (3, 0)), ("descent", (0, 2)), ("genetic", (2, 0)), ("descent", (1, 0)), ("genetic", (0, 1))],
)
def test_pads_of_one_family_and_of_one_fibre_are_searched_scored_and_evaluated(method, counts, monkeypatch):
    monkeypatch.setattr(REPAIR, 20)
    pad = PadSettings(horizontals=counts[0], verticals=counts[1], pitch_mm=(8.0, 15.0))
    settings = SearchSettings(method=method, knots=3, starts=1, steps=3, population=4, generations=2, lost=1)
    found = search(pad, None, settings)
    assert found.morphology.layout.counts == counts
    terms = score(found.morphology, Contact(), 1, 0.05, None, pad)
    assert np.isfinite(list(terms.values())).all()
    errors = localisation_error(
        found.morphology, PUBLISHED_CONTACT, lost=(0,), presses=64, test=50, hidden=4, subsets=1
    )
    assert errors[0].mean > 0


def test_a_pad_bent_more_sharply_than_its_fibres_may_be_is_refused():
    with pytest.raises(InputError, match=r"bent_radius_mm is 1.5, allowed is at least 2, .*min_bend_radius_mm"):
        search(PadSettings(bent_radius_mm=1.5), None, SearchSettings(), RulesSettings(min_bend_radius_mm=2))


def test_a_search_of_a_bent_pad_obeys_the_rules_on_the_cylinder():
    pad, rules = PadSettings(horizontals=2, verticals=1, bent_radius_mm=6.0), RulesSettings(min_bend_radius_mm=4.0)
    found = search(pad, None, SearchSettings(knots=9, starts=1, steps=30, lost=0), rules)
    assert check_rules(found.morphology, rules, pad) == found.violations == []
