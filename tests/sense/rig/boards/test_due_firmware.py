"""The sketch itself, compile_sketch for this computer with a stand-in for the chip; the program's decoder reads it."""

from pathlib import Path

import numpy as np
import pytest

from padforge.sense.rig.boards import due as framing
from padforge.sense.rig.boards.due import Ack, BoardSettings, DueBlock, Identity, Kind, Request, Status
from padforge.sense.virtual.boards import check_settings
from tests.sense.rig.boards.firmware import compile_sketch, run_sketch

FIRMWARE = Path(framing.__file__).parent / "firmware" / "padforge_due"
ADC_CHANNEL = [7, 6, 5, 4, 3, 2, 1, 0, 10, 11, 12, 13]  # of inputs A0 to A11


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compile_sketch("due", FIRMWARE, tmp_path_factory.mktemp("firmware"))


def run(program: Path, *steps: str | Request | BoardSettings) -> list[framing.DueMessage]:
    """What the board sends as the script is run with messages of the host in it: as the program would write it."""
    script = [step if isinstance(step, str) else f"host {framing.encode(step).hex()}" for step in steps]
    decoder, stream = framing.DueDecoder(), run_sketch(program, script)
    messages = decoder.decode(stream)
    assert stream == b"".join(map(framing.encode, messages))
    return messages


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
        BoardSettings(1_000_000, 0xFFF, 8),
        BoardSettings(100_000, 0xFF, 1),
        BoardSettings(75_000_000, 0b1000_0000_0101, 16),
        BoardSettings(100_000_000, 1, 1),
    ],
)
def test_firmware_sends_every_conversion_in_its_place(program: Path, wanted: BoardSettings) -> None:
    script = *[f"trigger {16 * wanted.averaging}", "loop 20"] * 8, "loop 200"
    ack, started, *blocks = run(program, wanted, START, *script)
    assert ack == Ack(Kind.SETTINGS, Status.OK, wanted)
    assert started == Ack(Kind.START, Status.OK, wanted)
    due_blocks = [block for block in blocks if isinstance(block, DueBlock)]
    assert len(due_blocks) == len(blocks) == 8 * 16 // len(due_blocks[0].counts)
    check_blocks(due_blocks, wanted)
    assert check_settings(wanted) == Status.OK


@pytest.mark.parametrize(
    ("wanted", "status"),
    [
        (BoardSettings(1_000_000, 0, 1), Status.BAD_SETTINGS),
        (BoardSettings(1_000_000, 0x1000, 1), Status.BAD_SETTINGS),
        (BoardSettings(1_000_000, 1, 17), Status.BAD_SETTINGS),
        (BoardSettings(0, 1, 1), Status.BAD_SETTINGS),
        (BoardSettings(2_000_000_000, 1, 1), Status.BAD_SETTINGS),
        (BoardSettings(47_000, 0xFF, 1), Status.TOO_FAST),
        (BoardSettings(1_000_000, 0xFFF, 16), Status.TOO_FAST),
    ],
)
def test_firmware_refuses_settings_as_emulator_does(program: Path, wanted: BoardSettings, status: Status) -> None:
    (ack,) = run(program, wanted)
    assert ack == Ack(Kind.SETTINGS, status, BoardSettings(1_000_000, 0xFF, 1))
    assert check_settings(wanted) == status


def test_firmware_ignores_second_start_and_refuses_settings_while_running(program: Path) -> None:
    default, other = BoardSettings(1_000_000, 0xFF, 1), BoardSettings(2_000_000, 3, 1)
    script = START, "trigger 16", "loop 2", START, other, "trigger 16", "loop 2"
    messages = run(program, *script, STOP, other, START, "trigger 10", "loop 2")
    acks = [(ack.command, ack.status) for ack in messages if isinstance(ack, Ack)]
    assert acks[:3] == [(Kind.START, Status.OK), (Kind.START, Status.OK), (Kind.SETTINGS, Status.RUNNING)]
    assert acks[3:] == [(Kind.STOP, Status.OK), (Kind.SETTINGS, Status.OK), (Kind.START, Status.OK)]
    blocks = [block for block in messages if isinstance(block, DueBlock)]
    check_blocks(blocks[:2], default)
    assert [(block.first, block.mask) for block in blocks] == [(0, 0xFF), (16, 0xFF), (0, 3)]


def test_firmware_counts_dropped_blocks_and_stops_when_port_closes(program: Path) -> None:
    messages = run(program, START, f"trigger {16 * 70}", "loop 100", "trigger 16", "loop 2")
    blocks = [block for block in messages if isinstance(block, DueBlock)]
    assert [block.first for block in blocks[:64]] == list(range(0, 1024, 16))
    assert [(block.first, block.overruns, block.sequence) for block in blocks[64:]] == [(1120, 96, 64)]
    messages = run(program, START, "trigger 16", "loop 2", "close", "trigger 64", "loop 20")
    assert sum(isinstance(message, DueBlock) for message in messages) == 1


@pytest.mark.parametrize("trouble", [["slip", "trigger 64"], ["masked 64"]])
def test_firmware_halts_on_lost_conversions(program: Path, trouble: list[str]) -> None:
    messages = run(program, START, "trigger 16", "loop 2", *trouble, "loop 20", "trigger 64", "loop 20")
    assert [block.first for block in messages if isinstance(block, DueBlock)] == [0]
    assert isinstance(messages[-1], Ack)
    assert (messages[-1].command, messages[-1].status) == (Kind.STOP, Status.HALTED)


def test_firmware_identifies_itself_reports_period_and_skips_damaged_commands(program: Path) -> None:
    wanted = framing.encode(BoardSettings(2_000_000, 3, 2))
    damaged: list[bytes] = []
    for i in range(len(wanted)):
        damaged += [wanted[:i] + bytes([wanted[i] ^ 0x10]) + wanted[i + 1 :], wanted[:i] + wanted[i + 1 :]]
    messages = run(program, *(f"host {command.hex()}" for command in [*damaged, b"\x55" * 100]), IDENTIFY)
    intact = Ack(Kind.SETTINGS, Status.OK, BoardSettings(2_000_000, 3, 2))
    (identity,) = [message for message in messages if message != intact]
    assert identity == Identity((1, 0, 0), 12, 12, "padforge-due", b"serial-of-a-chip")
    assert messages.count(intact) <= 2  # a zero too few between two messages harms neither
    (ack,) = run(program, BoardSettings(1_000_000_000 // 1300, 0xFF, 7))
    assert isinstance(ack, Ack)
    ticks = round(1e9 / 1300 * 0.042 / 7)
    assert ack.settings.period_ns == round(ticks * 7 / 0.042)
