"""The sample clock against simulated truth, and boards that print lines of their own, on pseudo-terminals."""

from contextlib import closing
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from padforge.sense.rig import clock
from padforge.sense.rig.boards import csv_board
from padforge.sense.rig.boards.board_reader import SampleClock
from padforge.sense.rig.boards.csv_board import CsvBoard, parse_numbers
from padforge.sense.rig.devices import RigFault
from tests.emulators.boards import SerialDevice
from tests.helpers.constants import with_constants

SETTLE_S = 0.5
QUARTZ_SKEW = 500e-6  # relative difference of two quartz clocks


def block_indices(last: int, samples: int) -> np.ndarray:
    return np.arange(last - samples + 1, last + 1)


def errors_of(rate_hz: float, block: int, skew: float, jitter_s: float, seed: int) -> np.ndarray:
    """Error of the time of each block's last sample, in 30 s of a board whose period is too long; all times ascend.

    Blocks arrive late by up to `jitter_s`, or are held for 50 ms now and then.
    """
    rng, last = np.random.default_rng(seed), np.arange(1, int(30 * rate_hz / block) + 1) * block - 1
    nominal = last / rate_hz
    # the quartz wanders by 20 ppm within half an hour
    measured = 1e5 + nominal * (1 + skew) + 20e-6 * 300 * (1 - np.cos(nominal / 300))
    arrived = measured + rng.uniform(0, jitter_s, len(measured))
    for begin in rng.uniform(measured[0], measured[-1], 10):
        arrived[(arrived >= begin) & (arrived < begin + 0.05)] = begin + 0.05
    clock, before, errors = SampleClock(1 / rate_hz, QUARTZ_SKEW), -np.inf, list[float]()
    for i, arrived_s in enumerate(np.maximum.accumulate(arrived)):
        clock.observe(int(last[i]), arrived_s)
        for j in range(len(errors), i + 1 if arrived_s >= arrived[0] + SETTLE_S else 0):
            times = clock.times(block_indices(int(last[j]), block))
            assert before < times[0]
            assert (np.diff(times) > 0).all()
            before = times[-1]
            errors.append(before - measured[j])
    return np.array(errors)


@settings(max_examples=6)
@given(
    rate=st.sampled_from([(1000.0, 16), (100.0, 2), (40.0, 1)]),
    skew=st.floats(-200e-6, 200e-6),
    jitter_s=st.floats(0, 8e-3),
    seed=st.integers(0, 1000),
)
def test_times_are_accurate_from_first_block(rate: tuple[float, int], skew: float, jitter_s: float, seed: int) -> None:
    errors = errors_of(*rate, skew, jitter_s, seed)
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


RATE_HZ = 200.0
short = with_constants((csv_board, {"_START_S": 0.1, "LISTEN_S": 0.7}))


class PrintingBoard(SerialDevice):
    """It prints lines, with their number in place of %d, after bytes of a start; of one in `damaged` only the end."""

    def __init__(self, line: bytes, rate_hz: float = RATE_HZ, damaged: int = 10**9) -> None:
        super().__init__("board", seed=0)
        self._line, self._rate_hz, self._damaged = line, rate_hz, damaged
        self._start_s, self._n_lines = clock.now(), 0
        self._out += b"\xff\x80boot\r\nready\r\n"

    def _step(self, data: bytes) -> None:
        while clock.now() - self._start_s > self._n_lines / self._rate_hz:
            self._n_lines += 1
            line = self._line.replace(b"%d", str(5000 * self._n_lines).encode())
            self._out += (line if self._n_lines % self._damaged else line[-5:]) + b"\r\n"


@pytest.mark.parametrize(
    ("line", "numbers"),
    [
        (b"1,2.5,-3e1\r", [1, 2.5, -30]),
        (b"S0:502 S1:500", [502, 500]),
        (b"1\t2 , 3,", [1, 2, 3]),
        (b"time,c0", None),
        (b"", None),
    ],
)
def test_parse_numbers(line: bytes, numbers: list[float] | None) -> None:
    assert parse_numbers(line) == numbers


def test_csv_board_finds_columns_and_rate() -> None:
    with PrintingBoard(b"%d,502,1.5,500") as printing:
        with closing(CsvBoard(printing.port, 115200, RATE_HZ, (2, 0), count_v=0.01)) as board:
            identity = board.connect()
            assert (identity["inputs"], identity["time"]) == ([2, 0], "first column")
            assert identity["rate_hz"] == pytest.approx(RATE_HZ, rel=0.05)
            assert "no header and no check" in identity["warning"]
            clock.sleep(0.2)
            samples = board.read()
        assert np.allclose(samples.volts, [5.0, 5.02])
        assert not samples.missing.any()
        assert np.diff(samples.times_s).mean() == pytest.approx(1 / RATE_HZ, rel=0.1)
        with pytest.raises(RigFault, match=r"lines come a second, .rig. says 50; set board_rate_hz = "):
            CsvBoard(printing.port, 115200, 50).connect()


def test_csv_board_counts_damaged_lines() -> None:
    """They arrive alone, between two looks at the port."""
    slow = PrintingBoard(b"%d,502,500", 50.0, damaged=3)
    with slow, closing(CsvBoard(slow.port, 115200, 50.0)) as board:
        board.connect()
        clock.sleep(1.0)
        samples = board.read()
    assert np.allclose(samples.volts, [502, 500])
    assert samples.missing.sum() == pytest.approx(len(samples.times_s) / 2, abs=2)


@patch.multiple(csv_board, LISTEN_S=0.2, _MIN_LINES=100)
def test_csv_board_asks_for_more_lines() -> None:
    """200 come a second, which is enough but for a minimum that is raised here."""
    with PrintingBoard(b"502,501") as printing, pytest.raises(RigFault, match="numbers alone, 500 lines a second"):
        CsvBoard(printing.port, 115200, RATE_HZ).connect()
