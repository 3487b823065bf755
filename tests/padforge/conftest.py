"""A small pad that has been made from end to end."""

import shutil
from pathlib import Path

import pytest

from tests.helpers.door import called
from tests.helpers.less import blank_pictures, compare_little
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


@pytest.fixture(scope="session")
def finished(once: Once) -> tuple[Path, str]:
    """A folder in which a run has come to its end, and what it printed."""

    def make(folder: Path) -> tuple[Path, str]:
        (folder / "pad.toml").write_text(SMALL)
        with pytest.MonkeyPatch.context() as patch:
            compare_little(patch)
            ended = called("run", cwd=folder)
        assert ended.code == 0, ended
        return folder, ended.out

    return once("run", make)


@pytest.fixture
def folder(finished: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, to go on in; what is done again compares contacts as little, and its pictures are blank."""
    compare_little(monkeypatch)
    blank_pictures(monkeypatch)
    return shutil.copytree(finished[0], tmp_path / "run")
