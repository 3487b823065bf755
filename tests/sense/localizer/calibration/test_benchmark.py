"""The localizer bench: it holds every way, and its networks are those they stand for. No times are asserted."""

import numpy as np
import pytest

from design.benchmarking import harness
from sense.localizer.calibration import benchmark as bench


def test_every_way_learns_and_is_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"PRESSES": 150, "TEST": 30, "EPOCHS": (1, 3), "ITERATIONS": (3, 40), "PASSES": (1,), "STEPS": (3,)}
    for name, value in (small | {"HIDDEN": 6, "FEATURES": ("published", "full")}).items():
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    bench._recording.cache_clear()
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    bench._recording.cache_clear()
    rest = [("L-BFGS", 3), ("L-BFGS", 40), ("Adam", 1), ("masked", 3)]
    assert [key[:3] for key in measured.found] == [
        *(("published", *way) for way in [("LM", 1), ("LM", 3), *rest]),
        *(("full", *way) for way in rest),
        ("one press", "published", 0),
        ("one press", "masked", 0),
    ]
    errors = {key[:3]: row["error"] for key, row in measured.found.items() if row}
    assert all(0 < error < 30 for error in errors.values())  # mm on a pad of 34


def test_slopes_are_those_of_the_error() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((20, 4)), rng.standard_normal((20, 2))
    network = bench._Published(x, y)
    at = network.slope().item()
    assert at == pytest.approx(np.mean((network(x) - y) ** 2))
    slope, step = network.weights[0].grad[2, 1].item(), 1e-6  # type: ignore[index]
    network.weights[0].data[2, 1] += step
    assert (network.slope().item() - at) / step == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("way", [bench._bfgs, bench._adam])
def test_more_steps_come_nearer_to_what_is_learnt(way) -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (200, 2))
    y = np.column_stack([x[:, 0] * x[:, 1], np.sin(2 * x[:, 0])])
    few, many = (np.mean((way(x, y, steps)(x) - y) ** 2) for steps in (2, 60))
    assert many < 0.2 * few
