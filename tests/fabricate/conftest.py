from pathlib import Path

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def figures(figures: list[Figure], monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """All figures that the test has drawn; their files are empty, since pixels take most of the time."""
    monkeypatch.setattr("padforge.common.plotting.save_figure", lambda figure, path, *_: Path(path).touch())
    return figures


@pytest.fixture(autouse=True)
def _drawings_are_blank(monkeypatch: pytest.MonkeyPatch) -> None:
    """The drawings of orientation and crossing that come with every mould take half of the time of a small one."""
    for name in ("draw_orientation", "draw_crossing"):
        monkeypatch.setattr(f"padforge.fabricate.export.{name}", lambda plan, path: path.write_text("<svg/>"))
