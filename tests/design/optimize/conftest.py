"""Scores that cost less, of which no test of a search wants more."""

from functools import partial

import pytest

from padforge.design.published.objective import information


@pytest.fixture(autouse=True)
def little_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Information is bounded by the cells of a coarse grid."""
    monkeypatch.setattr("padforge.design.published.objective.information", partial(information, side=5))
