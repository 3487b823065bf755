"""`padforge sense` from the outside: files in, files out, one line for a mistake."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from padforge.cli import main
from padforge.design import Morphology
from padforge.design.common.settings import Spec
from padforge.sense.health import trace_model
from padforge.sense.report.calibration import calibrate_into
from padforge.sense.rig.operation import record_simulated
from padforge.sense.settings import LocalizerSettings
from tests.helpers.once import Once
from tests.sense.conftest import blank_pictures, few_moments

SPEC = "[localizer]\nmembers = 1\nhidden = 24\nlayers = 1\nepochs = 4\n[rig]\npresses = 60\n[pad]\ngrid = 2\n"

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def padforge_sense(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run `padforge sense ...` in a folder with a pad.toml; returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    Path("pad.toml").write_text(SPEC)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["padforge", "sense", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capsys.readouterr()
        return caught.value.code or 0, out, err  # type: ignore[return-value]

    return run


def make_model(folder: Path, presses: int) -> Path:
    """Make a recording `rec`, and `model`, quickly calibrated on it."""
    (folder / "pad.toml").write_text(SPEC)
    spec = Spec.load(folder / "pad.toml")
    recording = record_simulated(spec, Morphology.straight(2), folder / "rec", {"presses": presses})
    with mock.patch.object(trace_model, "MAX_STEPS", 80), blank_pictures(), few_moments():
        calibrate_into(recording, folder / "model", spec.section(LocalizerSettings))
    return folder


@pytest.fixture(scope="session")
def few_presses(once: Once) -> Path:
    return once("few presses and their model", lambda folder: make_model(folder, 60))


@pytest.fixture(scope="session")
def enough_presses(once: Once) -> Path:
    return once("enough presses and their model", lambda folder: make_model(folder, 360))


@pytest.fixture
def few(padforge_sense: Run, few_presses: Path) -> Run:
    """As `padforge_sense`, in a folder with `rec` of 60 presses and `model`."""
    shutil.copytree(few_presses, Path(), dirs_exist_ok=True)
    return padforge_sense


@pytest.fixture
def enough(padforge_sense: Run, enough_presses: Path) -> Run:
    """As `few`, with enough presses to learn health from."""
    shutil.copytree(enough_presses, Path(), dirs_exist_ok=True)
    return padforge_sense
