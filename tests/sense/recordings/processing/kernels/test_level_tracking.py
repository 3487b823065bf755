"""Looks at the readings and the filters of levels, against plain ways."""

import math
from itertools import permutations

import numpy as np
import pytest

from sense.recordings.processing.kernels import level_tracking, pad_state

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
        level_tracking.advance(fibres, pad, time_s)
        for trend in trends:
            trend.advance(time_s, dt, number, least)
        np.testing.assert_allclose(fibres["spread"], [trend.spread for trend in trends], rtol=1e-9)
        np.testing.assert_allclose(fibres["wander"], [trend.wander for trend in trends], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(fibres["level"], [trend.state[0] for trend in trends], rtol=1e-9)
        level_tracking.follow(fibres, pad, time_s)
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
    assert level_tracking.take(fibres, pad, np.array([1.0, np.nan]), 0.0)  # nothing tells yet how fast readings come
    rng, count = np.random.default_rng(0), math.ceil(LOOK_S * 220)
    for first in (1, 1 + count):
        rows = rng.normal(2, 0.1, (count, 2))
        rows[3, 0], rows[1, 1] = 9.0, np.nan
        done = [bool(level_tracking.take(fibres, pad, row, (first + i) / 220)) for i, row in enumerate(rows)]
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
        assert level_tracking.take(fibres, pad, row, number / 14) == (number < 5)
        np.testing.assert_array_equal(fibres["look"], row)
    assert pad["step_v"] == 0.125
    assert pad["reading_s"] == 5 / 14
    np.testing.assert_array_equal(fibres["reading"], [1.5, 2.125])
    level_tracking.take(fibres, pad, np.array([1.5 + 2e-8, 2.125]), 1.0)
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
        said.append(bool(level_tracking.changes(fibres, pad, number * 0.07, *limits)))
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
        agreeing, apart = level_tracking._run_on(fibres, pad)
        shared = np.mean([looks[i] * looks[j] for i, j in permutations(range(number), 2)], axis=0)
        variance = spreads**2 * (1 / number + fibres["level_var"]) + fibres["wander"]
        away = (looks[number - 1] - looks[: number - 1].mean(axis=0)) / spreads
        assert agreeing == pytest.approx((shared / variance).sum())
        assert apart == pytest.approx((away**2).sum() / (1 + 1 / (number - 1)))
    means = fibres["run"] / 5
    fibres["deviation"] = (np.nan, *looks[0, 1:])
    level_tracking._run_on(fibres, pad)
    assert fibres["run"][0] / 6 == pytest.approx(means[0])  # a missing look stands for the mean of the others


def test_the_noise_of_a_run_and_of_unrest() -> None:
    fibres, pad = pad_state.unknown(2)
    fibres["noise"], fibres["spread"] = (0.1, 0.01), (0.1, 0.01)
    fibres["run_square"], pad["run"], pad["run_s"] = (0.12, 0.12), 3, 2.0
    level_tracking.learn_run(fibres, pad, 3.0)
    share = 1 - math.exp(-1 / NOISE_S)
    np.testing.assert_allclose(fibres["noise"], [0.1 + share * 0.1, 0.01 + share * 0.02])
    fibres["noise"], fibres["look"], fibres["before"] = 0.1, (1.3, 1.0), (1.0, 1.05)
    level_tracking.learn_unrest(fibres)
    np.testing.assert_allclose(fibres["noise"], [(0.1 + 0.3 * math.sqrt(math.pi) / 2) / 2, 0.1])


def test_levels_are_followed_as_a_kalman_filter_does() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.05, 0.2, 300))
    looks = 2 + 0.005 * np.sin(times / 3) + 0.002 * rng.standard_normal(300)
    fibres, pad = pad_state.unknown(1)
    mean, covariance = np.zeros(2), np.zeros((2, 2))
    for at, time_s in enumerate(times.tolist()):
        level_tracking.advance(fibres, pad, time_s)
        if at > 0:
            dt = time_s - times[at - 1]
            fade = np.exp(-dt / level_tracking.FADE_S)
            move = np.array([[1, level_tracking.FADE_S * (1 - fade)], [0, fade]])
            mean = move @ mean
            covariance = move @ covariance @ move.T + np.diag([0, dt**2 / level_tracking.MEMORY_S**4])
            assert fibres["level"][0] == pytest.approx(mean[0], abs=1e-12)
            gain = covariance[:, 0] / (covariance[0, 0] + 1)
            limit = level_tracking.OUTLIER * fibres["spread"][0] * np.sqrt(covariance[0, 0] + 1)
            off = looks[at] - mean[0]
            mean = mean + gain * (np.clip(off, -limit, limit) if pad["looks"] >= level_tracking.FIRST_LOOKS else off)
            covariance = covariance - np.outer(gain, covariance[0])
        else:
            mean, covariance = np.array([looks[0], 0.0]), np.eye(2)
        fibres["look"] = looks[at]
        level_tracking.follow(fibres, pad, time_s)
        pad["look_s"] = time_s
        assert fibres["level"][0] == pytest.approx(mean[0], abs=1e-12)
        assert fibres["slope"][0] == pytest.approx(mean[1], abs=1e-12)
        assert fibres["slope_var"][0] == pytest.approx(covariance[1, 1])
    assert fibres["noise"][0] == pytest.approx(0.002, rel=0.25)
