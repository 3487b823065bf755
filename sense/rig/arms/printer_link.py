"""Marlin's G-code over a noisy serial port: numbered lines with checksums, each executed exactly once."""

import re
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from functools import reduce
from operator import xor
from typing import Any

from padforge.sense.rig import clock
from padforge.sense.rig.arms.motion import Position
from padforge.sense.rig.devices import Cause, RigFault, SerialStream

FIRMWARE = "Marlin"
HALTED = ("halted", "kill()", "STOP called", "stopped")
"""Words of errors after which the firmware takes no further moves; other errors report a damaged line."""
ANSWER_S = 1.0  # longest wait for an answer
HOMING_ADVICE = "home it at its display with the probe off, put the probe on again, and begin anew"

_NUMBER = r"(-?\d+(?:\.\d+)?)"
_POSITION = re.compile(rf"^X:{_NUMBER} Y:{_NUMBER} Z:{_NUMBER}(?: |$)")
_RESEND = re.compile(r"^(?:Resend:|rs) ?N?(\d+)$")
_READ_S = 0.01  # longest wait for bytes
_RESEND_S = 0.08  # time without a line after which the command is sent again
_SILENCE_S = 0.03  # silence after which all answers to repeated lines have come


def checksum(text: bytes) -> int:
    """Return Marlin's checksum of a numbered line: the exclusive or of all bytes before the star."""
    return reduce(xor, text)


def number_line(number: int, command: str) -> bytes:
    """Return a command as a numbered line with its checksum."""
    text = f"N{number} {command}".encode("ascii")
    return b"%s*%d\n" % (text, checksum(text))


def format_move(end: Position, speed_mm_s: float) -> str:
    """Return the command of a straight move of the nozzle."""
    x, y, z = end
    return f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f} F{60 * speed_mm_s:.1f}"  # feed rates are in mm/min


def parse_resend(line: str) -> int | None:
    """Return the number of the line that the printer requests again; None if `line` is no such request."""
    match = _RESEND.match(line)
    return int(match[1]) if match else None


def parse_position(line: str) -> Position | None:
    """Return the nozzle's position, mm, from an answer to M114; None if `line` has none."""
    match = _POSITION.match(line)
    return (float(match[1]), float(match[2]), float(match[3])) if match else None


def parse_axis_limits(lines: list[str], code: str) -> Position | None:
    """Return the limits of x, y and z after M203 (mm/s) or M201 (mm/s²) in the answer to M503; None if missing."""
    match = re.search(rf"\b{code} X{_NUMBER} Y{_NUMBER} Z{_NUMBER}", "\n".join(lines))
    values = (float(match[1]), float(match[2]), float(match[3])) if match else None
    return values if values and min(values) > 0 else None


def parse_identity(lines: list[str], name: str) -> str:
    """Return a field of the answer to M115, such as FIRMWARE_NAME; "" if missing."""
    match = re.search(rf"{name}:(.*?)(?: [A-Z_]+:|$)", "\n".join(lines), re.MULTILINE)
    return match[1].strip() if match else ""


def is_halt(line: str) -> bool:
    """Return whether a line reports that the firmware has halted."""
    return line.startswith("Error:") and any(words in line for words in HALTED)


def _is_confirmation(line: str) -> bool:
    return line == "ok" or line.startswith("ok ")


class MarlinLink:
    """An open port. Methods raise RigFault("lost") once the printer is gone or has restarted.

    After a halt of the firmware they raise RigFault("emergency_stop").
    """

    def __init__(self, port: str, baud: int) -> None:
        """Open `port` exclusively; raises RigFault("refused") if that fails."""
        self._port = port
        self._stream = SerialStream(port, baud, _READ_S, "printer")
        _keep_running(self._stream.serial)
        self._text = b""
        self._number = 0
        self._history: deque[bytes] = deque(maxlen=8)  # lines that can be sent again
        self._connected = False
        self.halted = False  # whether the printer has halted or restarted, so that it takes no further moves

    def handshake(self, timeout_s: float) -> None:
        """Wait until the printer answers, and reset its line number to 0; RigFault("refused") if none answers."""
        deadline = clock.now() + timeout_s
        while clock.now() < deadline:
            self._stream.send(b"\n" + number_line(0, "M110 N0"))
            if any(map(_is_confirmation, list(self._read_until_silent()))):
                self._connected = True
                return
        advice = "check [rig] printer_port and printer_baud, and that no print is under way"
        raise RigFault("refused", f"{self._port}: no printer answers", advice)

    def execute(self, command: str, timeout_s: float = ANSWER_S) -> list[str]:
        """Execute a command exactly once and return the lines of its answer, [] if noise destroyed them.

        RigFault("stale") after `timeout_s` without an answer; RigFault("lost") if the printer requests unknown lines.
        """
        self._number += 1
        self._history.append(number_line(self._number, command))
        answer: list[str] = []
        resend_s, deadline = 0.0, clock.now() + timeout_s
        n_sent = n_bad_resends = requested = 0
        while (now := clock.now()) < deadline:
            if now >= resend_s:
                self._stream.send(self._history[-1])
                answer, resend_s, n_sent = [], now + _RESEND_S, n_sent + 1
            for line in self._receive():
                resend_s = clock.now() + _RESEND_S
                if (number := parse_resend(line)) is not None:
                    requested = number
                    list(self._read_until_silent())
                    if requested == self._number + 1:  # the command was executed; its answer is lost
                        return []
                    n_bad_resends += not self._resend_before(requested)
                    resend_s = 0.0
                    break
                if not _is_confirmation(line):
                    answer.append(line)
                elif any("Unknown command" in text for text in answer):  # noise hit the N of a numbered line
                    resend_s = 0.0
                else:
                    if n_sent > 1:
                        list(self._read_until_silent())
                    return answer
            if n_bad_resends >= 4:  # noise alone causes fewer
                message = f"{self._port}: the printer asks for line {requested}, not {self._number}"
                raise RigFault("lost", message, HOMING_ADVICE)
        advice = "it may be busy: look at its display"
        raise RigFault("stale", f"{self._port}: the printer has not answered for {timeout_s:g} s", advice)

    def send_unnumbered(self, command: str) -> None:
        """Send a command ahead of all others, from any thread; never raises."""
        with suppress(RigFault):
            self._stream.send(b"\n" + command.encode("ascii") + b"\n")

    def close(self) -> None:
        """Close the port; never raises."""
        self._stream.close()

    def _resend_before(self, number: int) -> bool:
        """Send the lines from `number` to the one before the latest; return whether they are in the history."""
        n_lines = self._number - number
        if not 0 <= n_lines < len(self._history):
            return False
        for line in list(self._history)[-1 - n_lines : -1]:
            self._stream.send(line)
            list(self._read_until_silent())
        return True

    def _read_until_silent(self) -> Iterator[str]:
        """Yield lines until none come, for `ANSWER_S` at most: a device that never falls silent is no printer."""
        deadline = clock.now() + ANSWER_S
        silent_at = clock.now() + _SILENCE_S
        while clock.now() < min(silent_at, deadline):
            for line in self._receive():
                silent_at = clock.now() + _SILENCE_S
                yield line

    def _receive(self) -> list[str]:
        """Return the lines received within `_READ_S`."""
        *lines, self._text = (self._text + self._stream.receive()[1]).split(b"\n")
        texts = [line.decode("ascii", "replace").strip() for line in lines]
        for text in texts:
            self._check_running(text)
        return texts

    def _check_running(self, line: str) -> None:
        if line == "start":
            self.halted = True
            cause: Cause = "lost" if self._connected else "refused"
            message = f"{self._port}: the printer has restarted, so that its position is unknown"
            raise RigFault(cause, message, HOMING_ADVICE)
        if is_halt(line):
            self.halted = True
            message = f"{self._port}: the printer has halted ({line.removeprefix('Error:')})"
            raise RigFault("emergency_stop", message, f"switch it off and on, {HOMING_ADVICE}")


def _keep_running(serial: Any) -> None:
    """Keep the DTR line asserted when the port closes (no HUPCL), so that opening it again does not reset the board."""
    try:
        import termios
    except ModuleNotFoundError:  # Windows
        return
    with suppress(OSError, termios.error):  # the port has no such line
        settings = termios.tcgetattr(serial.fileno())
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(serial.fileno(), termios.TCSANOW, settings)
