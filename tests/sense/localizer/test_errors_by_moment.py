"""Errors while a press is read, and a finger that slides."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import Evaluation, Recording, RigSettings
from padforge.sense.localizer import network
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import MOMENTS
from padforge.sense.signals.press_detection import detect_presses, first_readings
from padforge.sense.simulation.strokes import simulate_strokes

PAD = Morphology.random(2, knots=3, seed=5)  # of the recording


def test_the_error_falls_while_a_press_is_read(
    calibrated: tuple[LocalizerModel, Evaluation], recording: Recording
) -> None:
    """Rows are those of predictions until a moment, and the touch in focus is that of the median error."""
    model, evaluation = calibrated
    rows = evaluation.by_moment
    intact = [row for row in rows if row["n_failed"] == 0]
    means = [row["mean_mm"] for row in intact]
    assert means[0] > means[3] > evaluation.errors[0]["mean_mm"]
    assert abs(means[-1] / evaluation.errors[0]["mean_mm"] - 1) < 0.25
    assert all(row["within_r90"] > 0.7 for row in rows)
    test, up = list(model.test), recording.up_command
    touched = first_readings(recording.readings, recording.times_s, recording.down_command, up)
    for number in (2, 9, -1):
        last = model.predict(recording, until=MOMENTS[number].until(touched, up)).positions_mm
        errors_mm = distances(last, recording.presses_mm)[test]
        assert means[number] == pytest.approx(errors_mm.mean(), rel=1e-5)  # of single precision
    focus = evaluation.focus
    radii = [moment["r90_mm"] for moment in focus["moments"]]
    assert radii[0] > radii[-1]
    assert focus["moments"][-1]["predicted_mm"] == pytest.approx(last[focus["press"]].tolist())
    assert np.sort(errors_mm)[len(errors_mm) // 2] == pytest.approx(errors_mm[test.index(focus["press"])])


def test_first_readings_are_those_of_the_detector_or_the_usual_ones(recording: Recording) -> None:
    commands = recording.down_command, recording.up_command
    touched = first_readings(recording.readings, recording.times_s, *commands)
    assert ((touched >= recording.down_command - 2) & (touched <= recording.up_command)).all()
    assert np.isin(touched, detect_presses(recording.readings, recording.times_s).touched).mean() > 0.8
    usual = first_readings(np.zeros_like(recording.readings), recording.times_s, *commands)
    before_s, after_s = (recording.times_s[each] - recording.times_s[commands[0]] for each in (usual - 1, usual))
    assert before_s.max() < 0.16 <= after_s.min()


def test_a_finger_that_slides_is_followed(localizer: LocalizerModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a network that was trained on presses alone; one that knows fingers at rest only stays behind."""
    strokes = simulate_strokes(PAD, RigSettings(presses=300, seed=1), Contact(), 15.0, 60, np.random.default_rng(0))
    recording, last = strokes.recording, strokes.positions_mm[:, -1]
    down, up = recording.down_command - 2, recording.up_command

    def error(least_slide: float) -> float:
        monkeypatch.setattr(network, "SLIDE_THRESHOLD", least_slide)
        features = localizer.scaler.transform(compute_features(recording.readings, down, up, up))
        return float(distances(localizer.predict_features(features).positions_mm, last).mean())

    usual = network.SLIDE_THRESHOLD
    assert error(0.0) < 0.8 * error(np.inf)
    assert error(usual) < error(np.inf)
