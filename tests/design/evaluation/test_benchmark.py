"""The networks' bench: both ways train the same networks."""

import pytest

from design.evaluation import benchmark as networks


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    for name, value in {"SETS": 2, "HIDDEN": 4, "EPOCHS": 3}.items():
        monkeypatch.setattr(networks, name, value)


def test_both_ways_train_networks_for_the_same_losses(taken):
    found = taken(networks.BENCH)
    assert list(found) == [(case, way, 0, 0) for case in ("square", "random N=5") for way in ("batched", "plain numpy")]
    assert all(0.01 < row["error"] < 2 for row in found.values())
