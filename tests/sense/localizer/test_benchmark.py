"""The localizer benchmark. No times are asserted."""

import pytest

from padforge.benchmarks import harness
from padforge.benchmarks import localizer as bench


@pytest.mark.slow
def test_every_way_trains_and_has_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"PRESSES": 150, "TEST": 30, "EPOCHS": (1, 3), "ITERATIONS": (3, 20), "PASSES": (1,), "STEPS": (3,)}
    for name, value in (small | {"HIDDEN": 6, "FEATURES": ("published", "press_and_release")}).items():
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    bench.recorded.cache_clear()
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    bench.recorded.cache_clear()
    errors = {key[:3]: row["error"] for key, row in measured.results.items() if row}
    assert len(errors) == 2 + 4 + 4 + 2 - 2  # LM learns from published inputs alone; two only find one press
    assert all(0 < error < 30 for error in errors.values())  # mm on a pad of 34
