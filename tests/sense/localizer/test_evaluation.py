"""Errors of a localizer, also while a press is read; radii of few presses, by what other pads have shown."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import Evaluation, Recording, RigSettings
from padforge.sense.localizer import network
from padforge.sense.localizer.evaluation import (
    PRIOR_PRESSES,
    RATIO_SHAPE,
    conformal,
    distances,
    error_row,
    find_doubts,
    idle_share,
)
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.model import Localization, LocalizerModel, MeasureEstimate
from padforge.sense.signals.press_detection import detect_presses, first_readings
from padforge.sense.simulation.strokes import simulate_strokes
from tests.helpers.presses import changed

PLACES = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])


def off_by(*amounts: float, r50: float = 1.0, r90: float = 2.0, sd: float = 1.0) -> Localization:
    """The four presses found to the side by so many mm."""
    away = np.column_stack([amounts, np.zeros(4)])
    return Localization(PLACES + away, np.full((4, 2), sd), np.full(4, r50), np.full(4, r90))


def make_localization(ratios: np.ndarray) -> Localization:
    """Presses at (0, 0) that are off by shares of a radius of 2 mm."""
    size, radii = len(ratios), np.full(len(ratios), 2.0)
    return Localization(np.column_stack([2 * ratios, 0 * ratios]), np.full((size, 2), 2**0.5), radii, radii)


def test_error_row_summarizes_sets_and_known_measures() -> None:
    row = error_row(2, [off_by(0, 1, 2, 3), off_by(1, 1, 1, 9, r50=1.5, r90=8.0)], PLACES)
    assert (row["mean_mm"], row["std_mm"], row["max_mm"]) == pytest.approx((2.25, 0.75, 3.0))
    assert (row["median_mm"], row["p95_mm"]) == pytest.approx((1, 3 + 0.65 * 6))
    assert (row["within_r50"], row["within_r90"]) == pytest.approx((5 / 8, 6 / 8))
    depth = MeasureEstimate(np.array([1.0, 2, 3, 4]), np.full(4, 0.15))
    found = replace(off_by(0, 0, 0, 0), measures={"depth_mm": depth})
    depths = np.array([1.1, 2.0, 3.3, np.nan])
    row = error_row(0, [found], PLACES, {"depth_mm": depths, "force_n": depths})
    assert row["depth_mean_mm"] == pytest.approx(0.4 / 3)
    assert row["depth_within_r90"] == pytest.approx(2 / 3)
    assert not [key for key in error_row(0, [found], PLACES) if key.startswith("depth")]
    assert conformal([found], PLACES, {"depth_mm": depths})[3] == pytest.approx(0.3 / 0.15)
    assert conformal([found], PLACES)[3] == 1


def test_conformal_takes_a_quantile_one_rank_higher_and_a_prior_counts_as_so_many_presses() -> None:
    """Ninety-nine presses off by 0.01, 0.02 ... of their radius: the 50th and the 90th."""
    ranks = np.random.default_rng(0).permutation(np.arange(1, 100) / 100)
    spread, r50, r90 = conformal([make_localization(ranks)], np.zeros((99, 2)))
    assert spread == pytest.approx(np.sqrt(np.square(ranks).mean()))
    assert (r50, r90) == pytest.approx((0.50, 0.90))
    assert conformal([make_localization(ranks[:5])], np.zeros((5, 2)))[2] == pytest.approx(ranks[:5].max())
    # as many presses as the prior counts for, all ten times as far off as it says
    far = make_localization(np.full(PRIOR_PRESSES, 10.0))
    spread, r50, r90 = conformal([far], np.zeros((PRIOR_PRESSES, 2)), None, 1.0)
    assert r90 == pytest.approx(10.0)
    assert 2.0 < r50 < 10.0
    assert spread == pytest.approx(np.sqrt((100 + 1 + 1 / RATIO_SHAPE) / 2), rel=1e-3)


@pytest.mark.parametrize("presses", [9, 40])
def test_conformal_covers_of_few_presses_and_several_sets(presses: int) -> None:
    rng = np.random.default_rng(presses)

    def drawn(count: int) -> list[Localization]:
        hard = rng.exponential(size=count)  # a press that is hard to find is so with every set
        return [make_localization(hard * rng.exponential(size=count)) for _ in range(3)]

    shares = []
    for _ in range(200):
        _, r50, r90 = conformal(drawn(presses), np.zeros((presses, 2)))
        fresh = np.concatenate([each.positions_mm[:, 0] / 2 for each in drawn(100)])
        shares.append([(fresh <= r50).mean(), (fresh <= r90).mean()])
    half, most = np.mean(shares, axis=0)
    assert 0.48 < half < 0.52 + 1 / presses
    assert 0.885 < most < 0.915 + 1 / presses


def test_idle_share_is_that_of_changes_below_a_share_of_their_range() -> None:
    """Of five presses of 20 readings, fibre 1 changes by 0 to 1 V, fibre 2 by far less than its 2 V in one."""
    steps = np.array([[0.0, 1.0], [0.015, -1.0], [0.025, 0.03], [1.0, 0.05], [0.5, 0.5]])
    is_pressed = np.repeat([0.0, 1.0, 0.0], [15, 20, 5])  # no longer in the last reading, which is in no window
    readings = (is_pressed[:, None] * steps[:, None]).reshape(200, 2)
    down_command = np.arange(5) * 40 + 15
    recording = Recording(readings, np.arange(200) / 13, np.zeros((5, 2)), down_command, down_command + 21)
    np.testing.assert_allclose(idle_share(recording), [2 / 5, 1 / 5])


def test_far_presses_and_another_recording_are_doubted(localizer: LocalizerModel, recording: Recording) -> None:
    localization = localizer.predict(recording)
    assert find_doubts(recording, localization, 0.9, 45) == []
    corner = int(np.argmin(recording.presses_mm.sum(axis=1)))
    mistyped = changed(recording, "presses_mm", corner, -recording.presses_mm[corner])  # a sign was lost
    (line,) = find_doubts(changed(mistyped, "presses_mm", 3, np.nan), localization, 0.9, 45)
    assert line.startswith(f"stated more than 4 r90 from where they are predicted: press {corner} at (")
    expected = ["2% of 300 presses lie within r90: is it the recording of this pad?"]
    assert find_doubts(recording, localization, 0.02, 300) == expected
    assert find_doubts(recording, localization, 0.02, 10) == []  # of so few it may be chance


PAD = Morphology.random(2, knots=3, seed=5)  # of the recording


def test_errors_fall_while_a_press_is_read(calibrated: tuple[LocalizerModel, Evaluation], recording: Recording) -> None:
    """Rows are those of predictions until a moment, and the touch in focus is that of the median error."""
    model, evaluation = calibrated
    means = [row["mean_mm"] for row in evaluation.by_moment if row["n_failed"] == 0]
    assert means[0] > means[3] > evaluation.errors[0]["mean_mm"]
    assert all(row["within_r90"] > 0.7 for row in evaluation.by_moment)
    test, up = list(model.test), recording.up_command
    touched = first_readings(recording.readings, recording.times_s, recording.down_command, up)
    for number, until in ((2, np.minimum(touched + 3, up)), (9, up + 2), (-1, up + 15)):
        last = model.predict(recording, until=until).positions_mm
        errors_mm = distances(last, recording.presses_mm)[test]
        assert means[number] == pytest.approx(errors_mm.mean(), rel=1e-5)  # of single precision
    focus = evaluation.focus
    assert focus["moments"][0]["r90_mm"] > focus["moments"][-1]["r90_mm"]
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
