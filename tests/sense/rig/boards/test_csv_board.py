"""Boards that print lines of their own, on pseudo-terminals."""

import os
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from padforge.sense.rig import clock
from padforge.sense.rig.boards import csv_board, line_board
from padforge.sense.rig.boards.csv_board import CsvBoard, parse_numbers
from padforge.sense.rig.boards.line_board import LineBoard
from padforge.sense.rig.devices import RigFault

RATE_HZ = 200.0


@contextmanager
def printing(lines: bytes) -> Iterator[str]:
    """Print a line at RATE_HZ, with its number in place of %d, after bytes of a start; yield the port."""
    board, port = os.openpty()
    tty.setraw(port)
    done = threading.Event()

    def run() -> None:
        os.write(board, b"\xff\x80boot\r\nready\r\n")
        start_s, n = clock.now(), 0
        while not done.wait(0.002):
            while clock.now() - start_s > n / RATE_HZ:
                n += 1
                os.write(board, lines.replace(b"%d", str(5000 * n).encode()) + b"\r\n")

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield os.ttyname(port)
    finally:
        done.set()
        thread.join()
        os.close(board)
        os.close(port)


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
    with printing(b"%d,502,1.5,500") as port:
        board = CsvBoard(port, 115200, RATE_HZ, (2, 0), count_v=0.01)
        try:
            identity = board.connect()
            assert (identity["inputs"], identity["time"]) == ([2, 0], "first column")
            assert identity["rate_hz"] == pytest.approx(RATE_HZ, rel=0.05)
            assert "no header and no check" in identity["warning"]
            clock.sleep(0.2)
            samples = board.read()
            assert np.allclose(samples.volts, [5.0, 5.02])
            assert not samples.missing.any()
            assert np.diff(samples.times_s).mean() == pytest.approx(1 / RATE_HZ, rel=0.1)
            board.close()
            with pytest.raises(RigFault, match=r"lines come a second, .rig. says 50; set board_rate_hz = "):
                CsvBoard(port, 115200, 50).connect()
        finally:
            board.close()


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


def test_line_board_shows_a_line_without_header(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_board, "_ANSWER_S", 0.3)
    with printing(b"502,501") as port, pytest.raises(RigFault, match="it sends lines such as '502,501' without"):
        LineBoard(port, 115200, RATE_HZ).connect()


def test_csv_board_asks_for_more_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """200 come a second, which is enough but for a minimum that is raised here."""
    for name, value in {"_START_S": 0.1, "LISTEN_S": 0.2, "_MIN_LINES": 100}.items():
        monkeypatch.setattr(csv_board, name, value)
    with printing(b"502,501") as port, pytest.raises(RigFault, match="numbers alone, 500 lines a second or more"):
        CsvBoard(port, 115200, RATE_HZ).connect()
