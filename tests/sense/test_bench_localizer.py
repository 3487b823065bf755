"""The localizer bench: its files hold every way, and its networks are those they stand for. No times are asserted."""

import json

import numpy as np
import pytest

from design.bench_table import lines
from sense import bench_localizer as bench


def test_the_bench_writes_its_table_and_figure(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    small = {"PRESSES": 150, "TEST": 30, "EPOCHS": (1, 3), "ITERATIONS": (3, 40), "PASSES": (1,), "STEPS": (3,)}
    for name, value in (small | {"HIDDEN": 6, "FEATURES": ("published", "full")}).items():
        monkeypatch.setattr(bench, name, value)
    heard = []
    document = bench.bench_localizer(tmp_path, heard.append)
    assert json.loads((tmp_path / "localizer.json").read_text()) == document
    assert (tmp_path / "localizer.png").read_bytes().startswith(b"\x89PNG")
    found = [(row["case"], row["way"], row["size"]) for row in document["rows"]]
    rest = [("L-BFGS", 3), ("L-BFGS", 40), ("Adam", 1), ("masked", 3)]
    assert found == [
        *(("published", *way) for way in [("LM", 1), ("LM", 3), *rest]),
        *(("full", *way) for way in rest),
        ("one press", "published", 0),
        ("one press", "masked", 0),
    ]
    assert len(heard) == 10
    assert len(lines(document)) == len(found) + 3
    assert all(row["seconds"] > 0 for row in document["rows"])


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
