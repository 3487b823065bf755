"""How high sums of likelihood ratios climb by chance, and what height names a fibre."""

import math

import numpy as np
import pytest

from sense.health import alarm_thresholds
from sense.health.alarm_thresholds import Tail, climb
from tests.sense.health.pads import (
    Array,
)


def test_peaks_are_the_greatest_heights_of_climbs() -> None:
    assert alarm_thresholds._peaks(np.array([0.0, 1, 3, 2, 0, 0, 5, 0, 0.5])).tolist() == [3, 5, 0.5]
    assert alarm_thresholds._peaks(np.array([2.0, 1, 0])).tolist() == [2]
    assert alarm_thresholds._peaks(np.zeros(4)).tolist() == []


def test_a_tail_is_read_by_the_number_of_fibres_lost() -> None:
    tail = Tail(level=np.array([[1.0, 2.0], [3.0, 4.0]]), slope=np.array([[1.0, 2.0], [2.0, 4.0]]))
    heights = np.array([[5.0, 8.0]])
    np.testing.assert_allclose(tail.rarity(heights, 0), [[4.0, 3.0]])
    np.testing.assert_allclose(tail.rarity(heights, 1), [[1.0, 1.0]])
    np.testing.assert_allclose(tail.rarity(heights, 7), [[1.0, 1.0]])


def test_the_slope_of_a_tail_is_the_mean_excess_of_the_highest_tenth() -> None:
    """400 climbs of one press each to known heights, of which the level makes the highest no rarer than once."""
    heights = np.random.default_rng(0).permutation(np.linspace(0.1, 40, 400))
    ratios = np.full((1000, 1, 1), -100.0)
    ratios[: 2 * 400 : 2, 0, 0] = heights
    tail = Tail.fit([(ratios, ratios)])
    top = np.sort(heights)
    slope = (top[-40:] - top[-41]).mean()
    assert tail.slope[0, 0] == pytest.approx(slope)
    levels = [top[-41] + slope * math.log(40 / 1000), top[-1] + slope * math.log(1 / 1000)]
    assert tail.level[0, 0] == pytest.approx(max(levels))
    assert Tail.fit([(-ratios * 0 - 1, -ratios * 0 - 1)]).slope[0, 0] == 1


def test_a_climb_is_the_best_sum_over_all_beginnings() -> None:
    rng = np.random.default_rng(3)
    stay, begin = rng.normal(-0.3, 1, (2, 40))
    height = np.zeros(())
    for press in range(40):
        height = climb(height, stay[press], begin[press])
        sums = [begin[first] + stay[first + 1 : press + 1].sum() for first in range(press + 1)]
        # Having begun worth nothing before the first press is as good as any beginning.
        none = [stay[first : press + 1].sum() for first in range(press + 2)]
        assert height == pytest.approx(max(0.0, *sums, *none))


def test_the_tail_of_exact_ratios_is_known_and_leads_to_the_rate_of_false_alarms() -> None:
    def ratios(presses: int, seed: int) -> Array:
        """Of a mean of 1 against 0, for numbers of mean 0."""
        return np.random.default_rng(seed).standard_normal((presses, 3, 1)) - 0.5

    learnt = ratios(20_000, 0)
    tail = Tail.fit([(learnt, learnt)])
    # Exact likelihood ratios climb to h with a chance of about exp(-h) (Wald).
    assert tail.slope[0, 0] == pytest.approx(1, abs=0.15)
    threshold = tail.level[0] + tail.slope[0] * np.log(1 / 1e-3)
    height, alarms = np.zeros((3, 1)), 0
    for press in ratios(100_000, 1):
        height = climb(height, press, press)
        alarms += int((height > threshold).sum())
        height = np.where(height > threshold, 0.0, height)
    # A hundred are allowed; the level is on the safe side by a factor of ten at most.
    assert 10 <= alarms <= 100
