"""The benches: the ways they compare agree, and their files hold what they say. No times are asserted."""

import csv
import json

import numpy as np
import pytest

from design import Contact, Morphology, bench, bench_search, published_objective, signals_quantized
from design.bench_table import Row, lines, write_bench
from design.evaluation import LossError
from design.search import SearchResult
from design.settings import Rules, Search


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


def test_a_table_shows_the_median_of_repetitions_and_the_file_all(tmp_path):
    rows = [Row("a", "slow", 1, error, time, None) for error, time in ((0.1, 2.0), (0.3, 9.0), (0.2, 4.0))]
    document = write_bench("x", rows, tmp_path, "error", ("slow", 1))
    assert [row["speed"] for row in document["rows"]] == [2.0, pytest.approx(4 / 9), 1.0]
    assert lines(document)[3:] == [f"{'a':<20} {'slow':<13} {1:>7} {'0.200':>9} {'4.00 s':>10} {'1.00x':>8} {'-':>8}"]


def test_the_search_bench_holds_every_way_budget_and_seed(monkeypatch, tmp_path):
    asked = []

    def search(pad, contact, settings, rules):
        asked.append((settings.method, settings.knots, settings.seed, rules.enforce))
        return SearchResult(Morphology.straight(pad.grid), {}, [], seconds=settings.generations + settings.steps)

    levels = [LossError(k, 1, mean, 0, mean) for k, mean in enumerate([0.1, 0.2, 0.3, 0.8])]
    small = {"KNOTS": (3,), "SEEDS": (0, 1), "GENERATIONS": (1,), "STEPS": (1, 2)}
    for name, value in {**small, "search": search, "evaluate": lambda *_, **__: levels}.items():
        monkeypatch.setattr(bench_search, name, value)
    document = bench_search.bench_search(tmp_path, lambda step: None)

    assert json.loads((tmp_path / "search.json").read_text()) == document
    ways = [("genetic", 1), ("descent", 1), ("with rules", 1), ("descent", 2), ("with rules", 2)]
    rows = [(row["way"], row["size"], row["seed"]) for row in document["rows"]]
    assert rows == [(*way, seed) for way in ways for seed in (0, 1)]
    measured = asked[3:]  # each way once before the clock
    assert measured == [
        (way.replace("with rules", "descent"), 3, seed, way == "with rules") for way, _ in ways for seed in (0, 1)
    ]
    for row in document["rows"]:
        assert row["case"] == "N=3"
        assert row["error"] == pytest.approx(0.35)
        assert [row[f"lost_{k}"] for k in range(4)] == [0.1, 0.2, 0.3, 0.8]
    with (tmp_path / "search.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(document["rows"])
    assert (tmp_path / "search.png").read_bytes().startswith(b"\x89PNG")
    assert len(lines(document)) == len(ways) + 3


def test_a_search_is_measured_on_the_pad_it_found(monkeypatch):
    monkeypatch.setattr(bench_search, "SUBSETS", 1)
    settings = Search(method="genetic", knots=1, population=4, generations=1, seed=5)
    row = bench_search._row("N=1", "genetic", 1, settings, Rules(enforce=False))
    assert (row.seed, row.size) == (5, 1)
    assert row.seconds > 0
    assert row.violations > 0  # random fibres of one family cross
    levels = [row.lost_0, row.lost_1, row.lost_2, row.lost_3]
    assert row.error == pytest.approx(np.mean(levels))
    assert 0.05 < levels[0] < levels[3] < 1.5
