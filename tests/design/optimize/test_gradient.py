import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from padforge.design import Contact, Morphology, check_rules
from padforge.design.contact_set import served_contacts
from padforge.design.morphology import MARGIN
from padforge.design.objectives.criterion import criterion_errors
from padforge.design.objectives.penalties import penalties
from padforge.design.optimize import gradient
from padforge.design.optimize.problem import SearchProblem
from padforge.design.paths.curves import refine
from padforge.design.settings import PUBLISHED_CONTACT, PUBLISHED_SEARCH, PadSettings, RulesSettings, SearchSettings

PAD, FREE = PadSettings(grid=2, sensed_mm="fibres"), RulesSettings(enforce=False)
BRIEF = PUBLISHED_SEARCH.model_copy(update={"starts": 1, "steps": 20, "max_failures": 1, "knots": 6})


def begun(search, rules):
    contacts = tuple(served_contacts(PUBLISHED_CONTACT, search).values())
    return gradient.GradientSearch(SearchProblem(PAD, contacts, search, rules), 0)


def advance(run, steps):
    for _ in range(steps):
        if not run.done:
            run.advance()


def finished(search, rules):
    run = begun(search, rules)
    while not run.done:
        run.advance()
    return run.morphology()


@settings(max_examples=20)
@given(st.integers(1, 6), st.integers(0, 99))
def test_gradients_by_free_variables_match_differences(knots, seed):
    rng, pad = np.random.default_rng(seed), Morphology.random((2, 3), knots, seed, pitch_mm=(8.0, 15.0))
    fibres = gradient.Parametrization.from_knots(pad.knots, pad.layout, 0.02)
    weights = rng.standard_normal((2, 5, knots + 2))
    variables, gradients = (fibres.spans, fibres.across), fibres.gradients(*weights)
    for variable, slope in zip(variables, gradients, strict=True):
        move, values = rng.standard_normal(variable.shape), []
        for step in (1e-5, -2e-5):
            variable += step * move
            values.append((weights * np.array(fibres.axes())).sum())
        variable += 1e-5 * move
        assert (slope * move).sum() == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-5, abs=1e-7)


def test_steps_of_adam_ignore_what_is_no_number():
    variable = np.array([0.3, -1.0, 2.0])
    gradient.Adam([variable]).step((np.array([np.nan, np.inf, -np.inf]),), 0.1)
    assert variable.tolist() == [0.3, -1.0, 2.0]


def test_gradient_search_for_several_contacts_serves_each():
    large = Contact(radius=1.2)
    one = BRIEF.model_copy(update={"steps": 60, "max_failures": 0, "knots": 4})
    for_one, for_both = (finished(each, FREE) for each in (one, one.model_copy(update={"contacts": (large,)})))
    alone, together = (criterion_errors(pad, large, one, PadSettings(grid=2)) for pad in (for_one, for_both))
    assert together[0] < 0.9 * alone[0]


def test_common_tracks_count_at_the_end_of_a_search(monkeypatch):
    """Before, crossings may move along; the other rules count from the first step."""
    seen = []

    def noted(along, across, pad, rules, *how):
        seen.append(rules)
        return penalties(along, across, pad, rules, *how)

    monkeypatch.setattr("padforge.design.optimize.gradient.penalties", noted)
    rules = RulesSettings(max_common_track_mm=3.0)
    advance(begun(SearchSettings(knots=2, steps=11, starts=1, max_failures=0), rules), 11)
    assert seen == [rules.model_copy(update={"max_common_track_mm": None})] * 7 + [rules] * 4


def test_border_of_knots_is_that_of_the_rules_and_leaves_room_on_the_narrow_side():
    pad = PadSettings(horizontals=2, verticals=5, pitch_mm=(10.0, 8.0))  # 60 by 24 mm
    unit_mm, side_mm = pad.layout.unit_mm, min(pad.layout.size_mm)
    assert gradient.border_width(pad, RulesSettings(border_mm=3.0)) == pytest.approx(3.0 / unit_mm)
    assert gradient.border_width(pad, RulesSettings(border_mm=50.0)) == pytest.approx(0.45 * side_mm / unit_mm)
    assert gradient.border_width(pad, RulesSettings(border_mm=3.0, enforce=False)) == MARGIN


@settings(max_examples=5)
@given(st.integers(1, 20), st.integers(0, 99))
def test_refine_keeps_knots_and_curve(more, seed):
    pad = Morphology.random(2, 4, seed)
    finer = refine(pad.knots, 4 + more, pad.layout)
    assert finer.shape == (4, 6 + more, 2)
    for fibre, (old, new) in enumerate(zip(pad.knots, finer, strict=True)):
        axis = fibre // 2
        assert np.isin(old[:, axis], new[:, axis]).all()
        curve = PchipInterpolator(old[:, axis], old[:, 1 - axis])
        assert new[:, 1 - axis] == pytest.approx(curve(new[:, axis]), abs=1e-12)


@pytest.mark.parametrize(
    "rules",
    [
        {"max_length_mm": 39.0},
        pytest.param({"min_gap_mm": 4.0, "max_crossings": 4, "min_crossing_angle_deg": 60.0}, marks=pytest.mark.slow),
    ],
)
def test_gradient_search_keeps_rules(rules):
    """By steps and repair alone: a whole search would hand back straight fibres in place of what breaks a rule."""
    asked = RulesSettings(**rules)
    assert {violation.rule for violation in check_rules(finished(BRIEF, FREE), asked)} >= set(rules)
    assert check_rules(finished(BRIEF, asked), asked) == []


def test_repair_moves_only_fibres_that_break_rules_and_goes_on_from_its_state():
    """Fibre 1 is the one that turns too sharply; the same bits whether or not a state lies between the steps."""
    pad, rules = Morphology.straight(2), RulesSettings(min_mean_bend_radius_mm=4.0)
    knots = refine(pad.knots, 5, pad.layout)
    knots[0, 3, 1] += 0.35
    search = SearchSettings(knots=5, steps=1, starts=1, contacts="assumed")
    problem = SearchProblem(PAD, (PUBLISHED_CONTACT,), search, rules, Morphology(knots))
    run = gradient.GradientSearch(problem, 0)
    run.finish()
    advance(run, 7)
    resumed = gradient.GradientSearch(problem, 0, run.state())
    for each in (run, resumed):
        advance(each, 600)
    assert check_rules(run.morphology(), rules) == []
    assert run.morphology() == resumed.morphology()
    moved = np.abs(run.morphology().knots - knots).max(axis=(1, 2))
    assert moved[0] > 0.01
    assert moved[1:].max() < 1e-9


def test_what_fine_steps_do_not_repair_firm_ones_do():
    """Fibres as tangled as after three steps alone."""
    run = begun(SearchSettings(knots=9, steps=3, starts=1, seed=3, contacts="assumed"), RulesSettings())
    advance(run, 3 + gradient.FINE_STEPS)
    assert check_rules(run.morphology(), RulesSettings()) != []
    advance(run, gradient.REPAIR_STEPS)
    assert check_rules(run.morphology(), RulesSettings()) == []
