"""The localizer bench: it holds every way, and its networks are those they stand for. No times are asserted."""

import numpy as np
import pytest

from design.benchmarking import harness
from sense.localizer.calibration import benchmark as bench


@pytest.mark.slow
def test_every_way_learns_and_is_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"PRESSES": 150, "TEST": 30, "EPOCHS": (1, 3), "ITERATIONS": (3, 20), "PASSES": (1,), "STEPS": (3,)}
    for name, value in (small | {"HIDDEN": 6, "FEATURES": ("published", "full")}).items():
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    bench._recording.cache_clear()
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    bench._recording.cache_clear()
    errors = {key[:3]: row["error"] for key, row in measured.found.items() if row}
    assert len(errors) == 2 + 4 + 4 + 2 - 2  # LM learns from published inputs alone; two only find one press
    assert all(0 < error < 30 for error in errors.values())  # mm on a pad of 34


def test_slopes_are_those_of_the_error_and_steps_along_them_lower_it() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((20, 4)), rng.standard_normal((20, 2))
    network = bench._Published(x, y)
    at = network.slope().item()
    assert at == pytest.approx(np.mean((network(x) - y) ** 2))
    slope, step = network.weights[0].grad[2, 1].item(), 1e-6  # type: ignore[index]
    network.weights[0].data[2, 1] += step
    assert (network.slope().item() - at) / step == pytest.approx(slope, rel=1e-3)
    few, many = (np.mean((bench._adam(x, y, steps)(x) - y) ** 2) for steps in (1, 20))
    assert many < few
