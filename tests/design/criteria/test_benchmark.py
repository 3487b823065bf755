"""The objective's bench: both ways compute the same, nearer to the exact one with more samples."""

import pytest

from design import Morphology, published_objective
from design.criteria import benchmark as objective


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    for name, value in {"SAMPLES": (250, 2000), "KNOTS": (2,)}.items():
        monkeypatch.setattr(objective, name, value)


def test_the_ways_compared_are_the_same_objective():
    pad = Morphology.random(3, 4, seed=1)
    assert objective.plain_objective(pad) == pytest.approx(published_objective(pad), abs=1e-12)


def test_objectives_come_nearer_to_the_exact_one(taken):
    found = taken(objective.BENCH)
    for way in ("plain", "compiled"):
        assert 0 < found["N=2", way, 2000, 0]["error"] < found["N=2", way, 250, 0]["error"] < 0.1
