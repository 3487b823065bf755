"""What the finder of presses is made of: looks, filters of levels, and how steps compare, against plain ways."""

import math
from itertools import pairwise, permutations

import numpy as np
import pytest

from sense.processing.kernels import level_tracking as levels
from sense.processing.kernels import pad_state
from sense.processing.kernels import press_detection as touches

FIBRES = 3
LOOK_S, FADE_S, GAP_S, MEMORY_S, NOISE_S = 0.03, 2.5, 1.0, 1.0, 10.0


class Trend:
    """The filter of one fibre as matrices: level and slope, their covariance in spreads, and what noise is learnt."""

    def __init__(self) -> None:
        self.state, self.covariance = np.full(2, np.nan), np.zeros((2, 2))
        self.noise = self.common = self.off = 0.0
        self.seen_s, self.spread, self.wander = -math.inf, 0.0, 0.0

    def advance(self, time_s: float, dt: float, looks: int, least: float) -> None:
        self.spread = (1 + 8 / max(looks, 1)) * max(self.noise, least)
        self.wander = max(self.common - self.noise**2 / 4, 0)
        if time_s - self.seen_s > GAP_S:
            self.state[0] = np.nan
        fade = math.exp(-dt / FADE_S)
        move = np.array([[1, FADE_S * (1 - fade)], [0, fade]])
        self.state = np.array([self.state[0] + move[0, 1] * self.state[1], fade * self.state[1]])  # NaN is a level
        self.covariance = move @ self.covariance @ move.T + np.diag([0, dt**2 / MEMORY_S**4])

    def follow(self, time_s: float, dt: float, looks: int, look: float) -> None:
        if np.isnan(look):
            return
        self.seen_s = time_s
        if np.isnan(self.state[0]):
            self.state, self.covariance, self.off = np.array([look, 0]), np.eye(2), 0.0
            return
        share = max(1 / (looks + 1), 1 - math.exp(-dt / NOISE_S))
        off, total = look - self.state[0], self.covariance[0, 0] + 1
        amount = math.sqrt(math.pi / 2) * abs(off) / math.sqrt(total)
        if looks >= 8:
            amount = min(amount, 3 * self.spread)
            off = float(np.clip(off, -2.5 * self.spread * math.sqrt(total), 2.5 * self.spread * math.sqrt(total)))
        self.noise += share * (amount - self.noise)
        self.common += share * (off * self.off - self.common)
        self.off = off
        gain = self.covariance[:, 0] / total
        self.state = self.state + gain * off
        self.covariance = self.covariance - np.outer(gain, self.covariance[0])


@pytest.mark.parametrize(("typical_v", "step_v"), [(0.0, math.inf), (0.5, math.inf), (0.0, 0.02)])
def test_levels_are_followed_as_by_a_filter_written_in_matrices(typical_v: float, step_v: float) -> None:
    """With looks of any distance, outliers, and a fibre that is missing for short and for long."""
    rng = np.random.default_rng(4)
    times = rng.uniform(0.03, 0.4, 60).cumsum()
    times[40:] += 3.0
    looks = 1 + 0.01 * rng.standard_normal((60, FIBRES)).cumsum(axis=0) + 0.02 * rng.standard_normal((60, FIBRES))
    looks[[12, 30, 50], 0] += (0.5, -0.8, 0.4)
    looks[20:22, 1], looks[35:48, 2] = np.nan, np.nan
    fibres, pad = pad_state.unknown(FIBRES)
    pad["typical_v"], pad["step_v"] = typical_v, step_v
    least = max(0.01 * typical_v, 1e-7, step_v / 2 if step_v < math.inf else 0)
    trends, last = [Trend() for _ in range(FIBRES)], -math.inf
    for number, (time_s, row) in enumerate(zip(times.tolist(), looks, strict=True)):
        dt = min(time_s - last, GAP_S)
        fibres["look"] = row
        levels.advance(fibres, pad, time_s)
        for trend in trends:
            trend.advance(time_s, dt, number, least)
        np.testing.assert_allclose(fibres["spread"], [trend.spread for trend in trends], rtol=1e-9)
        np.testing.assert_allclose(fibres["wander"], [trend.wander for trend in trends], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(fibres["level"], [trend.state[0] for trend in trends], rtol=1e-9)
        levels.follow(fibres, pad, time_s)
        for trend, look in zip(trends, row.tolist(), strict=True):
            trend.follow(time_s, dt, number, look)
        for name, of in (
            ("level", lambda trend: trend.state[0]),
            ("slope", lambda trend: trend.state[1]),
            ("level_var", lambda trend: trend.covariance[0, 0]),
            ("cross_var", lambda trend: trend.covariance[0, 1]),
            ("slope_var", lambda trend: trend.covariance[1, 1]),
            ("noise", lambda trend: trend.noise),
            ("common", lambda trend: trend.common),
        ):
            expected = [of(trend) for trend in trends]
            np.testing.assert_allclose(fibres[name], expected, rtol=1e-8, atol=1e-12, err_msg=name)
        pad["look_s"] = last = time_s
    assert pad["looks"] == 60


def test_looks_of_a_fast_converter_are_means_without_the_extremes() -> None:
    """At 220 Hz a look takes seven readings: with another its span would go beyond `LOOK_S`."""
    fibres, pad = pad_state.unknown(2)
    assert levels.take(fibres, pad, np.array([1.0, np.nan]), 0.0)  # nothing tells yet how fast readings come
    rng, count = np.random.default_rng(0), math.ceil(LOOK_S * 220)
    for first in (1, 1 + count):
        rows = rng.normal(2, 0.1, (count, 2))
        rows[3, 0], rows[1, 1] = 9.0, np.nan
        done = [bool(levels.take(fibres, pad, row, (first + i) / 220)) for i, row in enumerate(rows)]
        assert done == [False] * (count - 1) + [True]
        for fibre in (0, 1):
            kept = np.sort(rows[~np.isnan(rows[:, fibre]), fibre])[1:-1]
            assert fibres["look"][fibre] == pytest.approx(kept.mean())
        assert pad["look_first"] == first
    assert pad["reading"] == 1 + 2 * count


def test_looks_of_a_slow_converter_are_its_readings_and_tell_its_step() -> None:
    fibres, pad = pad_state.unknown(2)
    rows = np.array([[1.0, 2.0], [1.25, 2.0], [1.0, np.nan], [1.5, 2.0], [1.5, 2.125], [np.nan, np.nan]])
    for number, row in enumerate(rows):
        assert levels.take(fibres, pad, row, number / 14) == (number < 5)
        np.testing.assert_array_equal(fibres["look"], row)
    assert pad["step_v"] == 0.125
    assert pad["reading_s"] == 5 / 14
    np.testing.assert_array_equal(fibres["reading"], [1.5, 2.125])
    levels.take(fibres, pad, np.array([1.5 + 2e-8, 2.125]), 1.0)
    assert pad["step_v"] == 0.125


def followed(deviations: np.ndarray, spreads: np.ndarray, level_var: float = 0.0, wander: float = 0.0) -> tuple:
    """Fibres at level 1 that are looked at as often as there are rows of deviations; what `changes` says each time."""
    fibres, pad = pad_state.unknown(deviations.shape[1])
    fibres["spread"], fibres["noise"], fibres["level_var"] = spreads, spreads, level_var
    fibres["wander"], pad["looks"] = wander, 1000
    said = []
    for number, row in enumerate(deviations):
        fibres["level"], fibres["look"], pad["look_first"] = 1.0, 1.0 + row, number
        fibres["level_var"], fibres["wander"], fibres["spread"] = level_var, wander, spreads
        limits = np.array([0.0, 4.0, 6.0, 8.0]), np.array([0.0, 12.0, 15.0, 18.0])
        said.append(bool(levels.changes(fibres, pad, number * 0.07, *limits)))
    return said, fibres, pad


@pytest.mark.parametrize(("deviation", "runs"), [(1.99, 0), (2.01, 1), (-1.99, 0), (-2.01, 1)])
def test_a_look_leaves_the_levels_where_its_sum_of_squares_is_in_doubt(deviation: float, runs: int) -> None:
    said, _, pad = followed(np.array([[deviation * 0.1]]), np.array([0.1]))
    assert said == [False]
    assert pad["run"] == runs
    said, _, pad = followed(np.array([[deviation * 0.1 * math.sqrt(1 + 0.5 + 0.25)]]), np.array([0.1]), 0.5, 0.0025)
    assert pad["run"] == runs


@pytest.mark.parametrize(("second", "changed"), [(2.39, False), (2.41, True), (-2.41, False)])
def test_two_looks_that_agree_are_a_change_if_what_they_share_is_sure(second: float, changed: bool) -> None:
    """What 2.5 and 2.4 spreads have in common is their product, over the half variance of a mean of two: 12."""
    said, _, pad = followed(0.1 * np.array([[2.5], [second]]), np.array([0.1]))
    assert said == [False, changed]
    assert (pad["run"], pad["run_first"]) == (1 if second < 0 else 2, 0)  # a touch may begin with an odd look


def test_a_spike_is_no_change_and_looks_that_agree_with_no_other_are_given_up() -> None:
    said, fibres, pad = followed(0.1 * np.array([[50.0], [0.5], [0.0]]), np.array([0.1]))
    assert said == [False] * 3
    assert pad["run"] == 0
    assert fibres["level"][0] == pytest.approx(1.0, abs=0.01)
    wild = 0.1 * np.array([[9.0 * (-1) ** n] for n in range(30)])
    assert not any(followed(wild, np.array([0.1]))[0])


def test_what_looks_of_a_run_share_is_the_mean_product_of_two_of_them() -> None:
    rng = np.random.default_rng(1)
    looks, spreads = rng.normal(1, 0.6, (5, FIBRES)), np.array([0.2, 0.3, 0.4])
    fibres, pad = pad_state.unknown(FIBRES)
    fibres["spread"], fibres["level_var"], fibres["wander"] = spreads, (0.1, 0.2, 0.0), (0.0, 0.0, 0.01)
    fibres["run"], fibres["run_square"], pad["run"] = looks[0], looks[0] ** 2, 1
    for number in range(2, 6):
        fibres["deviation"] = looks[number - 1]
        agreeing, apart = levels._run_on(fibres, pad)
        shared = np.mean([looks[i] * looks[j] for i, j in permutations(range(number), 2)], axis=0)
        variance = spreads**2 * (1 / number + fibres["level_var"]) + fibres["wander"]
        away = (looks[number - 1] - looks[: number - 1].mean(axis=0)) / spreads
        assert agreeing == pytest.approx((shared / variance).sum())
        assert apart == pytest.approx((away**2).sum() / (1 + 1 / (number - 1)))
    means = fibres["run"] / 5
    fibres["deviation"] = (np.nan, *looks[0, 1:])
    levels._run_on(fibres, pad)
    assert fibres["run"][0] / 6 == pytest.approx(means[0])  # a missing look stands for the mean of the others


def test_the_noise_of_a_run_and_of_unrest() -> None:
    fibres, pad = pad_state.unknown(2)
    fibres["noise"], fibres["spread"] = (0.1, 0.01), (0.1, 0.01)
    fibres["run_square"], pad["run"], pad["run_s"] = (0.12, 0.12), 3, 2.0
    levels.learn_run(fibres, pad, 3.0)
    share = 1 - math.exp(-1 / NOISE_S)
    np.testing.assert_allclose(fibres["noise"], [0.1 + share * 0.1, 0.01 + share * 0.02])
    fibres["noise"], fibres["look"], fibres["before"] = 0.1, (1.3, 1.0), (1.0, 1.05)
    levels.learn_unrest(fibres)
    np.testing.assert_allclose(fibres["noise"], [(0.1 + 0.3 * math.sqrt(math.pi) / 2) / 2, 0.1])


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
    assert touches._size(fibres, step) == pytest.approx(1.9**2 + 3**2 + 40**2)
    assert touches._counted_size(fibres, step) == pytest.approx(1.9**2 + 3**2 + 20**2)
    assert touches._counted_size(fibres, -step) == pytest.approx(1.9**2 + 3**2 + 20**2)
    fibres = pressed(deviation=0.1 * np.array([9.0, 3.8, -6.0, -40.0, 5.0]))
    assert touches._share(fibres, step) == pytest.approx((-1.9 * 3.8 - 3 * 6 - 20 * 20) / (1.9**2 + 3**2 + 20**2))
    assert touches._share(fibres, np.zeros(5)) == 0


def test_agreement_is_one_along_the_way_of_touches_and_minus_one_against_it() -> None:
    way = np.array([5.0, -2.0, 0.0, 10.0, 3.0])
    assert touches._agreement(pressed(way=way, deviation=0.3 * np.sign(way))) == pytest.approx(1)
    assert touches._agreement(pressed(way=way, deviation=-0.3 * np.sign(way))) == pytest.approx(-1)
    mixed = pressed(way=way, deviation=0.1 * np.array([4.0, 6.0, 9.0, 1.0, 30.0]))
    against = (16 * 5 - 36 * 2 + 400 * 3) / (16 * 5 + 36 * 2 + 400 * 3)
    assert touches._agreement(mixed) == pytest.approx(against)
    assert touches._agreement(pressed(deviation=1.0)) == 0


def test_where_a_change_went_farthest_two_looks_have_it() -> None:
    fibres, (_, pad) = pressed(origin=1.0), pad_state.unknown(5)
    path = [(1.0, 9), (1.5, 10), (2.0, 11), (9.0, 12), (1.8, 13), (1.2, 14)]
    for (before, _), (look, reading) in pairwise(path):
        fibres["before"], fibres["look"], fibres["deviation"] = before, look, look - 1.0
        pad["look_first"] = reading
        touches._go_far(fibres, pad, reading / 14)
    np.testing.assert_allclose(fibres["farthest"], 1.0)  # 2.0 and 9.0 share 1.0; 9.0 alone may be a spike
    assert pad["farthest"] == pytest.approx(5 * 10**2)
    assert (pad["farthest_s"], pad["after_farthest"]) == (12 / 14, 13)
    assert touches._common(pressed(deviation=-0.4, before=0.5, origin=1.0)[0]) == pytest.approx(-0.4)
    assert touches._common(pressed(deviation=-0.4, before=1.5, origin=1.0)[0]) == 0


@pytest.mark.parametrize(("apart", "settled"), [(0.98, True), (1.02, False)])
def test_a_change_has_settled_when_two_looks_differ_by_a_tenth_of_it_or_by_chance(apart: float, settled: bool) -> None:
    """Half of five squares of differences is held against a hundredth of half the size, or against what is in doubt."""
    doubt = np.array([0, 1, 2, 3, 4, 5.0])
    small = pressed(look=2.0, before=2.0 - apart * 0.1 * math.sqrt(2), deviation=0.2)
    assert touches._settled(small, doubt) == settled
    large = pressed(look=2.0, before=2.0 - apart * 0.5, deviation=5.0)
    assert touches._settled(large, doubt) == settled


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
        touches._learn(fibres, pad)
        assert pad["presses"] == press
        np.testing.assert_allclose(fibres["way"], way, rtol=1e-9)
        np.testing.assert_allclose([pad["agreement"], pad["typical_v"]], [agreement, typical_v], rtol=1e-9)
        np.testing.assert_allclose(pad["typical_size"], typical_size, rtol=1e-9)


def test_the_way_from_the_last_rest_is_counted_and_the_present_one_kept() -> None:
    fibres = pressed(look=(1.0, 2.0, np.nan, 4.0, 5.0))
    last = np.array([0.5, np.nan, 3.0, 4.05, 9.0])
    assert touches._way_from(fibres, last) == pytest.approx(5**2 + 20**2)
    np.testing.assert_array_equal(last, [1.0, 2.0, 3.0, 4.0, 5.0])


def test_the_step_of_a_press_is_its_deviation_besides_a_share_of_what_it_was() -> None:
    fibres = pressed(press=1.0, deviation=(0.5, np.nan, -0.25, 0.0, 2.0))
    touches._press(fibres, 1.0)
    np.testing.assert_array_equal(fibres["press"], [1.5, 1.0, 0.75, 1.0, 3.0])
    touches._press(fibres, 0.0)
    np.testing.assert_array_equal(fibres["press"], [0.5, 0.0, -0.25, 0.0, 2.0])


Known = dict[str, float]


@pytest.mark.parametrize(
    ("known", "deviation", "press", "told", "events"),
    [
        ({"state": touches.FREE}, 1.0, 0.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.FREE, "presses": 3, "agreement": 0.6}, 1.0, 0.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.FREE, "presses": 3, "agreement": 0.6}, -1.0, 0.0, touches.NOTHING, []),
        ({"state": touches.FREE, "presses": 2, "agreement": 0.6}, -1.0, 0.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.FREE, "presses": 3, "agreement": 0.5}, -1.0, 0.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.FREE, "released_s": 9.1}, -0.8, 1.0, touches.MORE, []),
        ({"state": touches.FREE, "released_s": 8.9}, -0.8, 1.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.FREE, "released_s": 9.1}, 0.8, 1.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.PRESSED}, -0.52, 1.0, touches.RELEASE, [(0, 7)]),
        ({"state": touches.PRESSED}, -0.48, 1.0, touches.NOTHING, []),
        ({"state": touches.PRESSED}, 0.8, 1.0, touches.NOTHING, []),
        ({"state": touches.ODD, "odd_first": 3}, -1.0, 1.0, touches.RELEASE, [(1, 3), (0, 7)]),
        ({"state": touches.ODD, "odd_first": 3}, 1.0, 1.0, touches.TOUCH, [(1, 7)]),
        ({"state": touches.ODD, "odd_first": 3}, -0.48, 1.0, touches.TOUCH, [(1, 7)]),
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
    count = touches._judge(fibres, pad, 10.0, True, found, 0)
    assert [tuple(event) for event in found[:count].tolist()] == events
    assert pad["told"] == told


def test_an_odd_change_waits_until_it_has_settled() -> None:
    fibres, (_, pad) = pressed(way=10.0, deviation=1.0, press=1.0), pad_state.unknown(5)
    pad["state"] = touches.ODD
    assert touches._judge(fibres, pad, 10.0, False, np.zeros((4, 2), np.int64), 0) == 0


def test_a_touch_that_has_gone_back_by_more_than_half_was_a_tap() -> None:
    for deviation, state, count in ((0.49, touches.FREE, 1), (0.51, touches.PRESSED, 0)):
        fibres, (_, pad) = pressed(farthest=1.0, deviation=deviation, look=2.0), pad_state.unknown(5)
        pad["told"], pad["after_farthest"] = touches.TOUCH, 12
        events = np.zeros((4, 2), np.int64)
        assert touches._conclude(fibres, pad, 10.0, events, 0) == count
        assert pad["state"] == state
        assert events[0].tolist() == ([0, 12] if count else [0, 0])


def test_a_release_frees_the_pad_and_what_is_not_understood_is_odd() -> None:
    fibres, (_, pad) = pressed(deviation=-1.0, look=2.0), pad_state.unknown(5)
    pad["state"], pad["told"] = touches.PRESSED, touches.RELEASE
    touches._conclude(fibres, pad, 10.0, np.zeros((4, 2), np.int64), 0)
    assert (pad["state"], pad["released_s"]) == (touches.FREE, 10.0)
    np.testing.assert_array_equal(fibres["rest"], 2.0)
    pad["told"], pad["run_first"] = touches.NOTHING, 33
    touches._conclude(fibres, pad, 11.0, np.zeros((4, 2), np.int64), 0)
    assert (pad["state"], pad["odd_first"]) == (touches.ODD, 33)
    np.testing.assert_array_equal(fibres["press"], -1.0)


@pytest.mark.parametrize(("deviation", "press"), [(0.9, 1.9), (1.1, 1.1), (-1.1, -1.1)])
def test_pressed_deeper_adds_to_the_step_and_elsewhere_is_a_step_of_its_own(deviation: float, press: float) -> None:
    fibres, (_, pad) = pressed(deviation=deviation, press=1.0), pad_state.unknown(5)
    pad["state"], pad["told"] = touches.PRESSED, touches.NOTHING
    touches._conclude(fibres, pad, 10.0, np.zeros((4, 2), np.int64), 0)
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
    pad["told"], pad["presses"], pad["typical_size"] = touches.TOUCH, presses, size
    pad["rest_spread"], pad["held_spread"] = rest, held / 0.85
    touches._conclude(fibres, pad, 10.0, np.zeros((4, 2), np.int64), 0)
    assert (pad["presses"] == 0) == turned
    assert pad["state"] == (touches.FREE if turned else touches.PRESSED)
