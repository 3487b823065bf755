"""The benches: the ways they compare agree, and their files hold what they say. No times are asserted."""

import csv
import json

import numpy as np
import pytest

from design import Contact, Morphology, bench, published_objective, signals_quantized
from design.bench_table import Row, lines, write_bench


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(bench, "SAMPLES", (250, 2000))
    monkeypatch.setattr(bench, "KNOTS", (2,))
    monkeypatch.setattr(bench, "GRIDS", (4,))


def test_the_ways_compared_are_the_same_rule():
    pad = Morphology.random(3, 4, seed=1)
    presses = np.random.default_rng(0).uniform(0.5, 3.5, (10, 2))
    expected = signals_quantized(pad, presses, samples=700)
    np.testing.assert_allclose(bench.plain_signals(pad, presses, Contact(), 700), expected, atol=1e-12)
    np.testing.assert_allclose(bench.scanned_signals(pad.knots, presses, 0.6, 30, 700), expected, atol=1e-12)
    assert bench.plain_objective(pad) == pytest.approx(published_objective(pad), abs=1e-12)


@pytest.mark.parametrize("name", ["contact", "objective"])
def test_a_bench_writes_its_table_and_figure(small, tmp_path, name):
    heard = []
    document = getattr(bench, f"bench_{name}")(tmp_path, heard.append)
    assert heard
    assert json.loads((tmp_path / f"{name}.json").read_text()) == document
    with (tmp_path / f"{name}.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(document["rows"])
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert len(lines(document)) == len(document["rows"]) + 3
    errors = {(row["way"], row["size"]): row["error"] for row in document["rows"] if row["error"] is not None}
    assert errors.get(("exact", 0), 0) < 1e-9
    assert errors["plain", 2000] < errors["plain", 250]


def test_speed_is_relative_to_the_reference_of_the_same_case(tmp_path):
    rows = [Row("a", "slow", 1, 0.1, 2.0, 1.0), Row("a", "fast", 1, 0.1, 0.5, 0.1), Row("b", "fast", 1, None, 1.0, 0.1)]
    document = write_bench("x", rows, tmp_path, "error", ("slow", 1))
    assert [row["speed"] for row in document["rows"]] == [1.0, 4.0, None]
