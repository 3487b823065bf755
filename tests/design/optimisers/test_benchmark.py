"""The bench of the searches: every way, budget and seed, judged by the errors of the pads found."""

import numpy as np
import pytest

from design.evaluation.localisation_error import LossError
from design.optimisers import benchmark as search
from design.optimisers.search import SearchResult
from design.pad.morphology import Morphology as Pad
from design.settings import PUBLISHED_PAD, SearchSettings


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    for name, value in {"KNOTS": (3,), "SEEDS": (0, 1), "GENERATIONS": (1,), "STEPS": (1, 2)}.items():
        monkeypatch.setattr(search, name, value)


def test_the_search_bench_has_every_way_budget_and_seed(monkeypatch, taken):
    asked = []

    def searched(pad, contact, settings, rules, run):
        asked.append((settings.method, settings.generations + settings.steps, settings.seed, rules.enforce))
        return SearchResult(Pad.straight(pad.grid), {}, [], "start 1", {})

    levels = [LossError(k, 1, mean, 0, mean) for k, mean in enumerate([0.1, 0.2, 0.3, 0.8])]
    monkeypatch.setattr(search, "search", searched)
    monkeypatch.setattr(search, "localisation_error", lambda *_, **__: levels)
    found = taken(search.BENCH)

    ways = [("genetic", 1), ("descent", 1), ("with rules", 1), ("descent", 2), ("with rules", 2)]
    assert list(found) == [("N=3", *way, seed) for way in ways for seed in (0, 1)]
    enforced = [(method, seed, rules) for method, _, seed, rules in asked[::2]]  # each is called twice
    names = [way.replace("with rules", "descent") for way, _ in ways]
    expected = [(n, seed, w == "with rules") for n, (w, _) in zip(names, ways, strict=True) for seed in (0, 1)]
    assert enforced == expected
    for row in found.values():
        assert row["error"] == pytest.approx(0.35)
        assert [row[f"lost_{k}"] for k in range(4)] == [0.1, 0.2, 0.3, 0.8]
        assert row["violations"] == 0


def test_a_search_is_the_same_in_this_thread(monkeypatch):
    monkeypatch.setattr(search, "GENERATIONS", (2,))
    trial = next(iter(search.trials()))
    settings = SearchSettings(method="genetic", generations=2, knots=3, seed=0)
    again = search.search(PUBLISHED_PAD, settings=settings, rules=search.RulesSettings(enforce=False))
    np.testing.assert_array_equal(trial.work().morphology.knots, again.morphology.knots)
