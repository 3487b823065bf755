"""The sketch itself, compiled for this computer with a stand-in for the chip; the program's decoder reads it."""

from pathlib import Path

import numpy as np
import pytest

from padforge.sense.rig.boards import due_framing as framing
from padforge.sense.rig.boards.due_framing import (
    Ack,
    BoardSettings,
    DueBlock,
    DueDecoder,
    Frame,
    Identity,
    Kind,
    Request,
    Status,
    encode,
)
from padforge.sense.virtual.boards import judge_settings
from tests.sense.rig.boards.compiling import compiled, sent

FIRMWARE = Path(framing.__file__).parent / "firmware" / "padforge_due"
ADC_CHANNEL = [7, 6, 5, 4, 3, 2, 1, 0, 10, 11, 12, 13]
"""Of inputs A0 to A11."""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled("due", FIRMWARE, tmp_path_factory.mktemp("firmware"))


def run(program: Path, *steps: str | Request | BoardSettings) -> list[Frame]:
    """What the board sends as the script is run with frames of the host in it: as the program would write it."""
    script = [step if isinstance(step, str) else f"host {encode(step).hex()}" for step in steps]
    decoder, stream = DueDecoder(), sent(program, script)
    frames = decoder.feed(stream)
    assert decoder.damaged == 0
    assert stream == b"".join(map(encode, frames))
    return frames


START, STOP, IDENTIFY = Request(Kind.START), Request(Kind.STOP), Request(Kind.IDENTIFY)


def expected(first: int, samples: int, inputs: list[int], averaging: int) -> np.ndarray:
    """What the stand-in's ADC gives, summed."""
    turns = first * averaging + np.arange(samples * averaging)
    channel = np.array([ADC_CHANNEL[i] for i in inputs])
    return ((256 * channel + turns[:, None]) % 4096).reshape(samples, averaging, -1).sum(1)


def check_blocks(blocks: list[DueBlock], wanted: BoardSettings) -> None:
    inputs = [i for i in range(12) if wanted.mask >> i & 1]
    samples = min(max(20_000_000 // wanted.period_ns, 1), 16)
    for number, block in enumerate(blocks):
        assert (block.sequence, block.first, block.overruns) == (number, number * samples, 0)
        assert (block.mask, block.averaging) == (wanted.mask, wanted.averaging)
        assert np.array_equal(block.counts, expected(block.first, samples, inputs, wanted.averaging))
    elapsed = np.diff([block.time_us for block in blocks]) % 2**32
    assert np.allclose(elapsed, samples * wanted.period_ns / 1000, rtol=0.02)


@pytest.mark.parametrize(
    "wanted",
    [
        BoardSettings(1_000_000, 0xFF, 1),
        BoardSettings(1_000_000, 0xFFF, 8),
        BoardSettings(100_000, 0xFF, 1),
        BoardSettings(75_000_000, 0b1000_0000_0101, 16),
        BoardSettings(100_000_000, 1, 1),
    ],
)
def test_blocks_hold_every_conversion_in_its_place(program: Path, wanted: BoardSettings) -> None:
    script = *[f"trigger {16 * wanted.averaging}", "loop 20"] * 8, "loop 200"
    ack, started, *blocks = run(program, wanted, START, *script)
    assert ack == Ack(Kind.SETTINGS, Status.OK, wanted)
    assert started == Ack(Kind.START, Status.OK, wanted)
    found = [block for block in blocks if isinstance(block, DueBlock)]
    assert len(found) == len(blocks) == 8 * 16 // len(found[0].counts)
    check_blocks(found, wanted)
    assert judge_settings(wanted) == Status.OK


@pytest.mark.parametrize(
    ("wanted", "status"),
    [
        (BoardSettings(1_000_000, 0, 1), Status.BAD_SETTINGS),
        (BoardSettings(1_000_000, 0x1000, 1), Status.BAD_SETTINGS),
        (BoardSettings(1_000_000, 1, 0), Status.BAD_SETTINGS),
        (BoardSettings(1_000_000, 1, 17), Status.BAD_SETTINGS),
        (BoardSettings(0, 1, 1), Status.BAD_SETTINGS),
        (BoardSettings(2_000_000_000, 1, 1), Status.BAD_SETTINGS),
        (BoardSettings(47_000, 0xFF, 1), Status.TOO_FAST),
        (BoardSettings(1_000_000, 0xFFF, 16), Status.TOO_FAST),
    ],
)
def test_settings_it_cannot_keep_are_refused_as_the_emulated_board_does(
    program: Path, wanted: BoardSettings, status: Status
) -> None:
    (ack,) = run(program, wanted)
    assert ack == Ack(Kind.SETTINGS, status, BoardSettings(1_000_000, 0xFF, 1))
    assert judge_settings(wanted) == status


def test_start_twice_goes_on_and_settings_wait_for_stop(program: Path) -> None:
    default, other = BoardSettings(1_000_000, 0xFF, 1), BoardSettings(2_000_000, 3, 1)
    script = START, "trigger 16", "loop 2", START, other, "trigger 16", "loop 2"
    frames = run(program, *script, STOP, other, START, "trigger 10", "loop 2")
    acks = [(ack.command, ack.status) for ack in frames if isinstance(ack, Ack)]
    assert acks[:3] == [(Kind.START, Status.OK), (Kind.START, Status.OK), (Kind.SETTINGS, Status.RUNNING)]
    assert acks[3:] == [(Kind.STOP, Status.OK), (Kind.SETTINGS, Status.OK), (Kind.START, Status.OK)]
    blocks = [block for block in frames if isinstance(block, DueBlock)]
    check_blocks(blocks[:2], default)
    assert [(block.first, block.mask) for block in blocks] == [(0, 0xFF), (16, 0xFF), (0, 3)]


def test_a_host_too_slow_costs_whole_blocks_that_are_counted_and_one_that_closes_the_port_stops_it(
    program: Path,
) -> None:
    frames = run(program, START, f"trigger {16 * 70}", "loop 100", "trigger 16", "loop 2")
    blocks = [block for block in frames if isinstance(block, DueBlock)]
    assert [block.first for block in blocks[:64]] == list(range(0, 1024, 16))
    assert [(block.first, block.overruns, block.sequence) for block in blocks[64:]] == [(1120, 96, 64)]
    frames = run(program, START, "trigger 16", "loop 2", "close", "trigger 64", "loop 20")
    assert sum(isinstance(frame, DueBlock) for frame in frames) == 1


@pytest.mark.parametrize("trouble", [["slip", "trigger 64"], ["masked 64"]])
def test_lost_conversions_stop_the_board_rather_than_give_wrong_values(program: Path, trouble: list[str]) -> None:
    frames = run(program, START, "trigger 16", "loop 2", *trouble, "loop 20", "trigger 64", "loop 20")
    assert [block.first for block in frames if isinstance(block, DueBlock)] == [0]
    assert isinstance(frames[-1], Ack)
    assert (frames[-1].command, frames[-1].status) == (Kind.STOP, Status.HALTED)


def test_it_says_what_it_is_and_which_period_its_timer_keeps_and_passes_over_damaged_commands(program: Path) -> None:
    wanted = encode(BoardSettings(2_000_000, 3, 2))
    damaged: list[bytes] = []
    for i in range(len(wanted)):
        damaged += [wanted[:i] + bytes([wanted[i] ^ 0x10]) + wanted[i + 1 :], wanted[:i] + wanted[i + 1 :]]
    frames = run(program, *(f"host {each.hex()}" for each in [*damaged, b"\x55" * 100]), IDENTIFY)
    whole = Ack(Kind.SETTINGS, Status.OK, BoardSettings(2_000_000, 3, 2))
    (identity,) = [frame for frame in frames if frame != whole]
    assert identity == Identity((1, 0, 0), 12, 12, "padforge-due", b"serial-of-a-chip")
    assert frames.count(whole) <= 2  # a zero too few between two frames harms neither
    (ack,) = run(program, BoardSettings(1_000_000_000 // 1300, 0xFF, 7))
    assert isinstance(ack, Ack)
    ticks = round(1e9 / 1300 * 0.042 / 7)
    assert ack.settings.period_ns == round(ticks * 7 / 0.042)
