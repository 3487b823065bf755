"""Rectangular pads with keep-outs, from the simulated recording to the localization, in mm."""

from pathlib import Path

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.design.settings import PadSettings
from padforge.sense import Evaluation, Recording, calibrate
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.rig.simulated_board import simulated_board_of
from padforge.sense.settings import LocalizerSettings, RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.sense.conftest import few_moments

KEEP_OUT = ((2.0, -6.0), (9.0, -6.0), (9.0, 6.0), (2.0, 6.0))
SIZE = PadSettings(horizontals=3, verticals=2, pitch_mm=(8.0, 15.0), keep_out_mm=(KEEP_OUT,))
PAD = Morphology.random(SIZE.layout, knots=3, seed=2)
QUICK = LocalizerSettings(members=1, hidden=32, layers=2, epochs=10, batch=64, max_failures=1)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """250 presses, saved and read."""
    path = tmp_path_factory.mktemp("rectangle") / "recording"
    simulate(PAD, RigSettings(presses=250, seed=1), size=SIZE).save(path, {})
    return Recording.open(path)


@pytest.fixture(scope="module")
@few_moments()
def calibrated(recording: Recording) -> tuple[LocalizerModel, Evaluation]:
    return calibrate(recording, QUICK)


def test_recording_describes_its_pad(recording: Recording, tmp_path: Path) -> None:
    assert Morphology.from_dict(recording.source["morphology"]) == PAD
    assert recording.source["keep_out_mm"] == [[list(corner) for corner in KEEP_OUT]]
    recording.save(tmp_path / "recording", {})
    assert simulated_board_of(tmp_path).connect()["channels"] == 5


def test_localization_of_a_rectangular_pad_is_in_mm(
    recording: Recording, calibrated: tuple[LocalizerModel, Evaluation]
) -> None:
    localizer, evaluation = calibrated
    localization = localizer.predict(recording)
    errors = np.linalg.norm(localization.positions_mm - recording.presses_mm, axis=1)
    assert errors.mean() < 3.0  # of a pad of 24 by 60 mm
    test = np.array(evaluation.test["pressed_mm"]) - evaluation.test["predicted_mm"]
    assert evaluation.errors[0]["mean_mm"] == pytest.approx(np.linalg.norm(test, axis=1).mean(), rel=1e-6)
    within = [np.mean(errors <= radius) for radius in (localization.r50_mm, localization.r90_mm)]
    assert within == pytest.approx([0.5, 0.9], abs=0.2)
