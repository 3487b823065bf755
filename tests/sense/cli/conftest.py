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

SPEC = "[localizer]\nmembers = 1\nhidden = 24\nlayers = 1\nepochs = 4\n[rig]\npresses = 60\n[pad]\ngrid = 2\n"

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def padforge_sense(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run `padforge sense ...` in a folder with a pad.toml; gives exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    Path("pad.toml").write_text(SPEC)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["padforge", "sense", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capsys.readouterr()
        return caught.value.code or 0, out, err  # type: ignore[return-value]

    return run


def made(folder: Path, presses: int) -> Path:
    """A folder with a recording `rec` of so many presses, and `model`, quickly calibrated by it."""
    (folder / "pad.toml").write_text(SPEC)
    spec = Spec.load(folder / "pad.toml")
    recording = record_simulated(spec, Morphology.straight(2), folder / "rec", {"presses": presses})
    with mock.patch.object(trace_model, "MAX_STEPS", 80):
        calibrate_into(recording, folder / "model", spec.section(LocalizerSettings))
    return folder


@pytest.fixture(scope="session")
def few_made(once: Once) -> Path:
    return once("few presses and their model", lambda folder: made(folder, 60))


@pytest.fixture(scope="session")
def enough_made(once: Once) -> Path:
    return once("enough presses and their model", lambda folder: made(folder, 360))


@pytest.fixture
def few(padforge_sense: Run, few_made: Path) -> Run:
    """As `padforge_sense`, in a folder with `rec` of 60 presses and `model`."""
    shutil.copytree(few_made, Path(), dirs_exist_ok=True)
    return padforge_sense


@pytest.fixture
def enough(padforge_sense: Run, enough_made: Path) -> Run:
    """As `few`, with presses enough for health to be learnt."""
    shutil.copytree(enough_made, Path(), dirs_exist_ok=True)
    return padforge_sense
