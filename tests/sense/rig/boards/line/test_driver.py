"""A line board through a real pseudo-terminal and real pyserial, against the emulated board and its faults."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sense.rig.boards import block_reader
from sense.rig.boards.line import driver
from sense.rig.boards.line.driver import LineBoard, port_of
from sense.rig.boards.line.framing import Header
from sense.rig.devices.protocols import ConverterSamples, RigFault
from sense.rig.emulators.line_board import EmulatedLineBoard
from sense.settings import RigSettings
from tests.sense.rig.boards.reading import STEP_V, fault_of, joined, read_for, waves

pytest.importorskip("serial")
pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")

HEADER = Header(1000, 12, 3.3, 16, said=(("name", "emulated"), ("serial", "7")))
BAUD = 921_600


@pytest.fixture(autouse=True)
def soon_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where times need not be exact, connecting need not take long."""
    monkeypatch.setattr(block_reader, "SETTLE_S", 0.15)


@contextmanager
def connected(board: EmulatedLineBoard, inputs: tuple[int, ...] = ()) -> Iterator[LineBoard]:
    with board, closing(LineBoard(board.port, BAUD, board._header.rate_hz, inputs)) as converter:
        converter.connect()
        yield converter


def check(samples: ConverterSamples, board: EmulatedLineBoard, within_s: float = 0.05, step_v: float = STEP_V) -> None:
    """Every reading is what the board read at its index, counted on from that of the first, at the right time."""
    counts = np.cumsum(1 + samples.missing)
    counts -= counts[0]
    period_s = board._period_s()
    begun = round((samples.times_s[0] - float(board.truth_s(0))) / period_s)
    fits = [
        first
        for first in range(max(begun - 60, 0), begun + 60)
        if np.abs(samples.volts[:5] - waves(board.truth_s(first + counts[:5]))).max() < 0.502 * step_v
    ]
    assert fits
    truth = board.truth_s(fits[0] + counts)
    assert samples.volts == pytest.approx(waves(truth), abs=0.502 * step_v)
    assert (np.diff(samples.times_s) > 0).all()
    assert np.abs(samples.times_s - truth).max() < within_s


def test_a_second_without_a_gap_right_to_a_step_and_on_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    board = EmulatedLineBoard(waves, HEADER, skew_ppm=2000, boot_us=2**32 - 700_000)
    with board, closing(LineBoard(board.port, BAUD, 1000)) as converter:
        said = converter.connect()
        assert said.items() >= {"name": "emulated", "serial": "7", "channels": 16, "bits": 12, "supply_v": 3.3}.items()
        assert (said["rate_hz"], said["inputs"]) == (1000, list(range(16)))
        assert "warning" not in said
        samples = read_for(converter, 1.0)
        assert len(samples.times_s) > 900
        assert not samples.missing.any()
        check(samples, board, within_s=5e-3)
        assert converter.statistics()["samples"] == len(samples.times_s)


def test_inputs_come_in_the_order_of_the_fibres() -> None:
    board = EmulatedLineBoard(lambda times_s: np.tile(np.linspace(0, 1.5, 16), (len(times_s), 1)), HEADER)
    with connected(board, (15, 0, 7)) as converter:
        volts = read_for(converter, 0.05).volts
        assert volts == pytest.approx(np.tile([1.5, 0.0, 0.7], (len(volts), 1)), abs=STEP_V)


@pytest.mark.parametrize("header", [replace(HEADER, rate_hz=10.0), Header(333.0, 16, 5.0, 16)])
def test_other_rates_and_converters(header: Header) -> None:
    board = EmulatedLineBoard(waves, header)
    with connected(board) as converter:
        check(read_for(converter, 0.2), board, step_v=header.reference_v / header.full_scale + 1e-9)


def test_garbled_bytes_cost_samples_that_are_counted_and_never_give_a_wrong_one() -> None:
    board = EmulatedLineBoard(waves, HEADER, seed=3)
    with connected(board) as converter:
        board.garble(2e-3)
        samples = read_for(converter, 0.75)
        board.garble(0)
        samples = joined([samples, read_for(converter, 0.1)])
        check(samples, board)
        statistics = converter.statistics()
        assert statistics["damaged"] > 20
        assert statistics["missing"] == samples.missing.sum() > 50


def test_a_board_can_be_asked_through_noise() -> None:
    board = EmulatedLineBoard(waves, HEADER, seed=1)
    board.garble(5e-3)
    with connected(board) as converter:
        board.garble(0)
        check(read_for(converter, 0.1), board)


def test_a_board_without_a_check_is_read_and_looked_upon_with_doubt() -> None:
    board = EmulatedLineBoard(waves, replace(HEADER, checked=False))
    with board, closing(LineBoard(board.port, BAUD, 1000)) as converter:
        assert "a damaged one may pass" in converter.connect()["warning"]
        check(read_for(converter, 0.1), board)


def test_unplugging_is_noticed_at_once() -> None:
    board = EmulatedLineBoard(waves, HEADER)
    with connected(board) as converter:
        board.unplug()
        assert len(converter.read().times_s) >= 96
        assert fault_of(converter.read, "lost", "the board is gone") < 2
        converter.close()
        fault_of(converter.read, "refused", "not connected")
        fault_of(converter.connect, "refused", "there is no such port")


def test_a_board_that_falls_silent_is_stale_after_a_second_and_comes_back_after_connecting_anew() -> None:
    board = EmulatedLineBoard(waves, HEADER)
    with connected(board) as converter:
        board.stall()
        assert 0.5 < fault_of(converter.read, "stale") < 2.5
        board.stall(False)
        converter.connect()
        check(read_for(converter, 0.1), board)


@pytest.mark.parametrize("garbled", [0.0, 2e-2], ids=["by its header", "by its times"])
def test_a_reset_is_told_and_its_samples_are_not_mixed_with_those_before(garbled: float) -> None:
    """A header among so many damaged bytes is hardly ever read, nor is every other line."""
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


def test_a_host_that_never_reads_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block_reader, "UNREAD_S", 0.4)
    board = EmulatedLineBoard(waves, HEADER)
    with connected(board) as converter:
        time.sleep(0.5)
        check(converter.read(), board)
        fault_of(converter.read, "data", "nobody has read")


def test_a_board_that_does_not_answer_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert driver._ANSWER_S <= 3
    monkeypatch.setattr(driver, "_ANSWER_S", 0.7)
    with EmulatedLineBoard(waves, HEADER, silent=True) as board:
        fault_of(LineBoard(board.port, BAUD, 1000).connect, "refused", "no board that speaks.*baud")


@pytest.mark.parametrize(
    ("rate_hz", "inputs", "match"),
    [
        (500, (), "takes 1000 samples a second, .rig. says 500; set converter_rate_hz = 1000"),
        (1000, (3, 16), "channels: fibre 2 is on input 16, the board has 0 to 15"),
    ],
)
def test_a_board_that_cannot_do_what_is_asked_is_refused(rate_hz: float, inputs: tuple[int, ...], match: str) -> None:
    with EmulatedLineBoard(waves, HEADER) as board:
        fault_of(LineBoard(board.port, BAUD, rate_hz, inputs).connect, "refused", match)
    assert not any(thread.name == f"reader of {board.port}" for thread in threading.enumerate())


@pytest.mark.parametrize(
    ("devices", "said"),
    [
        ([], "there are 0 serial ports on USB; plug the board in"),
        (["/dev/ttyUSB1", "/dev/ttyUSB0"], "there are 2 serial ports on USB; name one of /dev/ttyUSB0, /dev/ttyUSB1"),
    ],
)
def test_a_port_is_found_where_there_is_one(monkeypatch: pytest.MonkeyPatch, devices: list[str], said: str) -> None:
    def ports(*devices: str) -> list[SimpleNamespace]:
        return [SimpleNamespace(device=device, vid=0x10C4) for device in devices]

    built_in = SimpleNamespace(device="/dev/ttyS0", vid=None)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [built_in, *ports("/dev/ttyUSB0")])
    assert port_of(RigSettings()) == "/dev/ttyUSB0"
    assert port_of(RigSettings(port="COM3")) == "COM3"
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [built_in, *ports(*devices)])
    with pytest.raises(RigFault, match=said):
        port_of(RigSettings())
