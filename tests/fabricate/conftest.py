"""Figures instead of the files that they would be written to."""

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """Figures that would have been written."""
    saved: list[Figure] = []
    monkeypatch.setattr("padforge.design.common.plotting.save_figure", lambda figure, *_: saved.append(figure))
    return saved
