import numpy as np
import pytest

from sense.live.by_hand.judging import BACK, LEARNT, Judge, answers

REST = np.array([2.0, 1.8, 1.9])
PRESS = np.array([0.1, -0.2, 0.2])


def readings(early: np.ndarray, late: np.ndarray) -> np.ndarray:
    """Ten readings at rest, ten of the first part of a press, ten of its last, and one at rest."""
    return np.repeat([REST, REST + early, REST + late, REST], [10, 10, 10, 1], axis=0)


@pytest.fixture
def judge() -> Judge:
    judge = Judge()
    for _ in range(LEARNT):
        judge.keep(np.array([PRESS, PRESS]), REST)
    return judge


def test_answers_are_those_of_a_press_alone() -> None:
    np.testing.assert_allclose(answers(readings(PRESS, 2 * PRESS), 10, 30), [PRESS, 2 * PRESS])
    holes = readings(PRESS, PRESS)
    holes[12:18, 0] = np.nan
    holes[:, 2] = np.nan
    np.testing.assert_allclose(answers(holes, 10, 30)[1], [0.1, -0.2, 0.0])
    assert np.isfinite(answers(readings(PRESS, PRESS)[9:13], 1, 2)).all()  # the shortest there is


def test_a_press_of_one_place_counts(judge: Judge) -> None:
    assert judge.fault_of(answers(readings(PRESS, 1.3 * PRESS), 10, 30)) == ""
    assert judge.fault_of(np.array([0.3 * PRESS, 0.3 * PRESS])) == ""


def test_a_weak_one_and_one_that_moved_do_not(judge: Judge) -> None:
    assert "weaker" in judge.fault_of(np.array([0.1 * PRESS, 0.1 * PRESS]))
    assert "changed" in judge.fault_of(answers(readings(PRESS, PRESS[::-1]), 10, 30))
    assert Judge().fault_of(np.array([0.1 * PRESS, 0.1 * PRESS])) == ""  # nobody knows yet what is weak


def test_what_is_no_touch_is_told(judge: Judge) -> None:
    pressed = REST + PRESS
    assert not judge.untouched(pressed, REST, held_s=5.0)
    assert judge.untouched(REST + 0.1 * PRESS, REST, held_s=2.0)
    assert not judge.untouched(REST + 0.1 * PRESS, REST, held_s=0.5)  # it may still be sinking in
    # Taken for a touch, but it began under a finger and ended where the pad rests.
    assert judge.untouched(REST + 0.2 * PRESS, pressed, held_s=0.5)
    assert not judge.untouched(pressed[::-1], pressed, held_s=0.5)


def test_the_rest_is_followed_where_nothing_touches(judge: Judge) -> None:
    drift = 0.8 * BACK * PRESS
    for step in range(1, 9):
        assert judge.touched(REST + step * drift) is False
    assert judge.touched(REST) is True
    judge.rest_anew()
    assert judge.touched(REST) is None
