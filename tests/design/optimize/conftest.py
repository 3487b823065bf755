"""Scores that cost less, of which no test of a search wants more."""

from functools import partial

import pytest

from padforge.design.objectives.published import information


@pytest.fixture(autouse=True)
def few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bound the information by the cells of a coarse grid: pairs of cells of the usual one take most of a score."""
    monkeypatch.setattr("padforge.design.objectives.published.information", partial(information, side=5))
