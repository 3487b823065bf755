"""The twin bench: it holds every way, and judges what it was told to. No times are asserted."""

import pytest

from padforge.benchmarks import harness
from padforge.benchmarks import twin as bench


@pytest.mark.slow
def test_every_way_predicts_and_the_twin_does_it_best(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"PRESSES": (250,), "GRID": 2, "KNOTS": 3, "WORLDS": {"small": ("gaussian", 0.5, 1)}}
    for name, value in small.items():
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    for kept in (bench.printed, bench.recorded):
        kept.cache_clear()
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    found = {key[1]: row for key, row in measured.found.items()}
    for kept in (bench.printed, bench.recorded):
        kept.cache_clear()
    assert list(found) == ["twin", "plan", "place"]
    assert found["twin"]["right"] == 1.0
    assert found["twin"]["error"] < min(found["place"]["error"], found["plan"]["error"])
