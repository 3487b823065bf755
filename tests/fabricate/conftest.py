"""Figures instead of the files that they would be written to, and moulds without a drawing that no test looks at."""

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """Figures that would have been written."""
    saved: list[Figure] = []
    monkeypatch.setattr("padforge.common.plotting.save_figure", lambda figure, *_: saved.append(figure))
    return saved


@pytest.fixture(autouse=True)
def _orientation_is_blank(monkeypatch) -> None:
    """Every mould comes with a drawing of its orientation, which takes half of the time of a small one."""
    monkeypatch.setattr("padforge.fabricate.export.draw_orientation", lambda plan, path: path.write_text("<svg/>"))
