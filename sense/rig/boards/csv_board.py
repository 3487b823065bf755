"""A board that prints plain lines of numbers, as most Arduino sketches do, without header and check.

This is weaker than the line protocol: a damaged number can pass for another, a lost line is not noticed, and rate and
times come from the arrival of the lines.
"""

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from padforge.sense.arrays import MAX_FIBRES, Array
from padforge.sense.rig import clock
from padforge.sense.rig.boards.board_reader import BlockReader, SampleAssembler, SampleClock, SerialBoard, select_inputs
from padforge.sense.rig.boards.line_board import describe_lines, find_line_port
from padforge.sense.rig.devices import RigFault, SerialStream
from padforge.sense.settings import RigSettings

LISTEN_S = 2.0  # time in which columns and rate are measured
_START_S = 1.5  # lines of this time are ignored: opening the port resets many boards, which print a greeting
_RATE_TOLERANCE = 0.05  # relative, of a measured rate
_MIN_LINES = 10  # within `LISTEN_S`
_LABEL = re.compile(rb"[A-Za-z_]\w*[:=]")
_SEPARATOR = re.compile(rb"[,;\t ]+")


def parse_numbers(line: bytes) -> list[float] | None:
    """Return the numbers of a line, separated by commas, semicolons or blanks, with or without labels.

    Returns None if there is no number, or anything else.
    """
    cells = _SEPARATOR.split(_LABEL.sub(b"", line).strip(b" ,;\t\r"))
    try:
        return [float(cell) for cell in cells if cell] or None
    except ValueError:
        return None


class CsvBoard(SerialBoard):
    """A board at a serial port that prints lines of numbers, in units of `count_v`; implements `Board`.

    A first column that always ascends is taken for the board's time, and is not an input. `connect` fails if the
    measured rate differs from `rate_hz` by more than 5 %.
    """

    def __init__(self, port: str, baud: int, rate_hz: float, inputs: Sequence[int] = (), count_v: float = 1.0) -> None:
        super().__init__(port, baud, rate_hz, inputs)
        self._count_v = count_v

    @classmethod
    def from_settings(cls, rig: RigSettings, inputs: Sequence[int]) -> "CsvBoard":
        """Return the board that `[rig]` names."""
        return cls(find_line_port(rig), rig.baud, rig.board_rate_hz, inputs, rig.count_v)

    def _start(self, stream: SerialStream) -> dict[str, Any]:
        # 1. Listen, and ignore the greeting of a board that the opening of its port has reset.
        self._tail = b""
        received = bytearray()
        lines: list[tuple[float, list[float]]] = []
        start_s = clock.now()
        while (elapsed_s := clock.now() - start_s) < _START_S + LISTEN_S:
            now_s, data = stream.receive()
            received += data[: _MIN_LINES * 100]  # for the description of a wrong stream
            lines += [(now_s, numbers) for numbers in self._decode(data) if elapsed_s > _START_S and numbers]
        if len(lines) < _MIN_LINES:
            message, advice = describe_lines(bytes(received))
            if "lines" in message:
                advice = f"it must print numbers alone, {_MIN_LINES / LISTEN_S:g} lines a second or more"
            raise RigFault("refused", f"{self._port}: {message}", advice)
        # 2. Find the columns: the most frequent number of them, of which the first may be the time.
        self._width = Counter(len(numbers) for _, numbers in lines).most_common(1)[0][0]
        table = np.array([numbers for _, numbers in lines if len(numbers) == self._width])
        has_time = self._width > 1 and bool((np.diff(table[:, 0]) > 0).all())
        n_inputs = self._width - has_time
        if not 1 <= n_inputs <= MAX_FIBRES:
            raise RigFault("refused", f"{self._port}: a line has {n_inputs} numbers, allowed is 1 to {MAX_FIBRES}")
        inputs = select_inputs(self._inputs, n_inputs)
        columns = [column + has_time for column in inputs]
        # 3. Measure the rate, and start to read.
        rate_hz = _measure_rate(np.array([arrival_s for arrival_s, _ in lines]))
        if abs(rate_hz / self._rate_hz - 1) > _RATE_TOLERANCE:
            message = f"{self._port}: {rate_hz:.4g} lines come a second, [rig] says {self._rate_hz:g}"
            raise RigFault("refused", message, f"set board_rate_hz = {rate_hz:.3g}")
        self._assembler = CsvAssembler(SampleClock(1 / rate_hz, _RATE_TOLERANCE), columns, self._count_v, self._width)
        self._lines: list[list[float]] = []  # received since the last line of samples
        self._reader = BlockReader(self._port, lambda: self._receive_blocks(stream), rate_hz)
        self._reader.start_settled()
        level_v = float(np.median(np.abs(table[:, columns]))) * self._count_v
        warning = "its lines have no header and no check: what is damaged or lost is not seen"
        if level_v > 50.0:  # probably counts of a converter
            warning += f"; they rest at {level_v:.4g}: if these are counts, set [rig] count_v to the volts of one"
        return {
            "channels": len(inputs),
            "inputs": list(inputs),
            "rate_hz": round(rate_hz, 3),
            "port": self._port,
            "time": "first column" if has_time else "none",
            "warning": warning,
        }

    def _decode(self, data: bytes) -> list[list[float]]:
        """Return the numbers of the lines that `data` completes; [] for a line of anything else."""
        *lines, self._tail = (self._tail + data).split(b"\n")
        return [parse_numbers(line) or [] for line in lines if line.strip()]

    def _receive_blocks(self, stream: SerialStream) -> tuple[float, list[list[list[float]]]]:
        now_s, data = stream.receive()
        self._lines += self._decode(data)
        if not any(len(numbers) == self._width for numbers in self._lines):  # damaged ones count with the next sample
            return now_s, []
        block, self._lines = self._lines, []
        return now_s, [block]


class CsvAssembler(SampleAssembler):
    """Assembles lines of `width` numbers by their order; others are lost samples."""

    def __init__(self, clock: SampleClock, columns: Sequence[int], volts: float, width: int) -> None:
        super().__init__(clock, columns, volts)
        self._width = width
        self._n_lines = self._n_lost = 0  # in all, and since the last sample

    def _place(self, sample: Sequence[float]) -> tuple[int, Sequence[float], int] | None:
        self._n_lines += 1
        if len(sample) != self._width:
            self._n_lost += 1
            return None
        missing, self._n_lost = self._n_lost, 0
        return self._n_lines, sample, missing


def _measure_rate(arrivals_s: Array) -> float:
    """Return lines a second from the arrival times (n,) of lines, which may arrive in blocks."""
    last_of_block = np.flatnonzero(np.append(np.diff(arrivals_s) > 0, True))
    first, last = last_of_block[0], last_of_block[-1]
    return float((last - first) / (arrivals_s[last] - arrivals_s[first])) if last > first else 0.0
