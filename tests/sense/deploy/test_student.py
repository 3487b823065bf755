"""The student is nearly as accurate as its teacher, and never trained on its test presses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import LocalizerSettings, Recording, calibrate
from padforge.sense.deploy.c_header import StudentNetwork, distill, evaluate_student, quantize
from padforge.sense.deploy.streaming import MemoryBudget
from padforge.sense.formats.import_export import open_recording
from padforge.sense.localizer.calibration import split_unseen
from padforge.sense.localizer.model import LocalizerModel
from tests.sense.conftest import QUICK
from tests.sense.live.conftest import first_presses

MAX_RATIO = 1.25


def test_student_is_nearly_as_accurate_as_its_teacher(
    student: StudentNetwork, recording: Recording, localizer: LocalizerModel
) -> None:
    _, test = split_unseen(recording, localizer, QUICK)
    assert set(test.tolist()) == set(localizer.test)
    evaluation = evaluate_student(student, [localizer], recording, test)
    header, teacher = evaluation["errors"]["header"], evaluation["errors"]["press_and_release"]
    assert header[0]["mean_mm"] < MAX_RATIO * teacher[0]["mean_mm"]
    assert [row["n_failed"] for row in header] == [0, 1, 2, 3]
    assert all(0.75 < row["within_r90"] < 1 for row in header)
    assert (evaluation["n_detected"], evaluation["n_false"]) == (len(test), 0)
    assert evaluation["detected_mean_mm"] < MAX_RATIO * teacher[0]["mean_mm"]


@pytest.mark.slow
def test_student_is_nearly_as_accurate_as_a_causal_localizer_on_the_published_recording(published: Path) -> None:
    """With 64 KiB of RAM, after a training of the same length."""
    recording = first_presses(open_recording(published / "para5_long_first4500.mat"), 1200)
    options = LocalizerSettings(members=1, hidden=96, layers=3, epochs=40, batch=128, features="causal", max_failures=1)
    localizer, _ = calibrate(recording, options)
    training, test = split_unseen(recording, localizer, options)
    student = distill(recording, localizer, training, MemoryBudget(150_000, 65_536), options)
    evaluation = evaluate_student(student, [localizer], recording, test)
    errors = evaluation["errors"]
    assert errors["header"][0]["mean_mm"] <= MAX_RATIO * errors["causal"][0]["mean_mm"]
    assert evaluation["n_detected"] >= 0.95 * len(test)
    assert evaluation["n_false"] <= 0.03 * len(test)


def test_distill_ignores_test_presses(brief: Recording, localizer: LocalizerModel) -> None:
    training, test = split_unseen(brief, localizer, QUICK)
    assert (len(training), len(test)) == (34, 6)
    assert not set(training.tolist()) & set(test.tolist())
    wrong = np.array(brief.presses_mm)
    wrong[test] = 0.0
    options, budget = QUICK.model_copy(update={"epochs": 2}), MemoryBudget(20_000, 4_000)
    recordings = brief, replace(brief, presses_mm=wrong)
    one, other = (distill(each, localizer, training, budget, options) for each in recordings)
    for name, weight in one.model.weights.items():
        assert np.array_equal(weight, other.model.weights[name])
    assert np.array_equal(one.model.interval_factors, other.model.interval_factors)
    assert one.detector.threshold == other.detector.threshold


def test_split_leaves_out_presses_that_cannot_test(brief: Recording, localizer: LocalizerModel) -> None:
    unknown = np.array(brief.presses_mm)
    unknown[:10] = np.nan
    training, test = split_unseen(replace(brief, presses_mm=unknown), localizer, QUICK)
    assert min(*training, *test) == 10
    with pytest.raises(InputError, match="the localizer was recalibrated by"):
        split_unseen(brief, replace(localizer, recalibrated_by=(brief.digest,)), QUICK)


def test_quantize_is_within_half_a_step(student: StudentNetwork) -> None:
    quantized = quantize(student.model.weights)
    for name, weight in student.model.weights.items():
        step = np.abs(weight).max(axis=-2, keepdims=True) / 127 if name.endswith(".w") else 0  # biases stay
        assert (np.abs(quantized[name] - weight) <= 0.501 * step).all()
        assert not name.endswith(".w") or (np.abs(np.rint(quantized[name] / step)) <= 127).all()
