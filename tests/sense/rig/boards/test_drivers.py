"""The driver of boards through real pseudo-terminals and real pyserial, against emulated boards and their faults."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from padforge.sense.rig import clock
from padforge.sense.rig.boards import board_reader, due, line_board
from padforge.sense.rig.boards.line_board import LineBoard, LineHeader
from padforge.sense.rig.devices import BoardSamples
from padforge.sense.settings import RigSettings
from tests.emulators.boards import EmulatedLineBoard
from tests.sense.rig.fakes import TERMINALS, fault_of

pytest.importorskip("serial")
pytestmark = TERMINALS

STEP_V = 3.3 / 4095
HEADER = LineHeader(1000, 12, 3.3, 16, extra=(("name", "emulated"), ("serial", "7")))
BAUD = 921_600


def waves(times_s: np.ndarray) -> np.ndarray:
    """Sixteen different slow voltages."""
    return 1.65 + 1.5 * np.sin(2 * np.pi * (0.7 + 0.1 * np.arange(16)) * times_s[:, None])


def emulated(header: LineHeader = HEADER, **options: Any) -> EmulatedLineBoard:
    return EmulatedLineBoard(waves, header, **options)


def make_driver(board: EmulatedLineBoard, rate_hz: float = 1000.0, inputs: Sequence[int] = ()) -> LineBoard:
    return LineBoard(board.port, BAUD, rate_hz, inputs)


@contextmanager
def connected(board: EmulatedLineBoard, rate_hz: float = 1000.0, inputs: Sequence[int] = ()) -> Iterator[LineBoard]:
    with board, closing(make_driver(board, rate_hz, inputs)) as driver:
        driver.connect()
        yield driver


@pytest.fixture(autouse=True)
def soon_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where times need not be exact, connecting need not take long."""
    monkeypatch.setattr(board_reader, "SETTLE_S", 0.15)


def concatenate(*parts: BoardSamples) -> BoardSamples:
    return BoardSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def read_for(driver: LineBoard, seconds: float) -> BoardSamples:
    parts, end = [driver.read()], clock.now() + seconds
    while clock.now() < end:
        clock.sleep(0.02)
        parts.append(driver.read())
    return concatenate(*parts)


def check(
    samples: BoardSamples,
    board: EmulatedLineBoard,
    atol_s: float = 0.05,
    inputs: Sequence[int] = (),
    step_v: float = STEP_V,
) -> None:
    """Every reading is what the board read at that index, at the right time.

    What the board had sent before it was asked is not counted: the index of its first reading is looked for.
    """
    columns = list(inputs or range(samples.volts.shape[1]))

    def worst_v(index: np.ndarray) -> float:
        return np.abs(samples.volts[: len(index)] - waves(board.true_times(index))[:, columns]).max()

    index = np.cumsum(1 + samples.missing) - 1
    index -= index[0]
    period_s = float(board.true_times(1) - board.true_times(0))
    guess = max(round((samples.times_s[0] - float(board.true_times(0))) / period_s), 60)
    near = range(guess - 60, guess + 60)
    index += next(first for first in near if worst_v(first + index[:5]) < 0.502 * step_v)
    assert worst_v(index) < 0.502 * step_v
    assert (np.diff(samples.times_s) > 0).all()
    assert np.abs(samples.times_s - board.true_times(index)).max() < atol_s


def test_read_returns_exact_samples_on_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    board = emulated(skew_ppm=2000)
    with board, closing(make_driver(board)) as driver:
        identity = driver.connect()
        expected = {"name": "emulated", "serial": "7", "channels": 16, "bits": 12, "rate_hz": 1000, "supply_v": 3.3}
        assert identity.items() >= (expected | {"inputs": list(range(16))}).items()
        assert "warning" not in identity
        samples = read_for(driver, 0.6)
        assert len(samples.times_s) > 900
        assert not samples.missing.any()
        check(samples, board, atol_s=5e-3)


@pytest.mark.parametrize(
    ("header", "inputs"),
    [
        (replace(HEADER, bits=16, channels=12), (11, 3, 0)),  # of a Due
        (LineHeader(333.0, 16, 5.0, 16), (15, 0, 7)),
    ],
)
def test_read_at_other_rates_inputs_and_resolutions(header: LineHeader, inputs: tuple[int, ...]) -> None:
    board = emulated(header)
    with connected(board, header.rate_hz, inputs) as driver:
        samples = read_for(driver, 0.15)
        assert len(samples.times_s) > 0.15 * header.rate_hz
        step_v = header.reference_v / header.full_scale + 1e-9
        check(samples, board, inputs=inputs, step_v=step_v)


def test_line_board_connects_through_noise_and_warns_without_checks() -> None:
    board = emulated(seed=1)
    board.garble(5e-3)
    with connected(board) as driver:
        board.garble(0)
        check(read_for(driver, 0.1), board)
    board = emulated(replace(HEADER, checked=False))
    with board, closing(make_driver(board)) as driver:
        assert "a damaged one may pass" in driver.connect()["warning"]
        check(read_for(driver, 0.1), board)


def test_read_counts_garbled_samples_and_returns_no_wrong_one() -> None:
    board = emulated(seed=3)
    with connected(board) as driver:
        board.garble(4e-3)
        samples = read_for(driver, 0.4)
        board.garble(0)
        samples = concatenate(samples, read_for(driver, 0.1))
        check(samples, board)
        assert samples.missing.sum() > 50


def test_read_raises_when_unplugged_after_last_samples() -> None:
    board = emulated()
    with connected(board) as driver:
        board.unplug()
        assert len(driver.read().times_s) >= 96
        assert fault_of(driver.read, "lost", "the board is gone") < 2
        driver.close()
        fault_of(driver.read, "refused", "not connected")
        fault_of(driver.connect, "refused", "there is no such port")
    assert not any(thread.name == f"reader of {board.port}" for thread in threading.enumerate())


def test_read_raises_when_board_stalls_or_nobody_reads_and_connect_recovers(monkeypatch) -> None:
    board = emulated()
    with connected(board) as driver:
        board.stall()
        assert 0.5 < fault_of(driver.read, "stale") < 2.5
        board.stall(False)
        monkeypatch.setattr(board_reader, "BUFFER_S", 0.3)
        driver.connect()
        check(read_for(driver, 0.1), board)
        clock.sleep(0.35)
        check(driver.read(), board)
        fault_of(driver.read, "data", "nobody has read")


def test_reader_blames_the_board_for_its_silence_alone_and_not_for_the_hosts_sleep(monkeypatch) -> None:
    """A host that sleeps for an hour of 0.5 s without a sample; later, 1 s in which the board does send nothing."""
    times_s = iter([*np.arange(0, 0.5, 0.1), 3600.0, *np.arange(3600.1, 3600.3, 0.1), *np.arange(3601, 3604, 0.1)])
    monkeypatch.setattr(clock, "now", lambda: 0.0)
    received = []

    def receive() -> tuple[float, list[list[int]]]:
        received.append(float(next(times_s)))
        return received[-1], [[7]] if received[-1] == 3601.0 else []

    reader = board_reader.BlockReader("COM7", receive, 100.0)
    reader.run()
    assert reader.drain() == [(3601.0, [7])]
    fault_of(reader.drain, "stale", "no sample for 1.1 s")
    assert received[-1] == pytest.approx(3602.1)


@pytest.mark.parametrize("garbled", [0.0, pytest.param(2e-2, marks=pytest.mark.slow)], ids=["its header", "its times"])
def test_read_raises_when_line_board_resets(garbled: float) -> None:
    """A header among so many damaged bytes is hardly ever read, nor is every other line: the times show it."""
    board = emulated(seed=5)
    with connected(board) as driver:
        board.garble(garbled)
        before = read_for(driver, 0.1)
        board.reset()
        assert fault_of(driver.read, "data", "reset") < 2
        assert len(before.times_s) > 5
        board.garble(0)
        driver.connect()
        check(read_for(driver, 0.1), board)


@pytest.mark.parametrize(
    ("silent", "rate_hz", "inputs", "match"),
    [
        (True, 1000, (), "nothing comes from it; check that it is the board's port"),
        (False, 500, (), "takes 1000 samples a second, .rig. says 500; set board_rate_hz = 1000"),
        (False, 1000, (3, 16), "channels: fibre 2 is on input 16, the board has 0 to 15"),
    ],
)
def test_connect_refuses_unsuitable_board(silent: bool, rate_hz: float, inputs: tuple, match: str, monkeypatch) -> None:
    monkeypatch.setattr(line_board, "_ANSWER_S", 0.3)
    with emulated(silent=silent) as board:
        assert fault_of(make_driver(board, rate_hz, inputs).connect, "refused", match) < 5


def test_connect_refuses_port_in_use_until_closed() -> None:
    with emulated() as board:
        first, second = make_driver(board), make_driver(board)
        first.connect()
        fault_of(second.connect, "refused", "another program uses it")
        first.close()
        first.close()
        second.connect()
        second.close()
    assert not any(thread.name == f"reader of {board.port}" for thread in threading.enumerate())


BUILT_IN = SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None)
UNO = SimpleNamespace(device="/dev/ttyACM2", vid=0x2341, pid=0x0043, serial_number="uno")
PROGRAMMING = SimpleNamespace(device="/dev/ttyACM1", vid=0x2341, pid=0x003D, serial_number="7")
NATIVE = SimpleNamespace(device="/dev/ttyACM3", vid=0x2341, pid=0x003E, serial_number=None)


def test_ports_of_boards_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Due by its native port before that for programming, any other board where it is the only one on USB."""

    def connect(*ports: SimpleNamespace) -> None:
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [BUILT_IN, *ports])

    connect(PROGRAMMING, NATIVE, UNO)
    assert due.list_due_ports() == ["/dev/ttyACM3", "/dev/ttyACM1"]
    assert due.find_due_port(RigSettings()) == "/dev/ttyACM3"
    connect(UNO)
    assert line_board.find_line_port(RigSettings()) == "/dev/ttyACM2"
    for find_port in (due.find_due_port, line_board.find_line_port):
        assert find_port(RigSettings(port="COM3")) == "COM3"
