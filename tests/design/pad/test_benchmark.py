"""The contact bench: the ways it compares agree, and what it finds is what it is said to be."""

import numpy as np
import pytest

from design import Morphology, signals_quantized
from design.pad import benchmark as contact
from design.settings import PUBLISHED_CONTACT


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    for name, value in {"SAMPLES": (250, 2000), "KNOTS": (2,), "GRIDS": (4,)}.items():
        monkeypatch.setattr(contact, name, value)


def test_the_ways_compared_are_the_same_rule():
    pad = Morphology.random(3, 4, seed=1)
    presses = np.random.default_rng(0).uniform(0.5, 3.5, (10, 2))
    expected = signals_quantized(pad, presses, samples=700)
    np.testing.assert_allclose(contact.plain_signals(pad, presses, PUBLISHED_CONTACT, 700), expected, atol=1e-12)
    np.testing.assert_allclose(contact.scanned_signals(pad.knots, presses, 0.6, 30, 700), expected, atol=1e-12)


def test_contact_errors_fall_with_the_samples_and_the_exact_signals_have_none(taken):
    found = taken(contact.BENCH)
    for way in ("plain", "scanned", "culled"):
        assert found["N=2", way, 2000, 0]["error"] < found["N=2", way, 250, 0]["error"]
        assert found["N=2", way, 250, 0]["error"] == pytest.approx(found["N=2", "plain", 250, 0]["error"], rel=1e-9)
    exact = found["N=2", "exact", 0, 0]
    assert exact["error"] < 1e-9
    assert 0 < exact["visited"] < 1
    assert 0 < found["grid 4, a press", "exact", 0, 0]["visited"] < 1
