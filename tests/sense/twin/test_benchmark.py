"""The twin benchmark. No times are asserted."""

import pytest

from padforge.benchmarks import harness
from padforge.benchmarks import twin as bench


@pytest.mark.slow
def test_twin_predicts_better_than_baselines(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"PRESSES": (250,), "GRID": 2, "KNOTS": 3, "WORLDS": {"small": ("gaussian", 0.5, 1)}}
    for name, value in small.items():
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    for cached in (bench.printed, bench.recorded):
        cached.cache_clear()
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    results = {key[1]: row for key, row in measured.results.items()}
    for cached in (bench.printed, bench.recorded):
        cached.cache_clear()
    assert list(results) == ["twin", "plan", "place"]
    assert results["twin"]["right"] == 1.0
    assert results["twin"]["error"] < min(results["place"]["error"], results["plan"]["error"])
