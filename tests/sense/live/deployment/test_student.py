"""The student: nearly as good as a causal localizer, never taught what it is tested on, and as small as it must be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Localizer, LocalizerSettings, Recording, calibrate
from sense.live.deployment import student as students
from sense.live.deployment.budget import CODE, STEP, Budget, state_bytes, table_bytes, widest
from sense.live.deployment.student import Student, as_int8, examine, split, teach
from sense.recordings.import_export import open_recording
from tests.sense.conftest import QUICK

MOST_WORSE = 1.25


def first(recording: Recording, presses: int) -> Recording:
    end = recording.begun[presses]
    edges = (getattr(recording, name)[:presses] for name in ("presses_mm", "begun", "lifted"))
    return Recording(recording.readings[:end], recording.times_s[:end], *edges)


def both(recording: Recording, options: LocalizerSettings) -> dict:
    """How far off a student of 64 KiB of RAM is, beside a causal localizer, after trainings of the same length."""
    localizer, _ = calibrate(recording, options)
    training, test = split(recording, localizer, options)
    assert set(test.tolist()) == set(localizer.test)
    student = teach(recording, localizer, training, Budget(150_000, 65_536), options)
    found = examine(student, [localizer], recording, test)
    return found | {
        "presses": len(test),
        "ratio": found["errors"]["header"][0]["mean_mm"] / found["errors"]["causal"][0]["mean_mm"],
    }


def test_it_is_nearly_as_good_as_the_causal_localizer(recording: Recording) -> None:
    short = LocalizerSettings(members=1, hidden=96, layers=3, epochs=60, batch=128, features="causal", lost=1)
    found = both(recording, short)
    assert found["ratio"] <= MOST_WORSE
    assert found["found"] == found["presses"]
    assert found["false"] == 0
    assert found["found_mm"] <= MOST_WORSE * found["errors"]["causal"][0]["mean_mm"]


def test_so_it_is_on_the_published_recording(published: Path) -> None:
    recording = first(open_recording(published / "para5_long_first4500.mat"), 1200)
    short = LocalizerSettings(members=1, hidden=96, layers=3, epochs=40, batch=128, features="causal", lost=1)
    found = both(recording, short)
    assert found["ratio"] <= MOST_WORSE
    assert found["found"] >= 0.95 * found["presses"]
    assert found["false"] <= 0.03 * found["presses"]


def test_no_press_of_the_test_is_learnt_from(recording: Recording, localizer: Localizer) -> None:
    """Places of test presses that are nonsense change nothing but the test."""
    training, test = split(recording, localizer, QUICK)
    assert not set(training.tolist()) & set(test.tolist())
    nonsense = np.array(recording.presses_mm)
    nonsense[test] = 0.0
    short, budget = QUICK.model_copy(update={"epochs": 2}), Budget(20_000, 4_000)
    one, other = (
        teach(each, localizer, training, budget, short) for each in (recording, replace(recording, presses_mm=nonsense))
    )
    for name, weight in one.localizer.weights.items():
        assert np.array_equal(weight, other.localizer.weights[name])
    assert np.array_equal(one.localizer.factors, other.localizer.factors)
    assert one.detector.threshold == other.detector.threshold


def test_another_recording_is_split_as_for_calibration(brief: Recording, localizer: Localizer) -> None:
    training, test = split(brief, localizer, QUICK)
    assert (len(training), len(test)) == (34, 6)
    unknown = np.array(brief.presses_mm)
    unknown[:10] = np.nan
    training, test = split(replace(brief, presses_mm=unknown), localizer, QUICK)
    assert min(*training, *test) == 10


def test_a_recording_that_cannot_judge_is_refused(brief: Recording, localizer: Localizer) -> None:
    seen = replace(localizer, recalibrated_by=(brief.digest,))
    with pytest.raises(InputError, match="the localizer was recalibrated by"):
        split(brief, seen, QUICK)
    with pytest.raises(InputError, match="presses of known place"):
        split(first(brief, 3), localizer, QUICK)
    with pytest.raises(InputError, match="readings a second"):
        split(replace(brief, times_s=brief.times_s * 2), localizer, QUICK)


def test_a_training_that_diverges_is_one_line(brief, localizer, monkeypatch) -> None:
    from sense.localizer.calibration import training

    wild = {name: np.full((1, 1, 1), np.nan, np.float32) for name in ("first.w", "hidden.w")}
    monkeypatch.setattr(training, "train_members", lambda *_: training.Trained(wild, None, {}))
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
def test_the_widest_network_that_a_budget_allows(quantized: bool) -> None:
    for budget in (
        Budget(20_000, 65_536, quantized),
        Budget(262_144, 2_000, quantized),
        Budget(150_000, 8_192, quantized),
    ):
        hidden = widest(6, 0, 4, budget)

        def fits(hidden: int, budget: Budget = budget) -> bool:
            tables = CODE + table_bytes(6, 0, 4, hidden, budget.quantized)
            return tables <= budget.flash and state_bytes(6, 0, hidden) <= budget.ram

        assert fits(hidden)
        assert not fits(hidden + STEP)


@pytest.mark.parametrize(
    ("budget", "message"),
    [
        (
            Budget(4096, 65_536),
            r"--flash is 4096 bytes: the least localizer of 6 fibres takes \d+, allowed is that or more",
        ),
        (
            Budget(262_144, 1024),
            r"--ram is 1024 bytes: the least localizer of 6 fibres takes \d+, allowed is that or more",
        ),
    ],
)
def test_a_budget_that_is_too_small_is_one_line(budget: Budget, message: str) -> None:
    with pytest.raises(InputError, match=message):
        widest(6, 0, 4, budget)
