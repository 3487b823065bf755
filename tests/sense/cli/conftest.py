"""`padforge sense` from the outside: files in, files out, one line for a mistake."""

import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from padforge.cli import main
from padforge.common.settings import Spec
from padforge.design import Morphology
from padforge.sense import Evaluation, calibrate
from padforge.sense.health import trace_model
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.report.calibration import calibrate_into
from padforge.sense.rig.operation import record_simulated
from padforge.sense.settings import LocalizerSettings, RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.less import blank_pictures
from tests.helpers.once import Once
from tests.sense.conftest import few_moments

SPEC = "[localizer]\nmembers = 1\nhidden = 24\nlayers = 1\nepochs = 4\n[rig]\npresses = 60\n[pad]\ngrid = 2\n"

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def padforge_sense(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run `padforge sense ...` in a folder with a pad.toml; returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    Path("pad.toml").write_text(SPEC)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["padforge", "sense", *arguments])
        capsys.readouterr()  # what the making of models has said, if this test is the first to ask for them
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
    with pytest.MonkeyPatch.context() as patch, few_moments():
        patch.setattr(trace_model, "MAX_STEPS", 80)
        blank_pictures(patch)
        calibrate_into(recording, folder / "model", spec.section(LocalizerSettings))
    return folder


def make_deep_presses(folder: Path) -> Path:
    """Make `rec`, whose presses differ in depth and force, and a localizer of both on it, `model`."""
    pad, rig = Morphology.straight(2), RigSettings(presses=60, depths_mm=(1.0, 3.0, 5.0))
    recording = simulate(pad, rig)
    recording = replace(recording, forces_n=3.0 * recording.depths_mm)
    recording.save(folder / "rec", {})
    with few_moments():
        localizer, _ = calibrate(recording, LocalizerSettings(members=1, hidden=32, layers=1, epochs=12))
    localizer.save(folder / "model")
    return folder


@pytest.fixture(autouse=True)
def short_calibrations() -> Iterator[None]:
    """They are evaluated at two moments of a press, which takes longest of a short one."""
    with few_moments():
        yield


def command_in(name: str, make: Callable[[Path], Path]) -> Any:
    """Make a fixture: `padforge_sense` in a copy of the folder that `make` fills once."""

    @pytest.fixture
    def run(padforge_sense: Run, once: Once) -> Run:
        shutil.copytree(once(name, make), Path(), dirs_exist_ok=True)
        return padforge_sense

    return run


FEW = ("few presses and their model", partial(make_model, presses=60))
ENOUGH = ("enough presses and their model", partial(make_model, presses=360))  # to learn health from
few, enough, deep = (command_in(*each) for each in (FEW, ENOUGH, ("deep presses and their model", make_deep_presses)))


@pytest.fixture
def calibrate_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train at the first calibration; later ones get the same localizer, whatever they ask for."""
    trained: list[tuple[LocalizerModel, Evaluation]] = []

    def calibrate_at_first(*arguments: Any, **options: Any) -> tuple[LocalizerModel, Evaluation]:
        trained[:] = trained or [calibrate(*arguments, **options)]
        return trained[0]

    monkeypatch.setattr("padforge.sense.report.calibration.calibrate", calibrate_at_first)
