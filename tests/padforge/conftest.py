import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from padforge.common.page import PageSection
from padforge.design.report import press_sections
from tests.helpers.door import called
from tests.helpers.less import blank_pictures, compare_little, small_pictures
from tests.helpers.once import Once

SMALL = """
[pad]
grid = 2
[search]
knots = 2
starts = 1
steps = 10
max_failures = 1
[rig]
presses = 60
[localizer]
members = 1
hidden = 16
epochs = 4
max_failures = 1
"""
SMALLEST = "[pad]\ngrid = 1\n[search]\nknots = 1\nstarts = 1\nsteps = 2\nmax_failures = 1\n[rules]\nenforce = false\n"
PRESSED: dict[str, list[PageSection]] = {}
"""Sections on presses that reports have had so far, by what they are made of."""


@pytest.fixture(autouse=True)
def press_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report draws a press only if no other has drawn the same: that is most of what it takes."""

    def remembered(document: Mapping, *materials: Any) -> list[PageSection]:
        settings = document["provenance"]["settings"]
        key = repr((settings["contact"], settings["pad"], materials))
        if key not in PRESSED:
            PRESSED[key] = press_sections(document, *materials)
        return list(PRESSED[key])

    monkeypatch.setattr("padforge.design.report.press_sections", remembered)


@pytest.fixture(scope="session")
def finished(once: Once) -> tuple[Path, str]:
    """A folder in which a run has come to its end, and what it printed."""

    def make(folder: Path) -> tuple[Path, str]:
        (folder / "pad.toml").write_text(SMALL)
        with pytest.MonkeyPatch.context() as patch:
            compare_little(patch)
            small_pictures(patch)
            ended = called("run", cwd=folder)
        assert ended.code == 0, ended
        return folder, ended.out

    return once("run", make)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pads are compared by few presses, and pictures are blank."""
    compare_little(monkeypatch)
    blank_pictures(monkeypatch)


@pytest.fixture
def folder(finished: tuple[Path, str], tmp_path: Path, brief: None) -> Path:
    """A copy of it, to go on in."""
    return shutil.copytree(finished[0], tmp_path / "run")
