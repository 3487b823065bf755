"""Lines put together to readings: by the board's own time, whatever that is worth."""

import sys

import numpy as np
import pytest

from sense.rig.boards.line.driver import Assembler, Lines
from sense.rig.boards.line.framing import Header
from sense.rig.devices.protocols import ConverterSamples, RigFault

HEADER = Header(1000, 10, 5.0, 3)


def read(times_us: list[int] | np.ndarray, assembler: Assembler | None = None) -> ConverterSamples:
    """The samples of lines of these times, all come at once; the first count is the number of the line."""
    assembler = assembler or Assembler(HEADER, (0, 1, 2))
    counts = [(k, 10, 1023) for k in range(len(times_us))]
    return assembler.samples([(1.0, Lines([int(time_us) for time_us in times_us], counts))])


def taken(samples: ConverterSamples) -> list[int]:
    """Numbers of the lines that became samples."""
    return np.rint(samples.volts[:, 0] * 1023 / 5).astype(int).tolist()


def test_counts_become_volts_in_the_order_of_the_fibres() -> None:
    samples = read([1000, 2000], Assembler(HEADER, (2, 0)))
    assert samples.volts == pytest.approx(np.array([[5, 0], [5, 5 / 1023]]))
    assert np.diff(samples.times_s) == pytest.approx([1e-3])


def test_nothing_new_is_an_empty_reading_of_the_right_shape() -> None:
    samples = Assembler(HEADER, (2, 0)).samples([])
    assert (samples.times_s.shape, samples.volts.shape, samples.missing.shape) == ((0,), (0, 2), (0,))
    assert samples.missing.dtype == np.int64


def test_what_is_left_out_is_missing_also_where_the_time_wraps() -> None:
    start = 2**32 - 3000
    times = start + 1000 * np.array([0, 1, 4, 5, 25])
    samples = read(times % 2**32)
    assert samples.missing.tolist() == [0, 0, 2, 0, 19]
    assert np.diff(samples.times_s) == pytest.approx([1e-3, 3e-3, 1e-3, 20e-3])


def test_a_time_that_does_not_wrap_is_good_as_well() -> None:
    assert read([2**40 + 1000, 2**40 + 2000, 2**40 + 5000]).missing.tolist() == [0, 0, 2]


@pytest.mark.parametrize("share", [0.98, 0.999, 1.001, 1.02])
def test_a_rate_that_is_not_quite_what_it_says_loses_nothing(share: float) -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(np.full(5000, 1000 / share)) + rng.uniform(-150, 150, 5000)
    samples = read(times)
    assert len(samples.times_s) == 5000
    assert not samples.missing.any()


def test_lines_that_are_late_by_less_than_half_a_period_are_where_they_belong() -> None:
    rng = np.random.default_rng(1)
    kept = np.sort(rng.choice(4000, 3000, replace=False))
    samples = read(1000 * kept + rng.uniform(0, 450, 3000))
    assert np.cumsum(1 + samples.missing)[-1] == 1 + kept[-1] - kept[0]
    assert np.array_equal(np.cumsum(1 + samples.missing) - 1, kept - kept[0])


def test_lines_held_up_and_sent_in_a_bunch_count_once_a_slot() -> None:
    samples = read([1000, 2000, 5000, 5100, 5200, 6000, 7000])
    assert taken(samples) == [0, 1, 2, 5, 6]
    assert samples.missing.tolist() == [0, 0, 2, 0, 0]


def test_a_line_whose_time_cannot_be_is_dropped_and_the_next_one_counts() -> None:
    samples = read([1000, 2000, 2_003_000_000, 4000, 17, 6000])
    assert taken(samples) == [0, 1, 3, 5]
    assert samples.missing.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (np.arange(1, 20) * 1000, "a line came -[0-9]+ us after another by the board's clock, not 1000; it was reset"),
        (4e6 + np.arange(1, 20) * 1000, "a line came [0-9]+ us after"),
        (2e6 + np.arange(1, 20), "a line came [1-8] us after another .* its rate is not that of its header"),
        (2e6 + np.arange(1, 200) * 700, "us after another by the board's clock, not 1000"),
    ],
    ids=["reset", "far away", "milliseconds", "too fast"],
)
def test_times_that_cannot_be_line_after_line_are_a_fault(after: np.ndarray, said: str) -> None:
    assembler = Assembler(HEADER, (0, 1, 2))
    read(1_000_000 + np.arange(1001) * 1000, assembler)
    with pytest.raises(RigFault, match=said) as caught:
        read(after, assembler)
    assert caught.value.cause == "data"


def test_a_reset_after_half_the_range_of_the_time_is_a_fault_too() -> None:
    assembler = Assembler(HEADER, (0, 1, 2))
    read(2**31 + 10_000_000 + np.arange(20) * 1000, assembler)
    with pytest.raises(RigFault, match="it was reset"):
        read(np.arange(1, 20) * 1000, assembler)


def test_an_hour_takes_no_more_memory_than_a_second() -> None:
    assembler, held = Assembler(HEADER, (0, 1, 2)), []
    for second in range(300):
        read(1000 * (1 + np.arange(100)) + 100_000 * second, assembler)
        held.append(sys.getallocatedblocks())
    assert assembler.taken == 30_000
    assert max(held[-50:]) < max(held[100:150]) + 1000
