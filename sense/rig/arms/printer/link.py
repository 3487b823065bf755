"""A serial port at which Marlin listens: every line has a number and is executed once, whatever noise there is."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from padforge.sense.rig.devices.protocols import Cause, RigFault
from padforge.sense.rig.devices.serial_port import open_port

from padforge.sense.rig.arms.printer import marlin

ANSWER_S = 1.0
"""Longest wait for an answer."""
HOME = "home it at its display with the probe off, put the probe on again, and begin anew"

_READ_S = 0.01
_RESEND_S = 0.08
_QUIET_S = 0.03
"""Silence after which nothing more is said about lines that came twice."""
_KEPT = 8
"""Lines that can be sent again."""
_STRANGE = 4
"""So often a number that makes no sense is taken for noise."""


class MarlinLink:
    """An open port. Its methods raise RigFault("lost") once the printer is gone, has restarted or has halted.

    Attributes:
        ended: whether it has restarted or halted, so that nothing moves any more.
    """

    def __init__(self, port: str, baud: int) -> None:
        """Open `port` for this process alone; raises RigFault("refused") where that cannot be."""
        self._port = port
        self._serial = open_port(port, baud, _READ_S)
        _keep_running(self._serial)
        self._text = b""
        self._number = 0
        self._sent: deque[bytes] = deque(maxlen=_KEPT)
        self._begun = self.ended = False

    def begin(self, wait_s: float) -> None:
        """Wait until the printer answers, and count its lines from 0.

        Raises:
            RigFault: "refused" where nothing that speaks G-code answers, or the printer restarts as its port is opened.
        """
        end = time.monotonic() + wait_s
        while time.monotonic() < end:
            self._write(b"\n" + marlin.numbered(0, "M110 N0"))
            if any(map(_confirms, list(self._quiet()))):
                self._begun = True
                return
        advice = "check [rig] printer_port and printer_baud, and that no print is under way"
        raise RigFault("refused", f"{self._port}: no printer answers", advice)

    def ask(self, command: str, wait_s: float = ANSWER_S) -> list[str]:
        """Have a command executed.

        Returns:
            The lines of its answer; none where the command was executed but noise took its answer.

        Raises:
            RigFault: "stale" where it is not answered within `wait_s`; "lost".
        """
        self._number += 1
        self._sent.append(marlin.numbered(self._number, command))
        answer: list[str] = []
        due, end = 0.0, time.monotonic() + wait_s
        tries = strange = wanted = 0
        while (now := time.monotonic()) < end:
            if now >= due:
                self._write(self._sent[-1])
                answer, due, tries = [], now + _RESEND_S, tries + 1
            for line in self._receive():
                due = time.monotonic() + _RESEND_S
                if (asked := marlin.resend(line)) is not None:
                    wanted = asked
                    list(self._quiet())
                    if wanted == self._number + 1:
                        return []
                    strange += not self._again(wanted)
                    due = 0.0
                    break
                if not _confirms(line):
                    answer.append(line)
                elif any("Unknown command" in said for said in answer):  # a number that was damaged is no number
                    due = 0.0
                else:
                    if tries > 1:
                        list(self._quiet())
                    return answer
            if strange >= _STRANGE:
                raise RigFault("lost", f"{self._port}: the printer asks for line {wanted}, not {self._number}", HOME)
        advice = "it may be busy: look at its display"
        raise RigFault("stale", f"{self._port}: the printer has not answered for {wait_s:g} s", advice)

    def shout(self, command: str) -> None:
        """Send a command outside of all order, from any thread; never raises."""
        with suppress(RigFault):
            self._write(b"\n" + command.encode("ascii") + b"\n")

    def close(self) -> None:
        """Close the port; never raises."""
        with suppress(OSError):
            self._serial.close()

    def _again(self, wanted: int) -> bool:
        """Send lines before the latest that were not executed, from number `wanted` on; whether that is kept."""
        back = self._number - wanted
        if not 0 <= back < len(self._sent):
            return False
        for line in list(self._sent)[len(self._sent) - 1 - back : -1]:
            self._write(line)
            list(self._quiet())
        return True

    def _quiet(self) -> Iterator[str]:
        """The lines that come until nothing does, for `ANSWER_S` at most: what never falls silent is no printer."""
        latest = time.monotonic() + ANSWER_S
        end = time.monotonic() + _QUIET_S
        while time.monotonic() < min(end, latest):
            for line in self._receive():
                end = time.monotonic() + _QUIET_S
                yield line

    def _receive(self) -> list[str]:
        """The lines that have come, after waiting for at most `_READ_S`."""
        try:
            data = self._serial.read(1)
            if data:
                data += self._serial.read(self._serial.in_waiting)
        except OSError as error:
            raise self._gone(error) from error
        *lines, self._text = (self._text + data).split(b"\n")
        said = [line.decode("ascii", "replace").strip() for line in lines]
        for line in said:
            self._judge(line)
        return said

    def _judge(self, line: str) -> None:
        self.ended = self.ended or line == "start" or marlin.halts(line)
        if line == "start":
            cause: Cause = "lost" if self._begun else "refused"
            raise RigFault(cause, f"{self._port}: the printer has restarted, so that its place is unknown", HOME)
        if marlin.halts(line):
            message = f"{self._port}: the printer has halted ({line.removeprefix('Error:')})"
            raise RigFault("emergency_stop", message, f"switch it off and on, {HOME}")

    def _write(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except OSError as error:
            raise self._gone(error) from error

    def _gone(self, error: OSError) -> RigFault:
        return RigFault("lost", f"{self._port}: the printer is gone ({error})", "check its cable and connect again")


def _confirms(line: str) -> bool:
    return line == "ok" or line.startswith("ok ")


def _keep_running(serial: Any) -> None:
    """Leave the line that restarts many boards as it is when the port is closed: the next opening restarts none then.

    A port that knows no such line, or Windows, keeps its ways.
    """
    try:
        import termios
    except ModuleNotFoundError:
        return
    with suppress(OSError, termios.error):
        settings = termios.tcgetattr(serial.fileno())
        settings[2] &= ~termios.HUPCL
        termios.tcsetattr(serial.fileno(), termios.TCSANOW, settings)
