"""What a person is asked for, which presses count, and why others do not."""

import numpy as np
import pytest

from padforge.sense.rig.by_hand_presses import BACK, LEARNT, SEEN_S, SETTLE_S, Judge, Turns, answers

PLACES = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
REST = np.array([2.0, 1.8, 1.9])
PRESS = np.array([0.1, -0.2, 0.2])


@pytest.fixture
def turns() -> Turns:
    """Ready for the first press, at 100 s."""
    return Turns(PLACES, 1.0, 100.0 - SETTLE_S)


def press(turns: Turns, down_s: float, up_s: float) -> str:
    turns.touch(down_s)
    return turns.release(up_s)


def test_a_person_is_asked_step_by_step(turns: Turns) -> None:
    assert [turns.phase(at_s) for at_s in (98.5, 100.0)] == ["settle", "press"]
    assert turns.touch(100.5) == (1.0, 2.0)
    assert [turns.phase(at_s) for at_s in (101.4, 101.5)] == ["hold", "lift"]
    assert turns.progress(101.0) == pytest.approx(0.5)
    assert turns.release(101.7) == ""
    turns.keep(101.8)
    assert (turns.kept, turns.target, turns.following, turns.left) == ([(1.0, 2.0)], (3.0, 4.0), (5.0, 6.0), 2)
    assert [turns.phase(at_s) for at_s in (102.6, 102.7)] == ["wait", "press"]
    for down_s in (103.0, 106.0):
        assert press(turns, down_s, down_s + 1) == ""
        turns.keep(down_s + 1.1)
    assert turns.target is None
    assert [turns.phase(at_s) for at_s in (107.9, 108.0)] == ["wait", "done"]
    turns.skip(108.1)
    assert turns.touch(110.0) is None
    assert turns.release(111.0) == "it came before it was asked for"


@pytest.mark.parametrize(
    ("down_s", "up_s", "fault"),
    [
        (99.9, 101.0, "it came before it was asked for"),
        (100.0, 100.7, "it was held for 0.7 s, hold it for 1.0 s"),
        (100.0, 104.1, "it was held for 4.1 s, lift after 1.0 s"),
        (100.0, 100.85, ""),
    ],
)
def test_a_press_that_was_not_asked_for_does_not_count(turns: Turns, down_s: float, up_s: float, fault: str) -> None:
    assert press(turns, down_s, up_s) == fault
    assert turns.target == (1.0, 2.0)
    assert turns.phase(up_s + 0.9) == "wait"


def test_a_place_counts_only_once_it_could_be_seen(turns: Turns) -> None:
    """However long the pad has been at rest: the press was on its way to the place before."""
    turns.skip(110.0)
    assert turns.touch(110.0 + SEEN_S / 2) is None
    turns.release(112.0)
    turns.skip(120.0)
    assert turns.touch(120.0 + SEEN_S) == (5.0, 6.0)


def test_what_was_wrong_is_taken_back(turns: Turns) -> None:
    assert not turns.take_back(100.0)  # there is nothing
    press(turns, 100.0, 101.0)
    turns.keep(101.1)
    assert turns.take_back(101.2)
    assert (turns.target, turns.kept) == ((1.0, 2.0), [])
    turns.touch(110.0)
    assert not turns.take_back(110.5)  # the press under way
    assert turns.phase(110.6) == "lift"
    assert turns.release(111.0) == "it was taken back"
    turns.touch(120.0)
    turns.skip(120.5)
    assert turns.release(121.0) == "its place was skipped"
    assert turns.target == (3.0, 4.0)


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


def test_a_weak_press_one_that_moved_and_what_is_no_touch_do_not_count(judge: Judge) -> None:
    weak, pressed = np.array([0.1 * PRESS, 0.1 * PRESS]), REST + PRESS
    assert judge.fault_of(answers(readings(PRESS, 1.3 * PRESS), 10, 30)) == judge.fault_of(3 * weak) == ""
    assert "weaker" in judge.fault_of(weak)
    assert "changed" in judge.fault_of(answers(readings(PRESS, PRESS[::-1]), 10, 30))
    assert Judge().fault_of(weak) == ""  # nobody knows yet what is weak
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
