"""What a person is asked to do, which presses are accepted, and why others are not."""

import numpy as np
import pytest

from padforge.sense.rig.by_hand_presses import (
    MIN_PRESSES,
    SETTLE_S,
    UNTOUCHED,
    PressSequence,
    PressValidator,
    press_responses,
)

TARGETS = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
BASELINE = np.array([2.0, 1.8, 1.9])
PRESS = np.array([0.1, -0.2, 0.2])


@pytest.fixture
def sequence() -> PressSequence:
    """Ready for the first press, at 100 s."""
    return PressSequence(TARGETS, 1.0, 100.0 - SETTLE_S)


def press(sequence: PressSequence, down_s: float, up_s: float) -> str:
    sequence.touch(down_s)
    return sequence.release(up_s)


def test_sequence_goes_through_all_phases(sequence: PressSequence) -> None:
    assert [sequence.phase(time_s) for time_s in (98.5, 100.0)] == ["settle", "press"]
    assert sequence.touch(100.5) == (1.0, 2.0)
    assert [sequence.phase(time_s) for time_s in (101.4, 101.5)] == ["hold", "lift"]
    assert sequence.progress(101.0) == pytest.approx(0.5)
    assert sequence.release(101.7) == ""
    sequence.accept(101.8)
    assert (sequence.accepted_mm, sequence.target, len(sequence.remaining)) == ([(1.0, 2.0)], (3.0, 4.0), 2)
    assert [sequence.phase(time_s) for time_s in (102.6, 102.7)] == ["wait", "press"]
    for down_s in (103.0, 106.0):
        assert press(sequence, down_s, down_s + 1) == ""
        sequence.accept(down_s + 1.1)
    assert sequence.target is None
    assert [sequence.phase(time_s) for time_s in (107.9, 108.0)] == ["wait", "done"]
    sequence.skip(108.1)
    assert sequence.touch(110.0) is None
    assert sequence.release(111.0) == "it came before it was asked for"


@pytest.mark.parametrize(
    ("down_s", "up_s", "rejection"),
    [
        (99.9, 101.0, "it came before it was asked for"),
        (100.0, 100.7, "it was held for 0.7 s, hold it for 1.0 s"),
        (100.0, 104.1, "it was held for 4.1 s, lift after 1.0 s"),
        (100.0, 100.85, ""),
    ],
)
def test_sequence_rejects_by_time(sequence: PressSequence, down_s: float, up_s: float, rejection: str) -> None:
    assert press(sequence, down_s, up_s) == rejection
    assert sequence.target == (1.0, 2.0)
    assert sequence.phase(up_s + 0.9) == "wait"


def test_sequence_undoes_and_skips(sequence: PressSequence) -> None:
    assert not sequence.undo(100.0)  # there is nothing
    press(sequence, 100.0, 101.0)
    sequence.accept(101.1)
    assert sequence.undo(101.2)
    assert (sequence.target, sequence.accepted_mm) == ((1.0, 2.0), [])
    sequence.touch(110.0)
    assert not sequence.undo(110.5)  # the press under way
    assert sequence.phase(110.6) == "lift"
    assert sequence.release(111.0) == "it was taken back"
    sequence.touch(120.0)
    sequence.skip(120.5)
    assert sequence.release(121.0) == "its place was skipped"
    assert sequence.target == (3.0, 4.0)


def readings(early: np.ndarray, late: np.ndarray) -> np.ndarray:
    """Ten readings of the baseline, ten of the first part of a press, ten of its last, and the baseline again."""
    return np.repeat([BASELINE, BASELINE + early, BASELINE + late, BASELINE], [10, 10, 10, 1], axis=0)


@pytest.fixture
def validator() -> PressValidator:
    validator = PressValidator()
    for _ in range(MIN_PRESSES):
        validator.accept(np.array([PRESS, PRESS]), BASELINE)
    return validator


def test_press_responses_are_differences_from_the_baseline() -> None:
    np.testing.assert_allclose(press_responses(readings(PRESS, 2 * PRESS), 10, 30), [PRESS, 2 * PRESS])
    gaps = readings(PRESS, PRESS)
    gaps[12:18, 0] = np.nan
    gaps[:, 2] = np.nan
    np.testing.assert_allclose(press_responses(gaps, 10, 30)[1], [0.1, -0.2, 0.0])
    assert np.isfinite(press_responses(readings(PRESS, PRESS)[9:13], 1, 2)).all()  # the shortest there is


def test_validator_rejects_weak_and_moved_presses(validator: PressValidator) -> None:
    weak = np.array([0.1 * PRESS, 0.1 * PRESS])
    assert validator.rejection(press_responses(readings(PRESS, 1.3 * PRESS), 10, 30)) == ""
    assert validator.rejection(3 * weak) == ""
    assert "weaker" in validator.rejection(weak)
    assert "changed" in validator.rejection(press_responses(readings(PRESS, PRESS[::-1]), 10, 30))
    assert PressValidator().rejection(weak) == ""  # the usual response is not known yet


def test_validator_detects_that_nothing_touches(validator: PressValidator) -> None:
    pressed = BASELINE + PRESS
    assert not validator.is_untouched(pressed, BASELINE, held_s=5.0)
    assert validator.is_untouched(BASELINE + 0.1 * PRESS, BASELINE, held_s=2.0)
    assert not validator.is_untouched(BASELINE + 0.1 * PRESS, BASELINE, held_s=0.5)  # it may still be sinking in
    # Detected as a touch, but it began under a finger and ended at the baseline.
    assert validator.is_untouched(BASELINE + 0.2 * PRESS, pressed, held_s=0.5)
    assert not validator.is_untouched(pressed[::-1], pressed, held_s=0.5)


def test_validator_follows_the_drift_of_the_baseline(validator: PressValidator) -> None:
    drift = 0.8 * UNTOUCHED * PRESS
    for step in range(1, 9):
        assert validator.is_touched(BASELINE + step * drift) is False
    assert validator.is_touched(BASELINE) is True
    validator.reset_baseline()
    assert validator.is_touched(BASELINE) is None
