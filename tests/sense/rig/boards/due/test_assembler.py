"""Blocks of the board put together to readings."""

import sys

import numpy as np
import pytest

from sense.rig.boards.due.driver import Assembler
from sense.rig.boards.due.framing import Block, BoardSettings, Decoder, encode
from sense.rig.devices.protocols import RigFault
from tests.helpers.effort import few

STEP_V = 3.3 / 4095
SETTINGS = BoardSettings(1_000_000, 0xFF, 1)


def block(first: int, time_us: int | None = None, samples: int = 16) -> Block:
    counts = np.full((samples, 8), first % 4096, np.uint16)
    time_us = (first + samples) * 1000 if time_us is None else time_us
    return Block(counts, 1, 0xFF, first // 16 % 2**16, first % 2**32, time_us % 2**32, 0)


def test_any_number_of_samples_with_all_numbers_wrapping_takes_no_more_memory_than_a_few() -> None:
    """A million under stress."""
    count = 120_000 if few(1).max_examples == 1 else 1_000_000
    start = 2**32 - count // 32 * 16
    decoder, assembler, held, before = Decoder(), Assembler(SETTINGS, range(8), 3.3), [], -np.inf
    for first in range(start, start + count, 400):
        sent = [encode(block(index)) for index in range(first, first + 400, 16)]
        frames = [frame for frame in decoder.feed(b"".join(sent)) if isinstance(frame, Block)]
        samples = assembler.samples(((first + 16 * i) * 1e-3, frame) for i, frame in enumerate(frames))
        assert samples.times_s[0] > before
        before = samples.times_s[-1]
        assert samples.volts[0, 0] == pytest.approx(first % 4096 * STEP_V)
        held.append(sys.getallocatedblocks())
    assert assembler.missing == start  # none but those before the first block
    assert assembler.blocks == count // 16
    assert max(held[-100:]) < max(held[100:200]) + 1000


@pytest.mark.parametrize(
    "second",
    [block(0), block(64, 17_000), block(16, 90_000), block(2**31)],
    ids=["again", "too early", "too late", "far away"],
)
def test_a_block_that_cannot_follow_is_a_fault(second: Block) -> None:
    assembler = Assembler(SETTINGS, range(8), 3.3)
    assembler.samples([(1.0, block(0))])
    with pytest.raises(RigFault, match="off its time") as caught:
        assembler.samples([(1.1, second)])
    assert caught.value.cause == "data"


def test_blocks_of_other_channels_are_a_fault() -> None:
    with pytest.raises(RigFault, match="other channels"):
        Assembler(BoardSettings(1_000_000, 0x0F, 1), range(4), 3.3).samples([(1.0, block(0))])


def test_nothing_new_is_an_empty_reading_of_the_right_shape() -> None:
    samples = Assembler(SETTINGS, range(8), 3.3).samples([])
    assert samples.times_s.shape == (0,)
    assert samples.volts.shape == (0, 8)
    assert samples.missing.shape == (0,)
    assert samples.missing.dtype == np.int64


def test_columns_come_in_the_order_of_the_fibres() -> None:
    counts = np.array([[10, 30, 70]], np.uint16)
    assembler = Assembler(BoardSettings(1_000_000, 0b1000_1010, 1), (7, 1, 3), 3.3)
    samples = assembler.samples([(1.0, Block(counts, 1, 0b1000_1010, 0, 0, 1000, 0))])
    assert samples.volts / STEP_V == pytest.approx(np.array([[70, 10, 30]]))
