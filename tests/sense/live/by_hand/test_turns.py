import numpy as np
import pytest

from sense.live.by_hand.turns import SEEN_S, SETTLE_S, Turns

PLACES = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])


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


def test_nothing_is_asked_for_once_all_is_done() -> None:
    turns = Turns(PLACES[:1], 1.0, 0.0)
    turns.skip(5.0)
    turns.skip(5.1)
    assert turns.touch(10.0) is None
    assert turns.release(11.0) == "it came before it was asked for"
