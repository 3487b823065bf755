"""Both searches: they improve, obey the rules, and depend on the seed alone."""

import signal

import pytest
import torch

from design import Contact, Morphology, search
from design.descent import ambiguity
from design.search import score
from design.settings import Pad, Rules, Search

SMALL = Search(knots=3, starts=2, steps=40, population=20, generations=5, lost=1)


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_the_same_seed_gives_the_same_fibres_and_another_seed_others(method):
    settings = SMALL.model_copy(update={"method": method})
    first, second = search(settings=settings), search(settings=settings)
    other = search(settings=settings.model_copy(update={"seed": 1}))
    assert first.morphology == second.morphology
    assert first.history == second.history
    assert first.morphology != other.morphology


def test_descent_beats_the_square_grid_within_the_rules():
    found = search(settings=Search(starts=1, steps=150, lost=1))
    grid = score(Morphology.straight(4), Contact(), lost=1)
    assert found.violations == []
    assert found.terms["ambiguity_lost_0"] < 0.5 * grid["ambiguity_lost_0"]
    assert found.terms["ambiguity_lost_1"] < 0.5 * grid["ambiguity_lost_1"]


def test_genetic_search_improves_generation_by_generation():
    found = search(settings=SMALL.model_copy(update={"method": "genetic"}), rules=Rules(enforce=False))
    best = [entry["objective"] for entry in found.history]
    assert best == sorted(best, reverse=True)
    assert found.terms["published_objective"] == pytest.approx(best[-1])
    assert found.violations == []


def test_rules_that_cannot_hold_are_named():
    found = search(settings=SMALL, rules=Rules(max_length_mm=20))
    assert {v.rule for v in found.violations} == {"max_length_mm"}
    assert len(found.violations) == 8


def test_small_and_odd_pads_are_searched_too():
    for grid, pitch in ((1, 20.0), (2, 5.0)):
        found = search(Pad(grid=grid, pitch_mm=pitch), settings=SMALL)
        assert found.morphology.grid == grid
        assert found.morphology.pitch_mm == pitch


def test_ambiguity_of_presses_that_cannot_be_told_apart_is_their_mean_distance():
    presses = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    kept = torch.ones(1, 3)
    blind = ambiguity(torch.zeros(3, 2), presses, kept, sigma=0.1)
    assert blind.item() == pytest.approx(0.5)
    sharp = ambiguity(torch.tensor([[0.0, 9.0]] * 3), presses, kept, sigma=0.1)
    assert sharp.item() == pytest.approx(0, abs=1e-6)


def test_a_lost_fibre_tells_nothing():
    presses = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    signals = torch.tensor([[0.0, 9.0], [0.0, 0.0]])
    kept = torch.tensor([[0.0, 1.0]])
    assert ambiguity(signals, presses, kept, sigma=0.1).item() == pytest.approx(0.5)


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_ctrl_c_keeps_the_best_so_far(method):
    """The signal comes from the first report; what was found by then is returned, and says so."""
    settings = SMALL.model_copy(update={"method": method, "steps": 100_000, "generations": 100_000})
    found = search(settings=settings, report=lambda *step: signal.raise_signal(signal.SIGINT))
    assert found.interrupted
    assert found.morphology.grid == 4
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_many_fibres_and_many_losses_are_scored_in_bounded_time():
    """Of 2M = 32 fibres taken 8 at a time there are ten million losses: a sample stands for them."""
    terms = score(Morphology.straight(16), Contact(), lost=8)
    assert 0 < terms["ambiguity_lost_0"] <= terms["ambiguity_lost_8"]
