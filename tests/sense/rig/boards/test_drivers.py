"""Both boards' drivers through real pseudo-terminals and real pyserial, against emulated boards and their faults."""

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense.rig.boards import board_reader as block_reader
from padforge.sense.rig.boards import due as due_driver
from padforge.sense.rig.boards import line_board as line_driver
from padforge.sense.rig.boards.due import Arduino
from padforge.sense.rig.boards.line_board import LineBoard
from padforge.sense.rig.boards.line_framing import LineHeader
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.virtual.boards import EmulatedBoard, EmulatedLineBoard
from tests.sense.rig.fakes import fault_of

pytest.importorskip("serial")
pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")

STEP_V = 3.3 / 4095
HEADER = LineHeader(1000, 12, 3.3, 16, said=(("name", "emulated"), ("serial", "7")))
BAUD = 921_600
Board = EmulatedBoard | EmulatedLineBoard
Driver = Arduino | LineBoard


def waves(times_s: np.ndarray) -> np.ndarray:
    """Sixteen different slow voltages."""
    return 1.65 + 1.5 * np.sin(2 * np.pi * (0.7 + 0.1 * np.arange(16)) * times_s[:, None])


def emulated(kind: str, header: Any = HEADER, **options: Any) -> Board:
    return EmulatedBoard(waves, **options) if kind == "due" else EmulatedLineBoard(waves, header, **options)


def driver(board: Board, rate_hz: float = 1000.0, **options: Any) -> Driver:
    if isinstance(board, EmulatedBoard):
        return Arduino(board.port, rate_hz, **options)
    return LineBoard(board.port, BAUD, rate_hz, **options)


@contextmanager
def connected(board: Board, rate_hz: float = 1000.0, **options: Any) -> Iterator[Driver]:
    with board, closing(driver(board, rate_hz, **options)) as converter:
        converter.connect()
        yield converter


@pytest.fixture(autouse=True)
def soon_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where times need not be exact, connecting need not take long."""
    monkeypatch.setattr(block_reader, "SETTLE_S", 0.15)


def joined(*parts: BoardSamples) -> BoardSamples:
    return BoardSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def read_for(converter: Driver, seconds: float) -> BoardSamples:
    parts, end = [converter.read()], time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.02)
        parts.append(converter.read())
    return joined(*parts)


def check(
    samples: BoardSamples, board: Board, within_s: float = 0.05, inputs: Sequence[int] = (), step_v: float = STEP_V
) -> None:
    """Every reading is what the board read at that index, at the right time.

    What a line board had sent before it was asked is not counted: the index of its first reading is looked for.
    """
    columns = list(inputs or range(samples.volts.shape[1]))

    def worst_v(index: np.ndarray) -> float:
        return np.abs(samples.volts[: len(index)] - waves(board.truth_s(index))[:, columns]).max()

    index = np.cumsum(1 + samples.missing) - 1
    if isinstance(board, EmulatedLineBoard):
        index -= index[0]
        period_s = float(board.truth_s(1) - board.truth_s(0))
        down_command = max(round((samples.times_s[0] - float(board.truth_s(0))) / period_s), 60)
        near = range(down_command - 60, down_command + 60)
        index += next(first for first in near if worst_v(first + index[:5]) < 0.502 * step_v)
    assert worst_v(index) < 0.502 * step_v
    assert (np.diff(samples.times_s) > 0).all()
    assert np.abs(samples.times_s - board.truth_s(index)).max() < within_s


BOTH = pytest.mark.parametrize("kind", ["due", "line"])
SLOW_LINE = pytest.param("line", marks=pytest.mark.slow)
SKEWED = {"due": {"skew_ppm": 150}, "line": {"skew_ppm": 2000, "boot_us": 2**32 - 700_000}}
SAYS: dict[str, dict[str, Any]] = {
    "due": {"name": "padforge-due", "firmware": "1.0.0", "channels": 12, "bits": 12, "supply_v": 3.3},
    "line": {"name": "emulated", "serial": "7", "channels": 16, "bits": 12, "supply_v": 3.3},
}


@pytest.mark.parametrize("kind", ["due", SLOW_LINE])
def test_a_second_without_a_gap_right_to_a_step_and_on_time(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    board = emulated(kind, **SKEWED[kind])
    with board, closing(driver(board)) as converter:
        said = converter.connect()
        assert said.items() >= SAYS[kind].items()
        assert said["rate_hz"] == pytest.approx(1000)
        assert said["inputs"] == list(range(SAYS[kind]["channels"]))
        assert "warning" not in said
        down_command = time.process_time(), time.monotonic()
        samples = read_for(converter, 0.6)
        share = (time.process_time() - down_command[0]) / (time.monotonic() - down_command[1])
        assert len(samples.times_s) > 900
        assert not samples.missing.any()
        check(samples, board, within_s=5e-3)
        assert share < 0.5  # of a core, the emulated board included: nobody waits in a loop
        counted = {"due": ("blocks", 16), "line": ("samples", 1)}[kind]
        assert converter.statistics()[counted[0]] == len(samples.times_s) / counted[1]


@pytest.mark.parametrize(
    ("kind", "header", "options"),
    [
        *(("due", replace(HEADER, rate_hz=rate_hz), {}) for rate_hz in (10.0, 4000.0)),
        ("due", HEADER, {"inputs": range(8), "averaging": 16}),
        ("due", replace(HEADER, rate_hz=500.0), {"inputs": (11, 3, 0)}),
        ("line", replace(HEADER, rate_hz=10.0), {}),
        ("line", LineHeader(333.0, 16, 5.0, 16), {"inputs": (15, 0, 7)}),
    ],
)
def test_other_rates_inputs_and_averages(kind: str, header: LineHeader, options: dict[str, Any]) -> None:
    board = emulated(kind, header)
    with connected(board, header.rate_hz, **options) as converter:
        samples = read_for(converter, 0.15)
        assert len(samples.times_s) > 0.15 * header.rate_hz
        step_v = header.reference_v / header.full_scale + 1e-9
        check(samples, board, inputs=options.get("inputs", ()), step_v=step_v)


def test_a_line_board_is_asked_through_noise_and_looked_upon_with_doubt_where_its_lines_have_no_check() -> None:
    board = emulated("line", seed=1)
    board.garble(5e-3)
    with connected(board) as converter:
        board.garble(0)
        check(read_for(converter, 0.1), board)
    board = emulated("line", replace(HEADER, checked=False))
    with board, closing(driver(board)) as converter:
        assert "a damaged one may pass" in converter.connect()["warning"]
        check(read_for(converter, 0.1), board)


@BOTH
def test_garbled_bytes_cost_samples_that_are_counted_and_never_give_a_wrong_one(kind: str) -> None:
    board = emulated(kind, seed=3)
    with connected(board) as converter:
        board.garble(4e-3)
        samples = read_for(converter, 0.4)
        board.garble(0)
        samples = joined(samples, read_for(converter, 0.1))
        check(samples, board)
        statistics = converter.statistics()
        assert statistics["damaged"] > 5
        assert statistics["missing"] == samples.missing.sum() > 50
        assert statistics.get("overruns", 0) == 0


def test_samples_the_board_drops_are_missing_and_counted_and_lost_conversions_end_the_reading() -> None:
    board = EmulatedBoard(waves)
    with connected(board) as converter:
        board.overrun(160)
        samples = read_for(converter, 0.25)
        check(samples, board)
        assert samples.missing.max() == samples.missing.sum() == 160
        assert converter.statistics()["overruns"] == 160
        board.halt()
        fault_of(converter.read, "data", "lost conversions")


@BOTH
def test_unplugging_is_noticed_at_once_after_the_last_samples(kind: str) -> None:
    board = emulated(kind)
    with connected(board) as converter:
        board.unplug()
        assert len(converter.read().times_s) >= 96
        assert fault_of(converter.read, "lost", "the board is gone") < 2
        converter.close()
        fault_of(converter.read, "refused", "not connected")
        fault_of(converter.connect, "refused", "there is no such port")
    assert not any(thread.name == f"reader of {board.port}" for thread in threading.enumerate())


@pytest.mark.parametrize("kind", ["due", SLOW_LINE])
def test_a_board_that_falls_silent_is_stale_after_a_second_and_comes_back_after_connecting_anew(kind: str) -> None:
    board = emulated(kind)
    with connected(board) as converter:
        board.stall()
        assert 0.5 < fault_of(converter.read, "stale") < 2.5
        board.stall(False)
        converter.connect()
        check(read_for(converter, 0.1), board)


@pytest.mark.parametrize("kind", ["due", SLOW_LINE])
def test_a_host_that_never_reads_is_told_so(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block_reader, "UNREAD_S", 0.3)
    board = emulated(kind)
    with connected(board) as converter:
        time.sleep(0.35)
        check(converter.read(), board)
        fault_of(converter.read, "data", "nobody has read")


@pytest.mark.parametrize("garbled", [0.0, pytest.param(2e-2, marks=pytest.mark.slow)], ids=["its header", "its times"])
def test_a_reset_is_told_and_its_samples_are_not_mixed_with_those_before(garbled: float) -> None:
    """A header among so many damaged bytes is hardly ever read, nor is every other line: it is told by the times."""
    board = EmulatedLineBoard(waves, HEADER, seed=5)
    with connected(board) as converter:
        board.garble(garbled)
        before = read_for(converter, 0.1)
        board.reset()
        assert fault_of(converter.read, "data", "reset") < 2
        assert len(before.times_s) > 5
        board.garble(0)
        converter.connect()
        check(read_for(converter, 0.1), board)


def test_lines_of_other_columns_are_never_taken_and_told() -> None:
    board = EmulatedLineBoard(waves, HEADER)
    with connected(board) as converter:
        board.send_columns(15)
        assert fault_of(converter.read, "data", "a line has 16 numbers, expected 17: .* line after line") < 2


@pytest.mark.parametrize(
    ("kind", "board_is", "rate_hz", "options", "match"),
    [
        ("due", {"silent": True}, 1000, {}, "no padforge board answers.*native USB port"),
        ("due", {"firmware": (9, 1, 0)}, 1000, {}, r"firmware 9\.1\.0"),
        ("due", {}, 10_000, {"averaging": 16}, "12 channels at 10000 Hz"),
        ("line", {"silent": True}, 1000, {}, "no board that speaks.*baud"),
        ("line", {}, 500, {}, "takes 1000 samples a second, .rig. says 500; set board_rate_hz = 1000"),
        ("line", {}, 1000, {"inputs": (3, 16)}, "channels: fibre 2 is on input 16, the board has 0 to 15"),
    ],
)
def test_a_board_that_is_not_ours_or_cannot_do_what_is_asked_is_refused(
    kind: str, board_is: dict, rate_hz: float, options: dict, match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (due_driver, line_driver):
        monkeypatch.setattr(module, "_ANSWER_S", 0.3)
    with emulated(kind, **board_is) as board:
        assert fault_of(driver(board, rate_hz, **options).connect, "refused", match) < 5


@pytest.mark.parametrize(
    ("values", "error", "match"),
    [
        ({"rate_hz": 9}, InputError, "rate_hz is 9, expected 10 to"),
        ({"rate_hz": 10_001}, InputError, "rate_hz is 10001"),
        ({"averaging": 0}, InputError, "averaging is 0, expected 1 to 16"),
        ({"inputs": (-1, 3)}, RigFault, "channels: fibre 1 is on input -1, an"),
        ({"inputs": (3, 12)}, RigFault, "channels: fibre 2 is on input 12, an Arduino Due has 0 to 11"),
    ],
)
def test_settings_that_no_due_has_are_refused_before_it_is_opened(values: dict, error: type, match: str) -> None:
    with pytest.raises(error, match=match):
        Arduino("port", **{"rate_hz": 1000, **values})


@BOTH
def test_a_port_in_use_is_refused_and_free_again_after_close(kind: str) -> None:
    with emulated(kind) as board:
        first, second = driver(board), driver(board)
        first.connect()
        fault_of(second.connect, "refused", "another program uses it")
        first.close()
        first.close()
        second.connect()
        second.close()
    assert not any(thread.name == f"reader of {board.port}" for thread in threading.enumerate())
