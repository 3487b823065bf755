"""The contact bench: the ways it compares agree, and what it finds is what it is said to be."""

import pytest

from design.pad import benchmark as contact


@pytest.mark.slow
def test_the_ways_compared_are_the_same_rule_and_the_exact_signals_have_no_error(taken, monkeypatch):
    for name, value in {"SAMPLES": (250, 2000), "KNOTS": (2,), "GRIDS": (4,)}.items():
        monkeypatch.setattr(contact, name, value)
    found = taken(contact.BENCH)
    for way in ("plain", "scanned", "culled"):
        assert found["N=2", way, 2000, 0]["error"] < found["N=2", way, 250, 0]["error"]
        assert found["N=2", way, 250, 0]["error"] == pytest.approx(found["N=2", "plain", 250, 0]["error"], rel=1e-9)
    exact = found["N=2", "exact", 0, 0]
    assert exact["error"] < 1e-9
    assert 0 < exact["visited"] < 1
    assert 0 < found["grid 4, a press", "exact", 0, 0]["visited"] < 1
