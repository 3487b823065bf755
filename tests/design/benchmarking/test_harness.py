"""The benches of design: the ways they compare agree, and what they find is what it is said to be."""

import numpy as np
import pytest

from design import Contact, Morphology, published_objective, signals_quantized
from design.benchmarking import harness
from design.criteria import benchmark as objective
from design.evaluation import benchmark as networks
from design.evaluation.localisation_error import LossError
from design.optimisers import benchmark as search
from design.optimisers.search import SearchResult
from design.pad import benchmark as contact
from design.pad.morphology import Morphology as Pad


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    for module, sizes in {
        contact: {"SAMPLES": (250, 2000), "KNOTS": (2,), "GRIDS": (4,)},
        objective: {"SAMPLES": (250, 2000), "KNOTS": (2,)},
        search: {"KNOTS": (3,), "SEEDS": (0, 1), "GENERATIONS": (1,), "STEPS": (1, 2)},
        networks: {"SETS": 2, "HIDDEN": 4, "EPOCHS": 3},
    }.items():
        for name, value in sizes.items():
            monkeypatch.setattr(module, name, value)


def taken(bench):
    measured = harness.BenchRounds()
    harness.measure_round(bench, measured, lambda step: None, lambda key: False)
    return measured.found


def test_the_ways_compared_are_the_same_rule():
    pad = Morphology.random(3, 4, seed=1)
    presses = np.random.default_rng(0).uniform(0.5, 3.5, (10, 2))
    expected = signals_quantized(pad, presses, samples=700)
    np.testing.assert_allclose(contact.plain_signals(pad, presses, Contact(), 700), expected, atol=1e-12)
    np.testing.assert_allclose(contact.scanned_signals(pad.knots, presses, 0.6, 30, 700), expected, atol=1e-12)
    assert objective.plain_objective(pad) == pytest.approx(published_objective(pad), abs=1e-12)


def test_contact_errors_fall_with_the_samples_and_the_exact_signals_have_none():
    found = taken(contact.BENCH)
    for way in ("plain", "scanned", "culled"):
        assert found["N=2", way, 2000, 0]["error"] < found["N=2", way, 250, 0]["error"]
        assert found["N=2", way, 250, 0]["error"] == pytest.approx(found["N=2", "plain", 250, 0]["error"], rel=1e-9)
    exact = found["N=2", "exact", 0, 0]
    assert exact["error"] < 1e-9
    assert 0 < exact["visited"] < 1
    assert 0 < found["grid 4, a press", "exact", 0, 0]["visited"] < 1


def test_objectives_come_nearer_to_the_exact_one():
    found = taken(objective.BENCH)
    for way in ("plain", "compiled"):
        assert 0 < found["N=2", way, 2000, 0]["error"] < found["N=2", way, 250, 0]["error"] < 0.1


def test_the_search_bench_has_every_way_budget_and_seed(monkeypatch):
    asked = []

    def searched(pad, contact, settings, rules, run):
        asked.append((settings.method, settings.generations + settings.steps, settings.seed, rules.enforce))
        return SearchResult(Pad.straight(pad.grid), {}, [])

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
    settings = search.SearchSettings(method="genetic", generations=2, knots=3, seed=0)
    again = search.search(search.PadSettings(), search.Contact(), settings, search.RulesSettings(enforce=False))
    np.testing.assert_array_equal(trial.work().morphology.knots, again.morphology.knots)


def test_both_ways_train_networks_for_the_same_losses():
    found = taken(networks.BENCH)
    assert list(found) == [(case, way, 0, 0) for case in ("square", "random N=5") for way in ("batched", "plain numpy")]
    assert all(0.01 < row["error"] < 2 for row in found.values())
