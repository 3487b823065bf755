"""The sample clock against simulated truth: jitter, stalls, a board that is off by up to 200 ppm and drifts."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from padforge.sense.rig.boards.board_reader import SampleClock

SETTLE_S = 0.5
QUARTZ_SKEW = 500e-6  # relative difference of two quartz clocks


@dataclass(frozen=True)
class Link:
    """Blocks of `block` samples at `rate_hz` for `seconds` from a board whose period is `skew` too long."""

    rate_hz: float
    block: int
    seconds: float
    skew: float
    seed: int
    jitter_s: float = 8e-3
    stall_s: float = 50e-3

    def blocks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the index of the last sample of each block, when it was measured, and when it arrived."""
        rng = np.random.default_rng(self.seed)
        last = (np.arange(int(self.seconds * self.rate_hz / self.block)) + 1) * self.block - 1
        nominal = last / self.rate_hz
        warming = 20e-6 * 300 * (1 - np.cos(nominal / 300))  # the quartz wanders by 20 ppm within half an hour
        measured = 1e5 + nominal * (1 + self.skew) + warming
        arrived = measured + rng.uniform(0, self.jitter_s, len(measured))
        for begin in rng.uniform(measured[0], measured[-1], int(self.seconds / 3)):
            held = (arrived >= begin) & (arrived < begin + self.stall_s)
            arrived[held] = begin + self.stall_s
        return last, measured, np.maximum.accumulate(arrived)


def block_indices(last: int, samples: int) -> np.ndarray:
    """Indices of a block."""
    return np.arange(last - samples + 1, last + 1)


def run(link: Link) -> tuple[np.ndarray, SampleClock]:
    """Error of the time of each block's last sample; check that all times ascend."""
    last, measured, arrived = link.blocks()
    clock, before, errors = SampleClock(1 / link.rate_hz, QUARTZ_SKEW), -np.inf, []
    n_done = 0
    for i in range(len(last)):
        clock.observe(int(last[i]), arrived[i])
        if arrived[i] < arrived[0] + SETTLE_S:
            continue
        for j in range(n_done, i + 1):
            times = clock.times(block_indices(int(last[j]), link.block))
            assert times[0] > before
            assert (np.diff(times) > 0).all()
            before = times[-1]
            errors.append(before - measured[j])
        n_done = i + 1
    return np.array(errors), clock


@settings(max_examples=6)
@given(
    rate=st.sampled_from([(1000.0, 16), (100.0, 2), (40.0, 1)]),
    skew=st.floats(-200e-6, 200e-6),
    jitter_s=st.floats(0, 8e-3),
    seed=st.integers(0, 1000),
)
def test_times_are_accurate_from_first_block(rate: tuple[float, int], skew: float, jitter_s: float, seed: int) -> None:
    errors, _ = run(Link(*rate, 30.0, skew, seed, jitter_s))
    assert np.abs(errors).max() < 5e-3
    assert np.abs(errors[len(errors) // 2 :]).max() < 5e-4


def test_times_keep_gaps_and_ascend_through_delay_step() -> None:
    clock = SampleClock(1e-3, QUARTZ_SKEW)
    with pytest.raises(ValueError, match="no block"):
        clock.times(block_indices(0, 1))
    clock.observe(15, 100.015)
    early = clock.times(block_indices(15, 16))
    clock.observe(1015, 101.015)
    late = clock.times(block_indices(1015, 16))
    assert late[0] - early[-1] == pytest.approx(0.985)
    clock, before = SampleClock(1e-3, QUARTZ_SKEW), -np.inf
    for first in range(0, 3200, 16):
        clock.observe(first + 15, (first + 15) * 1e-3 + (0.3 if first < 320 else 0.0))
        times = clock.times(block_indices(first + 15, 16))
        assert times[0] > before
        before = times[-1]
    assert before == pytest.approx(3.199, abs=1e-3)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.sampled_from([1e-4, 1e-3, 1e-1]))
def test_times_follow_highest_line_below_arrivals(seed: int, count: int, size: float) -> None:
    """By linear programming: as high as can be at the mean of x, above no point, no steeper than a quartz is off."""
    rng = np.random.default_rng(seed)
    x, y = np.sort(rng.choice(100, count, replace=False)), size * rng.uniform(0, 1, count)
    clock = SampleClock(1.0, QUARTZ_SKEW)
    for second, delay_s in zip(x.tolist(), y.tolist(), strict=True):
        clock.observe(second, second + delay_s)
    clock.observe(101, 102.0)  # so late that it does not matter
    at_101, at_201 = (float(clock.times(np.array([index]))[0]) for index in (101, 201))
    slope = (at_201 - at_101) / 100 - 1
    line = at_101 - 101 + slope * (x - 101)
    best = linprog([-1, -x.mean()], np.column_stack([np.ones(count), x]), y, bounds=[(None, None), (-5e-4, 5e-4)])
    assert abs(slope) <= 5e-4 + 1e-12
    assert (line <= y + 1e-9).all()
    assert line.mean() == pytest.approx(-best.fun, abs=1e-9)
