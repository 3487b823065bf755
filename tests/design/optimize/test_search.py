import pickle
import re
from concurrent.futures import Executor, Future
from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Contact, Morphology, check_rules
from padforge.design.contact_set import served_contacts
from padforge.design.objectives.criterion import criterion_errors
from padforge.design.objectives.score import ScoredPad, describe_terms, score
from padforge.design.optimize.gradient import GENTLE
from padforge.design.optimize.problem import build_problem
from padforge.design.optimize.search import SearchOptions, choose, search, search_for_twin
from padforge.design.paths.curves import refine
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings
from tests.design.objectives.pads import square

PAD, FREE, RULES = PadSettings(grid=2), RulesSettings(enforce=False), RulesSettings()
SMALL = SearchSettings(knots=3, starts=2, steps=10, population=10, generations=3, max_failures=1, contacts="assumed")
QUICK = SMALL.model_copy(update={"starts": 1, "steps": 1, "generations": 1})
REPAIR = "padforge.design.optimize.gradient.REPAIR_STEPS"


class Remote(Executor):
    """Pickles work and results, as for processes of other machines."""

    def submit(self, fn, /, *args, **kwargs):
        work, given, named = pickle.loads(pickle.dumps((fn, args, kwargs)))
        future = Future()
        future.set_result(pickle.loads(pickle.dumps(work(*given, **named))))
        return future


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_search_depends_on_its_seed_and_not_on_its_executor(method, monkeypatch):
    pad, settings = PadSettings(grid=1), SMALL.model_copy(update={"method": method})
    first, reported = search(pad, None, settings, FREE), []
    monkeypatch.setattr("padforge.design.optimize.search.SLICE_S", -1.0)  # a slice ends after its first step
    run = SearchOptions(lambda *progress: reported.append(progress), executor=Remote())
    sliced = search(pad, None, settings, FREE, run=run)
    assert len(reported) == (2 * 10 if method == "descent" else 3)
    assert method == "genetic" or first.candidate.startswith("start")  # better than straight fibres
    assert (first.morphology, first.history, first.terms) == (sliced.morphology, sliced.history, sliced.terms)
    assert first.morphology != search(pad, None, settings.model_copy(update={"seed": 1}), FREE).morphology


def test_search_reports_scores_beside_those_of_straight_fibres():
    pad, contact = PadSettings(grid=2, sensed_mm=(20, 30)), Contact(radius=0.9)
    settings = QUICK.model_copy(update={"noise": 0.03, "steps": 5})
    result = search(pad, contact, settings, FREE)
    how = contact, 1, 0.05, FREE, pad, settings.response_scatter
    scored, straight = (score(each, *how) for each in (result.morphology, Morphology.straight(2)))
    assert result.terms == scored
    assert result.straight == pytest.approx({name: straight[name] for name in straight if "_mm_" in name}, rel=1e-6)
    assert describe_terms(scored).keys() == scored.keys()
    assert result.violations == []
    assert not result.enforced


def test_search_returns_an_origin_that_it_cannot_improve(monkeypatch):
    """Far too large steps lead away from it."""
    origin = search(PAD, PUBLISHED_CONTACT, SMALL, FREE).morphology
    monkeypatch.setattr("padforge.design.optimize.gradient.GENTLE", GENTLE._replace(rate=3.0))
    result = search(PAD, PUBLISHED_CONTACT, QUICK, FREE, origin=origin)
    assert (result.morphology, result.candidate) == (origin, "origin")


def test_search_is_never_worse_than_straight_fibres_but_by_the_published_method():
    """Under the profile; a random start is better than straight fibres at once under a layer."""
    worse, profile = Morphology.random(2, 3, seed=0), Contact(model="profile")
    result = search(PAD, profile, QUICK, FREE, origin=worse)
    assert result.candidate == "straight fibres"
    assert result.morphology.knots.shape == worse.knots.shape
    assert np.ptp(result.morphology.knots[:2, :, 1], axis=1).tolist() == [0, 0]
    assert result.straight.items() <= result.terms.items()
    genetic = search(PAD, profile, QUICK.model_copy(update={"method": "genetic"}), FREE, origin=worse)
    assert genetic.candidate in ("genetic", "origin")
    assert genetic.straight == result.straight
    assert genetic.terms["expected_error_mm_0"] > genetic.straight["expected_error_mm_0"]


def test_search_prefers_a_pad_within_the_rules_to_one_that_errs_less(monkeypatch):
    monkeypatch.setattr(REPAIR, 1)
    curved, rules = Morphology.random(2, 3, seed=1), RulesSettings(max_length_mm=34)
    result = search(PAD, PUBLISHED_CONTACT, QUICK, rules, origin=curved)
    assert (result.candidate, result.violations) == ("straight fibres", [])
    error_mm = curved.unit_mm * criterion_errors(curved, PUBLISHED_CONTACT, QUICK, PAD)[0]
    assert error_mm < result.terms["expected_error_mm_0"]


def test_search_around_a_keep_out_obeys_the_rules():
    pad = PadSettings(horizontals=2, verticals=2, pitch_mm=(8.0, 15.0), keep_out_mm=(square(0.0, 6.0, 8.0),))
    result = search(pad, None, QUICK.model_copy(update={"knots": 6}), RULES)
    assert result.violations == check_rules(result.morphology, RULES, pad) == []
    assert result.morphology.layout == pad.layout
    assert result.terms["penalty_keep_out_mm"] < 0.01


def test_search_of_a_bent_pad_obeys_the_rules_on_the_cylinder(monkeypatch):
    """One fibre rises and falls within the rules as long as the pad is flat."""
    monkeypatch.setattr(REPAIR, 20)
    pad, rules = PadSettings(horizontals=2, verticals=1, bent_radius_mm=6.0), RulesSettings(min_mean_bend_radius_mm=4.0)
    knots = refine(Morphology.straight(pad.layout).knots, 3, pad.layout)
    knots[0, 2, 1] += 0.13
    origin = Morphology.from_layout(knots, pad.layout)
    assert check_rules(origin, rules) == []
    assert check_rules(origin, rules, pad) != []
    result = search(pad, None, QUICK, rules, origin=origin)
    assert check_rules(result.morphology, rules, pad) == result.violations == []


def test_search_reports_rules_that_cannot_hold(monkeypatch):
    monkeypatch.setattr(REPAIR, 20)
    rules = RulesSettings(min_gap_mm=30.0, max_crossings=3, border_mm=500.0, max_length_mm=20.0)
    result = search(PAD, None, QUICK, rules)
    assert {violation.rule for violation in result.violations} >= rules.model_fields_set
    for rule in ("max_length_mm", "border_mm"):
        assert [v.fibres for v in result.violations if v.rule == rule] == [(1,), (2,), (3,), (4,)]
    assert result.enforced


@pytest.mark.parametrize(("method", "counts"), [("descent", (3, 0)), ("genetic", (0, 1))])
def test_search_of_pads_of_one_family(method, counts, monkeypatch):
    monkeypatch.setattr(REPAIR, 20)
    pad = PadSettings(horizontals=counts[0], verticals=counts[1], pitch_mm=(8.0, 15.0))
    found = search(pad, None, QUICK.model_copy(update={"method": method}))
    assert found.morphology.layout.counts == counts
    assert np.isfinite([*found.terms.values()]).all()


def test_choose_takes_no_pad_that_is_worse_than_plain_ones():
    """Of pads each of which is worse somewhere it takes the least bad."""
    plain = {"default": np.array([1.0, 1.0, 1.5, 2.0]), "straight fibres": np.array([0.9, 1.2, 2.0, 3.0])}
    for twin, expected in (
        ([0.9, 0.9, 1.0, 1.5], "twin"),  # better everywhere
        ([0.92, 1.02, 1.0, 1.0], "twin"),  # within what networks tell
        ([1.02, 0.5, 0.5, 0.5], "default"),  # far better with fibres failed, but an eighth worse with all alive
        ([2.0, 2.0, 2.0, 3.5], "default"),
    ):
        assert choose(plain | {"twin": np.array(twin)}) == expected
    errors = {"default": np.array([2.0, 1.0]), "straight fibres": np.array([1.0, 2.0]), "twin": np.array([1.3, 1.3])}
    assert choose(errors) == "twin"


def test_search_for_twin_begins_no_search_after_an_interrupt(monkeypatch):
    found, searches = search(PadSettings(grid=1), None, QUICK, RulesSettings()), []

    def interrupted(*asked, run, **others):
        searches.append(run)
        return replace(found, stopped="interrupted" if len(searches) == 2 else "", seconds=4.0 * len(searches))

    monkeypatch.setattr("padforge.design.optimize.search.search", interrupted)
    result = search_for_twin(PadSettings(grid=1), Contact(), QUICK, RULES, QUICK, run=SearchOptions(time_budget=10))
    assert ([run.time_budget for run in searches], result.stopped) == ([3.5, 4.0], "interrupted")
    assert result.seconds == 4 + 8


@pytest.mark.parametrize(
    ("rules", "expected"), [({"enforce": False}, "straight fibres"), ({"max_length_mm": 20}, "twin")]
)
def test_search_for_twin_hands_back_what_locates_best_and_can_be_built_if_any_can(rules, expected, monkeypatch, golden):
    """What a criterion promises does not count."""
    monkeypatch.setattr(REPAIR, 20)

    def judged(pads, contacts, size, search):
        assert set(pads) == ({"default", "straight fibres", "twin", "from default"} if expected != "twin" else {"twin"})
        return {("", name): [1.0, 1.0] if name == "straight fibres" else [2.0, 2.0] for name in pads}

    monkeypatch.setattr("padforge.design.optimize.search.errors_by_contact", judged)
    quick = SearchSettings(knots=3, starts=1, steps=2, max_failures=1)
    pad, contact = PadSettings(grid=1), Contact(sensitivity_profile=((0, 1), (5, 0.6), (9, 0.1), (12, 0)))
    steps = []
    run = SearchOptions(on_progress=lambda done, total, what: steps.append(what))
    found = search_for_twin(pad, contact, quick, RulesSettings(**rules), quick, run=run)
    assert found.candidate == expected
    assert bool(found.violations) == (expected == "twin")
    if expected == "straight fibres":
        assert found.morphology == Morphology.straight(pad.layout)
        assert found.terms["expected_error_mm_0"] == pytest.approx(found.straight["expected_error_mm_0"], rel=1e-6)
    words = dict.fromkeys(re.sub(r"\d+\.\d+", "#", what) for what in steps)
    history = [f"{row['run']}, step {row['step']}" for row in found.history]
    golden("design/twin_search.txt", "\n".join([*words, *history]))


@pytest.mark.parametrize("fibres", [(1, 0), (1, 1), (2, 2)])
def test_comparison_of_straight_fibres_is_1(fibres):
    """Also where fewer fibres can fail than are designed for."""
    pad = PadSettings(horizontals=fibres[0], verticals=fibres[1])
    problem = build_problem(pad, Contact(), SearchSettings(), FREE)
    assert problem.comparison(Morphology.straight(fibres)) == pytest.approx(1)


def test_pads_are_compared_by_a_geometric_mean_and_weighted_terms():
    pad, curved = PadSettings(grid=2), Morphology.random(2, 3, seed=1)
    search = SearchSettings(max_failures=(3.0, 1.0))
    contacts, both = served_contacts(Contact(), search).values(), (curved, Morphology.straight(2))
    errors = np.array([[criterion_errors(each, contact, search, pad) for contact in contacts] for each in both])
    log_ratios = np.log(errors[0] / errors[1]) @ [0.75, 0.25]
    comparison = build_problem(pad, Contact(), search, FREE).comparison(curved)
    assert comparison == pytest.approx(np.exp(log_ratios.mean()))
    smooth = build_problem(pad, Contact(), search.model_copy(update={"sharpness": 2.0}), FREE)
    sharpness = ScoredPad(curved, Contact(), search, FREE, pad).terms(["sharpness"])["sharpness"]
    assert smooth.comparison(curved) == pytest.approx(comparison + 2 * sharpness)
