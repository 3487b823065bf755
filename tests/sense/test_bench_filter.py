"""The filter bench: its ways find the same minimum, and its files hold what they say. No times are asserted."""

import csv
import json

import numpy as np
import pytest

from design.bench_table import lines
from sense import bench_filter
from sense.bench_filter import fibre, iterated, linear_program, objective
from sense.filters import total_variation


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


def test_the_bench_writes_its_table_and_figure(monkeypatch, tmp_path):
    for name, value in {"READINGS": 600, "LONG": (700,), "STEPS": (10, 1000)}.items():
        monkeypatch.setattr(bench_filter, name, value)
    heard = []
    document = bench_filter.bench_filter(tmp_path, heard.append)
    assert heard
    assert json.loads((tmp_path / "filter.json").read_text()) == document
    rows = document["rows"]
    with (tmp_path / "filter.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    assert (tmp_path / "filter.png").read_bytes().startswith(b"\x89PNG")
    assert len(lines(document)) == len(rows) + 3
    first = {(row["way"], row["size"]): row for row in rows if row["case"] == "600 readings"}
    assert first["robust", 4]["excess"] < 1e-9
    assert first["LP (HiGHS)", 4]["excess"] < 1e-9
    assert first["LP (HiGHS)", 4]["speed"] == 1
    assert first["iterative", 1000]["excess"] < first["iterative", 10]["excess"]
    assert first["median", 15]["excess"] is None
    assert first["robust", 4]["error"] < first["squares", 0.01]["error"] < 1  # outliers are what sets them apart
