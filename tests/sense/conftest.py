"""A simulated recording and a quickly trained localizer, shared by the tests of sense."""

from pathlib import Path

import pytest

from design import Morphology
from sense import Localizer, Recording, calibrate
from sense import settings as sense_settings
from sense.recordings.simulation.published_protocol import simulate

QUICK = sense_settings.LocalizerSettings(members=2, hidden=48, layers=2, epochs=50, batch=64)


@pytest.fixture(scope="session")
def recording() -> Recording:
    """300 presses on a pad whose fibres wind."""
    return simulate(Morphology.random(2, knots=3, seed=5), sense_settings.RigSettings(presses=300, seed=1))


@pytest.fixture(scope="session")
def brief(recording: Recording) -> Recording:
    """Its first 40 presses."""
    end = int(recording.begun[40])
    presses = {name: getattr(recording, name)[:40] for name in ("presses_mm", "begun", "lifted")}
    return Recording(recording.readings[:end], recording.times_s[:end], **presses)


@pytest.fixture(scope="session")
def calibrated(recording: Recording) -> tuple[Localizer, dict]:
    return calibrate(recording, QUICK)


@pytest.fixture(scope="session")
def localizer(calibrated: tuple[Localizer, dict]) -> Localizer:
    return calibrated[0]


@pytest.fixture(scope="session")
def model(recording: Recording, localizer: Localizer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as `padforge run` leaves it."""
    folder = tmp_path_factory.mktemp("pad")
    localizer.save(folder)
    recording.save(folder / "recording", {})
    return folder


@pytest.fixture
def folder(recording: Recording, tmp_path: Path) -> Path:
    """The run directory of a recording."""
    recording.save(tmp_path / "run", {"command": "test"})
    return tmp_path / "run"
