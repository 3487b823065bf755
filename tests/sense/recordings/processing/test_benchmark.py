"""The filter bench: its ways find the same minimum, and errors are what they are said to be. No times are asserted."""

import numpy as np
import pytest

from design.benchmarking import harness
from sense.recordings.processing import benchmark as bench_filter
from sense.recordings.processing.benchmark import fibre, iterated, linear_program, objective
from sense.recordings.processing.filters import total_variation


def test_the_other_ways_find_the_same_minimum():
    _, y = fibre(400, np.random.default_rng(1))
    least = objective(y, total_variation(y, 4), 4)
    assert objective(y, linear_program(y, 4), 4) == pytest.approx(least, rel=1e-12)
    assert least <= objective(y, iterated(y, 4, 3000), 4) <= 1.0001 * least


def test_the_made_up_fibre_is_its_clean_signal_but_for_noise_and_outliers():
    clean, noisy = fibre(20_000, np.random.default_rng(2))
    off = (noisy - clean) / bench_filter._STEP_V
    assert np.median(np.abs(off)) < 2
    assert 0.003 < (np.abs(off) > 8).mean() < 0.02
    np.testing.assert_allclose(noisy / bench_filter._STEP_V, np.round(noisy / bench_filter._STEP_V), atol=1e-9)
    assert np.ptp(clean) > 0.09


def test_the_published_filter_is_at_the_minimum_and_iterations_come_near(monkeypatch):
    for name, value in {"READINGS": 600, "LONG": (700,), "STEPS": (10, 1000)}.items():
        monkeypatch.setattr(bench_filter, name, value)
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    measured = harness.BenchRounds()
    harness.measure_round(bench_filter.BENCH, measured, lambda step: None, lambda key: False)
    first = {key[1:3]: row for key, row in measured.found.items() if key[0] == "600 readings"}
    assert abs(first["robust", 4]["excess"]) < 1e-9
    assert abs(first["LP (HiGHS)", 4]["excess"]) < 1e-9
    assert first["iterative", 1000]["excess"] < first["iterative", 10]["excess"]
    assert first["median", 15]["excess"] is None
    assert first["robust", 4]["error"] < first["squares", 0.01]["error"] < 1  # outliers are what sets them apart
    assert len({key for key in measured.found if key[0] == "700 readings"}) == 4
