"""The run directory of a recording."""

from pathlib import Path

import pytest

from sense import Recording


@pytest.fixture
def folder(recording: Recording, tmp_path: Path) -> Path:
    recording.save(tmp_path / "run", {"command": "test"})
    return tmp_path / "run"
