"""A simulated recording and a quickly trained localizer, shared by the tests of sense."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import Localizer, Recording, calibrate
from padforge.sense import settings as sense_settings
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.once import Once

QUICK = sense_settings.LocalizerSettings(members=2, hidden=48, layers=2, epochs=50, batch=64)


@pytest.fixture(scope="session")
def recording(once: Once) -> Recording:
    """300 presses on a pad whose fibres wind."""
    rig = sense_settings.RigSettings(presses=300, seed=1)
    return once("recording", lambda folder: simulate(Morphology.random(2, knots=3, seed=5), rig))


@pytest.fixture(scope="session")
def brief(recording: Recording) -> Recording:
    """Its first 40 presses."""
    end = int(recording.begun[40])
    presses = {name: getattr(recording, name)[:40] for name in ("presses_mm", "begun", "lifted")}
    return Recording(recording.readings[:end], recording.times_s[:end], **presses)


@pytest.fixture(scope="session")
def calibrated(once: Once, recording: Recording) -> tuple[Localizer, dict]:
    return once("calibrated", lambda folder: calibrate(recording, QUICK))


@pytest.fixture(scope="session")
def localizer(calibrated: tuple[Localizer, dict]) -> Localizer:
    return calibrated[0]


@pytest.fixture(scope="session")
def deep_recording(once: Once) -> Recording:
    """400 presses of 0.5 to 5 mm, each as hard as a spring would have it, on a pad whose responses do not scatter.

    How strongly it responds is what tells of the depth.
    """
    depths = tuple(np.random.default_rng(4).uniform(0.5, 5, 400).tolist())
    rig = sense_settings.RigSettings(presses=400, seed=2, depths_mm=depths, scatter=0)
    recording = once("deep-recording", lambda folder: simulate(Morphology.random(2, knots=3, seed=5), rig))
    return replace(recording, forces_n=3.0 * recording.depths_mm)


@pytest.fixture(scope="session")
def deeply_calibrated(once: Once, deep_recording: Recording) -> tuple[Localizer, dict]:
    options = QUICK.model_copy(update={"members": 1, "epochs": 40})
    return once("deeply-calibrated", lambda folder: calibrate(deep_recording, options))


@pytest.fixture(scope="session")
def deep_localizer(deeply_calibrated: tuple[Localizer, dict]) -> Localizer:
    """It has learnt depth and force."""
    return deeply_calibrated[0]


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
