"""Both searches through their one face: they improve, obey the rules, stop, resume, and depend on the seed alone."""

import signal
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from design import Contact, InputError, Morphology
from design.common.checkpoints import Checkpoints
from design.criteria.score import score
from design.optimisers.problem import SearchProblem
from design.optimisers.search import SearchRun, search
from design.optimisers.start import advance_start
from design.settings import PadSettings, RulesSettings, SearchSettings

SMALL = SearchSettings(knots=3, starts=2, steps=60, population=20, generations=6, lost=1)
QUICK = RulesSettings(min_bend_radius_mm=0.5)


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_the_same_seed_gives_the_same_fibres_and_another_seed_others(method):
    settings = SMALL.model_copy(update={"method": method})
    first, second = search(settings=settings), search(settings=settings)
    other = search(settings=settings.model_copy(update={"seed": 1}))
    assert first.morphology == second.morphology
    assert first.history == second.history
    assert first.morphology != other.morphology


def test_descent_beats_the_square_grid_within_the_rules():
    found = search(settings=SearchSettings(starts=1, steps=120, lost=1))
    pad, grid = (score(m, Contact(), lost=1, noise=0.02) for m in (found.morphology, Morphology.straight(4)))
    assert found.violations == []
    assert pad["ambiguity_lost_0"] < 0.5 * grid["ambiguity_lost_0"]
    assert pad["ambiguity_lost_1"] < 0.5 * grid["ambiguity_lost_1"]


def test_genetic_search_improves_generation_by_generation():
    found = search(settings=SMALL.model_copy(update={"method": "genetic"}), rules=RulesSettings(enforce=False))
    best = [entry["objective"] for entry in found.history]
    assert best == sorted(best, reverse=True)
    assert found.terms["published_objective"] == pytest.approx(best[-1])
    assert found.violations == []


def test_rules_that_cannot_hold_are_named():
    found = search(settings=SMALL, rules=RulesSettings(max_length_mm=20))
    assert {v.rule for v in found.violations} == {"max_length_mm"}
    assert len(found.violations) == 8


def test_small_and_odd_pads_are_searched_too():
    for grid, pitch in ((1, 20.0), (2, 5.0), (3, 20.0)):
        found = search(PadSettings(grid=grid, pitch_mm=pitch), settings=SMALL)
        assert found.morphology.grid == grid
        assert found.morphology.pitch_mm == pitch
        assert found.violations == []


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_ctrl_c_keeps_the_best_so_far(method):
    """The signal comes from the first report; what was found by then is returned, and says so."""
    settings = SMALL.model_copy(update={"method": method, "steps": 100_000, "generations": 100_000})
    found = search(settings=settings, run=SearchRun(lambda *step: signal.raise_signal(signal.SIGINT)))
    assert found.stopped == "interrupted"
    assert found.morphology.grid == 4
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_many_fibres_and_many_losses_are_scored_in_bounded_time():
    """Of 2M = 32 fibres taken 8 at a time there are ten million losses: a sample stands for them."""
    terms = score(Morphology.straight(16), Contact(), lost=8)
    assert 0 < terms["ambiguity_lost_0"] <= terms["ambiguity_lost_8"]


class KilledError(Exception):
    """Stands for a kill in mid-search."""


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_broken_off_anywhere_and_resumed_is_as_unbroken(method, tmp_path):
    """The report raises, as a kill would end it, again and again; every attempt goes on from the last state."""
    settings = SMALL.model_copy(update={"method": method, "generations": 6, "steps": 75})
    whole, kills = search(settings=settings), 0

    def attempt():
        heard = []

        def report(*step):
            heard.append(step)
            if len(heard) == 2:
                raise KilledError

        return search(settings=settings, run=SearchRun(report, tmp_path / "search", resume=True))

    while kills < 100:
        try:
            broken = attempt()
            break
        except KilledError:
            kills += 1
    else:
        pytest.fail("it does not get on")
    assert kills > 0
    assert broken.morphology == whole.morphology
    assert broken.history == whole.history
    assert broken.violations == whole.violations
    assert not (tmp_path / "search").exists()


def test_resuming_with_other_settings_is_refused_and_names_what_differs(tmp_path):
    problem = SearchProblem(PadSettings(), (Contact(),), SMALL, QUICK)
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    other = SMALL.model_copy(update={"seed": 5})
    with pytest.raises(InputError, match="begun with search seed 0, now 5"):
        search(settings=other, rules=QUICK, run=SearchRun(keep_in=tmp_path / "search", resume=True))


def test_a_damaged_state_is_named(tmp_path):
    problem = SearchProblem(PadSettings(), (Contact(),), SMALL, QUICK)
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    path = tmp_path / "search" / "start_0000.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"start_0000\.npz: cannot be read"):
        search(settings=SMALL, rules=QUICK, run=SearchRun(keep_in=tmp_path / "search", resume=True))


def test_a_state_that_is_not_as_it_was_written_is_refused(tmp_path):
    problem = SearchProblem(PadSettings(), (Contact(),), SMALL, QUICK)
    path = tmp_path / "search" / "start_0000.npz"
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    with np.load(path) as arrays:
        state = {name: arrays[name] for name in arrays.files}
    np.savez(path, allow_pickle=False, **state | {"done": np.array([1, 2])})
    with pytest.raises(InputError, match=r"start_0000\.npz: cannot be read \(it is not as it was written\)"):
        search(settings=SMALL, rules=QUICK, run=SearchRun(keep_in=tmp_path / "search", resume=True))


def test_a_state_of_another_start_is_refused(tmp_path):
    problem = SearchProblem(PadSettings(), (Contact(),), SMALL, QUICK)
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    (tmp_path / "search" / "start_0000.npz").rename(tmp_path / "search" / "start_0001.npz")
    with pytest.raises(InputError, match=r"start_0001\.npz: cannot be read \(it is not as it was written\)"):
        search(settings=SMALL, rules=QUICK, run=SearchRun(keep_in=tmp_path / "search", resume=True))


def test_a_generation_that_fits_no_memory_is_refused():
    settings = SearchSettings(method="genetic", population=100_000)
    with pytest.raises(InputError, match="population is 100000: that takes"):
        search(settings=settings)


def test_the_executor_does_not_matter():
    with ThreadPoolExecutor(1) as one:
        assert search(settings=SMALL, run=SearchRun(executor=one)).morphology == search(settings=SMALL).morphology


def test_a_time_budget_ends_it_with_the_best_so_far():
    settings = SMALL.model_copy(update={"steps": 1_000_000})
    found = search(settings=settings, run=SearchRun(time_budget=1.0))
    assert found.stopped == "out of time"
    assert found.violations == []
    assert found.seconds < 30


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_slow_steps_come_in_shorter_slices_to_the_same_result(method, monkeypatch):
    settings = SMALL.model_copy(update={"method": method, "steps": 30, "generations": 4, "starts": 1})
    whole = search(settings=settings)
    monkeypatch.setattr("design.optimisers.start.SLICE_S", -1.0)
    assert advance_start(SearchProblem(PadSettings(), (Contact(),), settings, RulesSettings(), None), 0, None).step == 1
    assert search(settings=settings).morphology == whole.morphology


def test_a_search_stopped_before_anything_is_noted_gives_its_fibres(monkeypatch):
    monkeypatch.setattr("design.optimisers.start.SLICE_S", -1.0)
    found = search(settings=SMALL, run=SearchRun(time_budget=1e-6))
    assert found.stopped == "out of time"
    assert found.morphology.knots.shape == (8, 5, 2)
    assert search(settings=SMALL, run=SearchRun(time_budget=0.5)).stopped == "out of time"


def test_a_search_from_a_pad_improves_on_it():
    origin = search(settings=SearchSettings(knots=5, starts=1, steps=60, lost=1, seed=3)).morphology
    before = score(origin, Contact(), lost=1)
    after = search(settings=SearchSettings(knots=8, starts=1, steps=150, lost=1), origin=origin)
    assert after.morphology.knots.shape == (8, 10, 2)
    assert after.terms["ambiguity_lost_0"] + after.terms["ambiguity_lost_1"] < (
        before["ambiguity_lost_0"] + before["ambiguity_lost_1"]
    )


def test_an_origin_that_nothing_found_surpasses_comes_back(monkeypatch):
    free = RulesSettings(enforce=False)
    origin = search(settings=SMALL, rules=free).morphology
    monkeypatch.setattr(sys.modules["design.optimisers.search"], "_candidates", lambda *_: [Morphology.straight(4)])
    assert search(settings=SMALL, rules=free, origin=origin).morphology == origin
    assert search(settings=SMALL, rules=free).morphology == Morphology.straight(4)


def test_an_origin_that_does_not_fit_is_refused():
    with pytest.raises(InputError, match="the morphology to start from has grid 3, allowed is that of the pad, 4"):
        search(settings=SMALL, origin=Morphology.straight(3))
    with pytest.raises(InputError, match="knots is 3, allowed is at least the 7"):
        search(settings=SMALL, origin=Morphology.random(4, 7))


def test_several_contacts_serve_both_better_than_one_alone():
    one = SearchSettings(starts=1, steps=200, lost=0, knots=9)
    large = Contact(radius=1.2)
    both = one.model_copy(update={"contacts": (large,)})
    for_one, for_both = search(settings=one), search(settings=both)
    alone, together = (score(found.morphology, large, lost=0)["ambiguity_lost_0"] for found in (for_one, for_both))
    assert together < alone


def test_a_device_that_is_not_there_is_refused():
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one here")
    with pytest.raises(InputError, match="device is 'cuda'"):
        search(settings=SMALL.model_copy(update={"device": "cuda"}))


@pytest.mark.parametrize(
    ("rules", "resists"),
    [
        ({"min_gap_mm": 30.0}, "min_gap_mm"),
        ({"min_bend_radius_mm": 900.0, "min_gap_mm": 11.2, "border_mm": 12.0}, "border_mm"),
        ({"max_crossings": 3}, "max_crossings"),
        ({"border_mm": 500.0}, "border_mm"),
    ],
)
def test_rules_that_cannot_be_met_end_with_what_resists(rules, resists):
    found = search(settings=SMALL.model_copy(update={"starts": 1}), rules=RulesSettings(**rules))
    assert resists in {violation.rule for violation in found.violations}
    assert all(np.isfinite(violation.measured) for violation in found.violations)


@pytest.mark.parametrize(
    "rules",
    [{"max_crossings": 24}, {"min_crossing_angle_deg": 50.0}, {"min_gap_mm": 4.0}, {"max_length_mm": 65.0}],
)
def test_each_further_rule_is_kept(rules):
    found = search(settings=SearchSettings(starts=1, steps=150, lost=1, knots=9), rules=RulesSettings(**rules))
    assert found.violations == []


def test_a_loss_of_every_fibre_is_refused():
    with pytest.raises(InputError, match="leaves some of the 2 fibres"):
        search(PadSettings(grid=1), settings=SearchSettings(lost=(0.0, 0.0, 1.0)))
