"""The student: nearly as good as its teacher, never taught what it is tested on, and as small as it must be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import LocalizerSettings, Recording, calibrate
from padforge.sense.deploy import student as students
from padforge.sense.deploy.streaming import CODE, STEP, Budget, state_bytes, table_bytes, widest
from padforge.sense.deploy.student import Student, as_int8, examine, split, teach
from padforge.sense.formats.import_export import open_recording
from padforge.sense.localizer import training as trainings
from padforge.sense.localizer.model import LocalizerModel
from tests.sense.conftest import QUICK
from tests.sense.live.conftest import first_presses

MOST_WORSE = 1.25


def test_it_is_nearly_as_good_as_its_teacher(taught: Student, recording: Recording, localizer: LocalizerModel) -> None:
    _, test = split(recording, localizer, QUICK)
    assert set(test.tolist()) == set(localizer.test)
    found = examine(taught, [localizer], recording, test)
    header, teacher = found["errors"]["header"], found["errors"]["press_and_release"]
    assert header[0]["mean_mm"] < MOST_WORSE * teacher[0]["mean_mm"]
    assert [row["n_failed"] for row in header] == [0, 1, 2, 3]
    assert all(0.75 < row["within_r90"] < 1 for row in header)
    assert (found["found"], found["false"]) == (len(test), 0)
    assert found["predicted_mm"] < MOST_WORSE * teacher[0]["mean_mm"]


@pytest.mark.slow
def test_it_is_nearly_as_good_as_a_causal_localizer_on_the_published_recording(published: Path) -> None:
    """Of 64 KiB of RAM, after a training of the same length."""
    recording = first_presses(open_recording(published / "para5_long_first4500.mat"), 1200)
    options = LocalizerSettings(members=1, hidden=96, layers=3, epochs=40, batch=128, features="causal", max_failures=1)
    localizer, _ = calibrate(recording, options)
    training, test = split(recording, localizer, options)
    student = teach(recording, localizer, training, Budget(150_000, 65_536), options)
    found = examine(student, [localizer], recording, test)
    assert found["errors"]["header"][0]["mean_mm"] <= MOST_WORSE * found["errors"]["causal"][0]["mean_mm"]
    assert found["found"] >= 0.95 * len(test)
    assert found["false"] <= 0.03 * len(test)


def test_no_press_of_the_test_is_training_recording_sha256(brief: Recording, localizer: LocalizerModel) -> None:
    """Places of test presses that are nonsense change nothing but the test."""
    training, test = split(brief, localizer, QUICK)
    assert (len(training), len(test)) == (34, 6)
    assert not set(training.tolist()) & set(test.tolist())
    nonsense = np.array(brief.presses_mm)
    nonsense[test] = 0.0
    short, budget = QUICK.model_copy(update={"epochs": 2}), Budget(20_000, 4_000)
    one, other = (
        teach(each, localizer, training, budget, short) for each in (brief, replace(brief, presses_mm=nonsense))
    )
    for name, weight in one.localizer.weights.items():
        assert np.array_equal(weight, other.localizer.weights[name])
    assert np.array_equal(one.localizer.interval_factors, other.localizer.interval_factors)
    assert one.detector.threshold == other.detector.threshold


def test_presses_of_unknown_place_are_neither_learnt_from_nor_tested_on(
    brief: Recording, localizer: LocalizerModel
) -> None:
    unknown = np.array(brief.presses_mm)
    unknown[:10] = np.nan
    training, test = split(replace(brief, presses_mm=unknown), localizer, QUICK)
    assert min(*training, *test) == 10


def test_a_recording_that_cannot_judge_is_refused(brief: Recording, localizer: LocalizerModel) -> None:
    seen = replace(localizer, recalibrated_by=(brief.digest,))
    with pytest.raises(InputError, match="the localizer was recalibrated by"):
        split(brief, seen, QUICK)
    with pytest.raises(InputError, match="presses of known position"):
        split(first_presses(brief, 3), localizer, QUICK)
    with pytest.raises(InputError, match="readings a second"):
        split(replace(brief, times_s=brief.times_s * 2), localizer, QUICK)


def test_a_training_that_diverges_is_one_line(brief, localizer, monkeypatch) -> None:
    wild = {name: np.full((1, 1, 1), np.nan, np.float32) for name in ("first.w", "hidden.w")}
    monkeypatch.setattr(trainings, "train_members", lambda *_: trainings.Trained(wild, None, {}))
    with pytest.raises(InputError, match=r"training diverged at \[localizer\] rate"):
        teach(brief, localizer, np.arange(30), Budget(20_000, 4_000), QUICK)


def test_int8_is_within_half_a_step(taught: Student) -> None:
    rounded = as_int8(taught.localizer.weights)
    for name, weight in taught.localizer.weights.items():
        if name.endswith(".b"):
            assert rounded[name] is weight
        else:
            step = np.abs(weight).max(axis=-2, keepdims=True) / students.MOST_INT8
            assert (np.abs(rounded[name] - weight) <= 0.501 * step).all()
            assert (np.abs(np.rint(rounded[name] / step)) <= students.MOST_INT8).all()


@pytest.mark.parametrize("quantized", [False, True])
@pytest.mark.parametrize(("flash", "ram"), [(20_000, 65_536), (262_144, 2_000), (150_000, 8_192)])
def test_the_network_is_the_widest_that_a_budget_allows(flash: int, ram: int, quantized: bool) -> None:
    hidden = widest(6, 0, 4, Budget(flash, ram, quantized))

    def fits(hidden: int) -> bool:
        return CODE + table_bytes(6, 0, 4, hidden, quantized) <= flash and state_bytes(6, 0, hidden) <= ram

    assert fits(hidden)
    assert not fits(hidden + STEP)
