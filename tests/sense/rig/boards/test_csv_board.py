"""Boards that print lines of their own, on pseudo-terminals."""

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from padforge.sense.rig import clock
from padforge.sense.rig.boards import csv_board
from padforge.sense.rig.boards.csv_board import CsvBoard, parse_numbers
from padforge.sense.rig.devices import RigFault
from tests.emulators.boards import SerialDevice

RATE_HZ = 200.0


class PrintingBoard(SerialDevice):
    """It prints lines at RATE_HZ, with their number in place of %d, after bytes of a start."""

    def __init__(self, line: bytes) -> None:
        super().__init__("board", seed=0)
        self._line, self._start_s, self._n_lines = line, clock.now(), 0
        self._out += b"\xff\x80boot\r\nready\r\n"

    def _step(self, data: bytes) -> None:
        while clock.now() - self._start_s > self._n_lines / RATE_HZ:
            self._n_lines += 1
            self._out += self._line.replace(b"%d", str(5000 * self._n_lines).encode()) + b"\r\n"


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


def test_csv_board_finds_columns_and_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_board, "_START_S", 0.1)
    monkeypatch.setattr(csv_board, "LISTEN_S", 0.7)
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


class Port:
    """A port at which texts arrive one by one, and then nothing."""

    def __init__(self, *texts: bytes) -> None:
        self._texts = list(texts)

    def receive(self) -> tuple[float, bytes]:
        return clock.now(), self._texts.pop(0) if self._texts else b""


def test_csv_board_counts_damaged_lines_that_arrive_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    board = CsvBoard("port", 115200, RATE_HZ)
    monkeypatch.setattr(board, "_tail", b"", raising=False)
    monkeypatch.setattr(board, "_lines", [], raising=False)
    monkeypatch.setattr(board, "_width", 2, raising=False)
    port: Any = Port(b"1,2\n", b"1,\n", b"3", b",2\n1;x\n5,6\n", b"7,8\n")
    blocks = [board._receive_blocks(port)[1] for _ in range(5)]  # noqa: SLF001
    assert blocks == [[[[1, 2]]], [], [], [[[1], [3, 2], [], [5, 6]]], [[[7, 8]]]]


def test_csv_board_asks_for_more_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """200 come a second, which is enough but for a minimum that is raised here."""
    for name, value in {"_START_S": 0.1, "LISTEN_S": 0.2, "_MIN_LINES": 100}.items():
        monkeypatch.setattr(csv_board, name, value)
    with PrintingBoard(b"502,501") as printing, pytest.raises(RigFault, match="numbers alone, 500 lines a second"):
        CsvBoard(printing.port, 115200, RATE_HZ).connect()
