"""How steps compare, and how a change is judged to be a touch, a release or neither."""

import math
from itertools import pairwise

import numpy as np
import pytest

from sense.recordings.processing.kernels import pad_state, press_detection


def pressed(**values: object) -> np.ndarray:
    """Five fibres of spread 0.1 V of which some numbers are known."""
    fibres, _ = pad_state.unknown(5)
    fibres["spread"] = 0.1
    for name, value in values.items():
        fibres[name] = value
    return fibres


def test_steps_compare_in_spreads_that_count_up_to_a_limit() -> None:
    """Of five fibres the largest is by chance below sqrt(2 ln 5) = 1.79 spreads; beyond 20 none counts more."""
    step = 0.1 * np.array([1.7, -1.9, 3.0, 40.0, np.nan])
    fibres = pressed()
    assert press_detection._size(fibres, step) == pytest.approx(1.9**2 + 3**2 + 40**2)
    assert press_detection._counted_size(fibres, step) == pytest.approx(1.9**2 + 3**2 + 20**2)
    assert press_detection._counted_size(fibres, -step) == pytest.approx(1.9**2 + 3**2 + 20**2)
    fibres = pressed(deviation=0.1 * np.array([9.0, 3.8, -6.0, -40.0, 5.0]))
    assert press_detection._share(fibres, step) == pytest.approx(
        (-1.9 * 3.8 - 3 * 6 - 20 * 20) / (1.9**2 + 3**2 + 20**2)
    )
    assert press_detection._share(fibres, np.zeros(5)) == 0


def test_agreement_is_one_along_the_way_of_touches_and_minus_one_against_it() -> None:
    way = np.array([5.0, -2.0, 0.0, 10.0, 3.0])
    assert press_detection._agreement(pressed(way=way, deviation=0.3 * np.sign(way))) == pytest.approx(1)
    assert press_detection._agreement(pressed(way=way, deviation=-0.3 * np.sign(way))) == pytest.approx(-1)
    mixed = pressed(way=way, deviation=0.1 * np.array([4.0, 6.0, 9.0, 1.0, 30.0]))
    against = (16 * 5 - 36 * 2 + 400 * 3) / (16 * 5 + 36 * 2 + 400 * 3)
    assert press_detection._agreement(mixed) == pytest.approx(against)
    assert press_detection._agreement(pressed(deviation=1.0)) == 0


def test_where_a_change_went_farthest_two_looks_have_it() -> None:
    fibres, (_, pad) = pressed(origin=1.0), pad_state.unknown(5)
    path = [(1.0, 9), (1.5, 10), (2.0, 11), (9.0, 12), (1.8, 13), (1.2, 14)]
    for (before, _), (look, reading) in pairwise(path):
        fibres["before"], fibres["look"], fibres["deviation"] = before, look, look - 1.0
        pad["look_first"] = reading
        press_detection._go_far(fibres, pad, reading / 14)
    np.testing.assert_allclose(fibres["farthest"], 1.0)  # 2.0 and 9.0 share 1.0; 9.0 alone may be a spike
    assert pad["farthest"] == pytest.approx(5 * 10**2)
    assert (pad["farthest_s"], pad["after_farthest"]) == (12 / 14, 13)
    assert press_detection._common(pressed(deviation=-0.4, before=0.5, origin=1.0)[0]) == pytest.approx(-0.4)
    assert press_detection._common(pressed(deviation=-0.4, before=1.5, origin=1.0)[0]) == 0


@pytest.mark.parametrize(("apart", "settled"), [(0.98, True), (1.02, False)])
def test_a_change_has_settled_when_two_looks_differ_by_a_tenth_of_it_or_by_chance(apart: float, settled: bool) -> None:
    """Half of five squares of differences is held against a hundredth of half the size, or against what is in doubt."""
    doubt = np.array([0, 1, 2, 3, 4, 5.0])
    small = pressed(look=2.0, before=2.0 - apart * 0.1 * math.sqrt(2), deviation=0.2)
    assert press_detection._settled(small, doubt) == settled
    large = pressed(look=2.0, before=2.0 - apart * 0.5, deviation=5.0)
    assert press_detection._settled(large, doubt) == settled


def test_what_is_known_of_touches_is_their_mean_and_later_that_of_the_recent_ones() -> None:
    """Steps of 5 spreads and less count for their way and size, but not for the step of a press in volts."""
    rng = np.random.default_rng(3)
    fibres, (_, pad) = pressed(), pad_state.unknown(5)
    way, agreement, typical_v, typical_size = np.zeros(5), 0.0, 0.0, 0.0
    for press in range(1, 31):
        z = np.array([8.0, 4.0, -3.0, 25.0, 1.0]) + rng.uniform(-0.5, 0.5, 5)
        counted = np.where(np.abs(z) > math.sqrt(2 * math.log(5)), np.clip(z, -20, 20), 0)
        along = (counted * np.abs(counted) * way).sum() / max((counted**2 * np.abs(way)).sum(), 1e-9)
        if press > 1:
            agreement += max(1 / (press - 1), 0.05) * (along - agreement)
        share = max(1 / press, 0.05)
        way = way + share * (counted - way)
        typical_v += share * (0.1 * math.hypot(z[0], z[3]) - typical_v)
        typical_size += share * ((counted**2).sum() - typical_size)
        fibres["deviation"] = 0.1 * z
        press_detection._learn(fibres, pad)
        assert pad["presses"] == press
        np.testing.assert_allclose(fibres["way"], way, rtol=1e-9)
        np.testing.assert_allclose([pad["agreement"], pad["typical_v"]], [agreement, typical_v], rtol=1e-9)
        np.testing.assert_allclose(pad["typical_size"], typical_size, rtol=1e-9)


def test_the_way_from_the_last_rest_is_counted_and_the_present_one_kept() -> None:
    fibres = pressed(look=(1.0, 2.0, np.nan, 4.0, 5.0))
    last = np.array([0.5, np.nan, 3.0, 4.05, 9.0])
    assert press_detection._way_from(fibres, last) == pytest.approx(5**2 + 20**2)
    np.testing.assert_array_equal(last, [1.0, 2.0, 3.0, 4.0, 5.0])


def test_the_step_of_a_press_is_its_deviation_besides_a_share_of_what_it_was() -> None:
    fibres = pressed(press=1.0, deviation=(0.5, np.nan, -0.25, 0.0, 2.0))
    press_detection._press(fibres, 1.0)
    np.testing.assert_array_equal(fibres["press"], [1.5, 1.0, 0.75, 1.0, 3.0])
    press_detection._press(fibres, 0.0)
    np.testing.assert_array_equal(fibres["press"], [0.5, 0.0, -0.25, 0.0, 2.0])


Known = dict[str, float]


@pytest.mark.parametrize(
    ("known", "deviation", "press", "told", "events"),
    [
        ({"state": press_detection.FREE}, 1.0, 0.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.FREE, "presses": 3, "agreement": 0.6}, 1.0, 0.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.FREE, "presses": 3, "agreement": 0.6}, -1.0, 0.0, press_detection.NOTHING, []),
        ({"state": press_detection.FREE, "presses": 2, "agreement": 0.6}, -1.0, 0.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.FREE, "presses": 3, "agreement": 0.5}, -1.0, 0.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.FREE, "released_s": 9.1}, -0.8, 1.0, press_detection.MORE, []),
        ({"state": press_detection.FREE, "released_s": 8.9}, -0.8, 1.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.FREE, "released_s": 9.1}, 0.8, 1.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.PRESSED}, -0.52, 1.0, press_detection.RELEASE, [(0, 7)]),
        ({"state": press_detection.PRESSED}, -0.48, 1.0, press_detection.NOTHING, []),
        ({"state": press_detection.PRESSED}, 0.8, 1.0, press_detection.NOTHING, []),
        ({"state": press_detection.ODD, "odd_first": 3}, -1.0, 1.0, press_detection.RELEASE, [(1, 3), (0, 7)]),
        ({"state": press_detection.ODD, "odd_first": 3}, 1.0, 1.0, press_detection.TOUCH, [(1, 7)]),
        ({"state": press_detection.ODD, "odd_first": 3}, -0.48, 1.0, press_detection.TOUCH, [(1, 7)]),
    ],
)
def test_a_change_is_judged_by_state_way_and_step(
    known: Known, deviation: float, press: float, told: int, events: list[tuple[int, int]]
) -> None:
    fibres, (_, pad) = pressed(way=10.0, deviation=deviation, press=press), pad_state.unknown(5)
    pad["run_first"], pad["released_s"] = 7, -np.inf
    for name, value in known.items():
        pad[name] = value
    found = np.zeros((4, 2), np.int64)
    count = press_detection._judge(fibres, pad, 10.0, True, found, 0)
    assert [tuple(event) for event in found[:count].tolist()] == events
    assert pad["told"] == told


def test_an_odd_change_waits_until_it_has_settled() -> None:
    fibres, (_, pad) = pressed(way=10.0, deviation=1.0, press=1.0), pad_state.unknown(5)
    pad["state"] = press_detection.ODD
    assert press_detection._judge(fibres, pad, 10.0, False, np.zeros((4, 2), np.int64), 0) == 0


def test_a_touch_that_has_gone_back_by_more_than_half_was_a_tap() -> None:
    for deviation, state, count in ((0.49, press_detection.FREE, 1), (0.51, press_detection.PRESSED, 0)):
        fibres, (_, pad) = pressed(farthest=1.0, deviation=deviation, look=2.0), pad_state.unknown(5)
        pad["told"], pad["after_farthest"] = press_detection.TOUCH, 12
        events = np.zeros((4, 2), np.int64)
        assert press_detection._conclude(fibres, pad, 10.0, events, 0) == count
        assert pad["state"] == state
        assert events[0].tolist() == ([0, 12] if count else [0, 0])


def test_a_release_frees_the_pad_and_what_is_not_understood_is_odd() -> None:
    fibres, (_, pad) = pressed(deviation=-1.0, look=2.0), pad_state.unknown(5)
    pad["state"], pad["told"] = press_detection.PRESSED, press_detection.RELEASE
    press_detection._conclude(fibres, pad, 10.0, np.zeros((4, 2), np.int64), 0)
    assert (pad["state"], pad["released_s"]) == (press_detection.FREE, 10.0)
    np.testing.assert_array_equal(fibres["rest"], 2.0)
    pad["told"], pad["run_first"] = press_detection.NOTHING, 33
    press_detection._conclude(fibres, pad, 11.0, np.zeros((4, 2), np.int64), 0)
    assert (pad["state"], pad["odd_first"]) == (press_detection.ODD, 33)
    np.testing.assert_array_equal(fibres["press"], -1.0)


@pytest.mark.parametrize(("deviation", "press"), [(0.9, 1.9), (1.1, 1.1), (-1.1, -1.1)])
def test_pressed_deeper_adds_to_the_step_and_elsewhere_is_a_step_of_its_own(deviation: float, press: float) -> None:
    fibres, (_, pad) = pressed(deviation=deviation, press=1.0), pad_state.unknown(5)
    pad["state"], pad["told"] = press_detection.PRESSED, press_detection.NOTHING
    press_detection._conclude(fibres, pad, 10.0, np.zeros((4, 2), np.int64), 0)
    np.testing.assert_allclose(fibres["press"], press)


@pytest.mark.parametrize(
    ("presses", "rest", "held", "size", "turned"),
    [
        (2, 50.0, 1.0, 100.0, True),
        (1, 50.0, 1.0, 100.0, False),
        (2, 38.0, 1.0, 100.0, False),
        (2, 42.0, 1.0, 100.0, True),
        (2, 50.0, 48.0, 100.0, False),
        (2, 50.0, 40.0, 100.0, True),
    ],
)
def test_a_pad_whose_rests_differ_more_than_its_presses_was_taken_the_wrong_way_round(
    presses: int, rest: float, held: float, size: float, turned: bool
) -> None:
    """More than 1.2 times what levels under presses do, and than 0.4 of a typical press of size 100."""
    deviation = math.sqrt(size / 5) * 0.1
    fibres, (_, pad) = pressed(deviation=deviation, farthest=deviation, look=2.0, held=2.0), pad_state.unknown(5)
    pad["told"], pad["presses"], pad["typical_size"] = press_detection.TOUCH, presses, size
    pad["rest_spread"], pad["held_spread"] = rest, held / 0.85
    press_detection._conclude(fibres, pad, 10.0, np.zeros((4, 2), np.int64), 0)
    assert (pad["presses"] == 0) == turned
    assert pad["state"] == (press_detection.FREE if turned else press_detection.PRESSED)
