"""Both searches through their one face: they improve, obey the rules, stop, resume, and depend on the seed alone."""

import signal
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from design import Contact, InputError, Morphology
from design.common.checkpoints import Checkpoints
from design.criteria.score import AMBIGUITY_NOISE, ambiguities, ambiguity_terms, score
from design.evaluation.expected_error import error_terms, expected_errors
from design.optimisers.problem import SearchProblem
from design.optimisers.search import SearchRun, search
from design.optimisers.start import advance_start
from design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings

SMALL = SearchSettings(knots=3, starts=2, steps=30, population=20, generations=6, lost=1)
QUICK = RulesSettings(min_bend_radius_mm=0.5)
SEARCH = sys.modules["design.optimisers.search"]


@pytest.fixture(scope="module")
def small():
    """What a small search finds."""
    return search(contact=PUBLISHED_CONTACT, settings=SMALL)


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_the_same_seed_gives_the_same_fibres_and_another_seed_others(method, small):
    settings = SMALL.model_copy(update={"method": method})
    first = small if method == "descent" else search(contact=PUBLISHED_CONTACT, settings=settings)
    second = search(contact=PUBLISHED_CONTACT, settings=settings)
    other = search(contact=PUBLISHED_CONTACT, settings=settings.model_copy(update={"seed": 1}))
    assert first.morphology == second.morphology
    assert first.history == second.history
    assert first.morphology != other.morphology


def test_genetic_search_improves_generation_by_generation():
    found = search(settings=SMALL.model_copy(update={"method": "genetic"}), rules=RulesSettings(enforce=False))
    best = [entry["objective"] for entry in found.history]
    assert best == sorted(best, reverse=True)
    assert found.terms["published_objective"] == pytest.approx(best[-1])
    assert found.violations == []


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_ctrl_c_keeps_the_best_so_far(method):
    """The signal comes from the first report; what was found by then is returned, and says so."""
    settings = SMALL.model_copy(update={"method": method, "steps": 100_000, "generations": 100_000})
    found = search(
        contact=PUBLISHED_CONTACT, settings=settings, run=SearchRun(lambda *step: signal.raise_signal(signal.SIGINT))
    )
    assert found.stopped == "interrupted"
    assert found.morphology.grid == 4
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class KilledError(Exception):
    """Stands for a kill in mid-search."""


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_broken_off_anywhere_and_resumed_is_as_unbroken(method, tmp_path):
    """The report raises, as a kill would end it, again and again; every attempt goes on from the last state."""
    pad = PadSettings(grid=2)
    settings = SMALL.model_copy(update={"method": method})
    whole, kills = search(pad, PUBLISHED_CONTACT, settings=settings), 0

    def attempt():
        heard = []

        def report(*step):
            heard.append(step)
            if len(heard) == 2:
                raise KilledError

        return search(
            pad, PUBLISHED_CONTACT, settings=settings, run=SearchRun(report, tmp_path / "search", resume=True)
        )

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


def test_resuming_with_other_settings_is_refused_and_names_what_differs(tmp_path):
    problem = SearchProblem(PadSettings(), (PUBLISHED_CONTACT,), SMALL, QUICK)
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    other = SMALL.model_copy(update={"seed": 5})
    with pytest.raises(InputError, match="begun with search seed 0, now 5"):
        search(
            contact=PUBLISHED_CONTACT,
            settings=other,
            rules=QUICK,
            run=SearchRun(keep_in=tmp_path / "search", resume=True),
        )


def test_a_damaged_state_is_named(tmp_path):
    problem = SearchProblem(PadSettings(), (PUBLISHED_CONTACT,), SMALL, QUICK)
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    path = tmp_path / "search" / "start_0000.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"start_0000\.npz: cannot be read"):
        search(
            contact=PUBLISHED_CONTACT,
            settings=SMALL,
            rules=QUICK,
            run=SearchRun(keep_in=tmp_path / "search", resume=True),
        )


def test_a_state_that_is_not_as_it_was_written_is_refused(tmp_path):
    problem = SearchProblem(PadSettings(), (PUBLISHED_CONTACT,), SMALL, QUICK)
    path = tmp_path / "search" / "start_0000.npz"
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    with np.load(path) as arrays:
        state = {name: arrays[name] for name in arrays.files}
    np.savez(path, allow_pickle=False, **state | {"done": np.array([1, 2])})
    with pytest.raises(InputError, match=r"start_0000\.npz: cannot be read \(it is not as it was written\)"):
        search(
            contact=PUBLISHED_CONTACT,
            settings=SMALL,
            rules=QUICK,
            run=SearchRun(keep_in=tmp_path / "search", resume=True),
        )


def test_a_state_of_another_start_is_refused(tmp_path):
    problem = SearchProblem(PadSettings(), (PUBLISHED_CONTACT,), SMALL, QUICK)
    Checkpoints(tmp_path / "search", problem.settings()).save(0, advance_start(problem, 0, None).state)
    (tmp_path / "search" / "start_0000.npz").rename(tmp_path / "search" / "start_0001.npz")
    with pytest.raises(InputError, match=r"start_0001\.npz: cannot be read \(it is not as it was written\)"):
        search(
            contact=PUBLISHED_CONTACT,
            settings=SMALL,
            rules=QUICK,
            run=SearchRun(keep_in=tmp_path / "search", resume=True),
        )


def test_a_generation_that_fits_no_memory_is_refused():
    settings = SearchSettings(method="genetic", population=100_000)
    with pytest.raises(InputError, match="population is 100000: that takes"):
        search(contact=PUBLISHED_CONTACT, settings=settings)


def test_the_executor_does_not_matter(small):
    with ThreadPoolExecutor(1) as one:
        assert (
            search(contact=PUBLISHED_CONTACT, settings=SMALL, run=SearchRun(executor=one)).morphology
            == small.morphology
        )


def test_a_time_budget_ends_it_with_the_best_so_far():
    settings = SMALL.model_copy(update={"steps": 1_000_000})
    found = search(contact=PUBLISHED_CONTACT, settings=settings, run=SearchRun(time_budget=1.0))
    assert found.stopped == "out of time"
    assert found.violations == []
    assert found.seconds < 30


def test_a_search_stopped_before_anything_is_noted_gives_its_fibres(monkeypatch):
    monkeypatch.setattr("design.optimisers.start.SLICE_S", -1.0)
    found = search(contact=PUBLISHED_CONTACT, settings=SMALL, run=SearchRun(time_budget=1e-6))
    assert found.stopped == "out of time"
    assert found.morphology.knots.shape == (8, 5, 2)
    assert search(contact=PUBLISHED_CONTACT, settings=SMALL, run=SearchRun(time_budget=0.5)).stopped == "out of time"


def test_a_search_from_a_pad_improves_on_it():
    """Under the published contact and by no rules, where straight fibres are no match for curved ones."""
    pad, free = PadSettings(grid=2), RulesSettings(enforce=False)
    origin = search(pad, PUBLISHED_CONTACT, SMALL.model_copy(update={"steps": 10, "seed": 3}), free).morphology
    settings = SearchSettings(knots=5, starts=1, steps=80, lost=1)
    before = expected_errors(origin, PUBLISHED_CONTACT, settings, pad)
    after = search(pad, PUBLISHED_CONTACT, settings, free, origin=origin)
    assert after.morphology.knots.shape == (4, 7, 2)
    assert after.found_by == "start 1"
    # what is minimised: the geometric mean over the numbers of failed fibres
    assert after.terms["expected_error_lost_0"] * after.terms["expected_error_lost_1"] < 0.95 * np.prod(before)


def test_an_origin_that_nothing_found_surpasses_comes_back(monkeypatch):
    free, quick = RulesSettings(enforce=False), SMALL.model_copy(update={"steps": 10, "starts": 1})
    pad = PadSettings(sensed_mm="fibres")
    origin = search(pad, PUBLISHED_CONTACT, settings=quick, rules=free).morphology
    monkeypatch.setattr(SEARCH, "_found", lambda *_: [("start 1", Morphology.straight(4))])
    found = search(pad, PUBLISHED_CONTACT, settings=quick, rules=free, origin=origin)
    assert (found.morphology, found.found_by) == (origin, "origin")
    found = search(pad, PUBLISHED_CONTACT, settings=quick, rules=free).morphology
    assert np.ptp(found.knots[:4, :, 1], axis=1).tolist() == [0, 0, 0, 0]


def test_a_search_never_ends_worse_than_straight_fibres(monkeypatch):
    """But by the published method, which is left as it is."""
    worse, straight = Morphology.random(4, 3, seed=2), Morphology.straight(4)
    free, quick = (
        RulesSettings(enforce=False),
        SMALL.model_copy(update={"steps": 1, "starts": 1, "generations": 1, "noise": 0.11}),
    )
    monkeypatch.setattr(SEARCH, "_found", lambda *_: [("start 1", worse)])
    contact = Contact(reach=((0, 1), (5.6, 0.7), (11.2, 0.2), (18, 0)), length="manhattan")
    plain = expected_errors(straight, contact, quick, PadSettings())
    assert np.all(np.array(plain) < expected_errors(worse, contact, quick, PadSettings()))
    found = search(contact=contact, settings=quick, rules=free)
    assert found.found_by == "straight fibres"
    assert found.morphology.knots.shape == worse.knots.shape
    np.testing.assert_array_equal(found.morphology.knots[:4, :, 1], straight.knots[:4, :1, 1] + np.zeros(5))
    confused = ambiguities(straight, contact, quick.lost, AMBIGUITY_NOISE, PadSettings())
    assert found.straight == pytest.approx(error_terms(plain) | ambiguity_terms(confused), rel=1e-6)
    assert found.straight.items() <= found.terms.items()
    genetic = search(contact=contact, settings=quick.model_copy(update={"method": "genetic"}), rules=free)
    assert genetic.morphology == worse
    assert genetic.straight == found.straight


@pytest.mark.parametrize(("weight", "chosen"), [(0.0, "less error"), (1.5, "less sharp"), (10.0, "straight fibres")])
def test_sharpness_counts_in_the_choice_among_starts(weight, chosen, monkeypatch):
    """Straight fibres err most and are the least sharp here; the other two pads lie between them both ways."""
    pads = [("less error", Morphology.random(2, 3, seed=2)), ("less sharp", Morphology.random(2, 3, seed=5))]
    monkeypatch.setattr(SEARCH, "_found", lambda *_: pads)
    settings = SMALL.model_copy(update={"steps": 1, "starts": 1, "sharpness": weight})
    found = search(PadSettings(grid=2), PUBLISHED_CONTACT, settings, RulesSettings(enforce=False))
    assert found.found_by == chosen


def test_the_terms_of_what_is_found_are_its_scores():
    pad, contact = PadSettings(grid=2, sensed_mm=(20, 30)), Contact(radius=0.9)
    settings = SearchSettings(knots=3, starts=1, steps=5, lost=1, noise=0.03)
    found = search(pad, contact, settings, QUICK)
    expected, plain = (
        error_terms(expected_errors(each, contact, settings, pad))
        for each in (found.morphology, Morphology.straight(2))
    )
    assert found.terms == score(found.morphology, contact, 1, 0.05, QUICK, pad) | expected
    confused = ambiguity_terms(ambiguities(Morphology.straight(2), contact, 1, 0.05, pad))
    assert found.straight == pytest.approx(plain | confused, rel=1e-6)


def test_a_search_for_the_least_expected_error_finds_less_than_straight_fibres_have():
    """The wide reach is that of a built pad; what is found is judged by what is searched for."""
    settings = SearchSettings(knots=5, starts=1, steps=50, lost=(0, 0, 1))
    found = search(PadSettings(grid=3), None, settings, RulesSettings(enforce=False))
    errors = expected_errors(found.morphology, Contact(), settings, PadSettings(grid=3))
    assert [found.terms[f"expected_error_lost_{lost}"] for lost in range(3)] == errors
    assert errors[2] < 0.97 * found.straight["expected_error_lost_2"]


def test_an_origin_that_does_not_fit_is_refused():
    with pytest.raises(InputError, match=r"to start from has 3 \+ 3 fibres, .*, allowed is the pad.s, 4 \+ 4 fibres"):
        search(contact=PUBLISHED_CONTACT, settings=SMALL, origin=Morphology.straight(3))
    with pytest.raises(InputError, match="knots is 3, allowed is at least the 7"):
        search(contact=PUBLISHED_CONTACT, settings=SMALL, origin=Morphology.random(4, 7))


def test_a_device_that_is_not_there_is_refused():
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one here")
    with pytest.raises(InputError, match="device is 'cuda'"):
        search(contact=PUBLISHED_CONTACT, settings=SMALL.model_copy(update={"device": "cuda"}))


def test_a_loss_of_every_fibre_is_refused():
    with pytest.raises(InputError, match="leaves some of the 2 fibres"):
        search(PadSettings(grid=1), settings=SearchSettings(lost=(0.0, 0.0, 1.0)))
