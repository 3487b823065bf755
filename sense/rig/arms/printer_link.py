"""Straight moves from rest to rest as a printer makes them: a trapezoid of speed, each axis within its own limits.

What Marlin is told and what it says, line by line: numbered lines out, answers, places and limits in.

A serial port at which Marlin listens: every line has a number and is executed once, whatever noise there is.
"""

import math
import re
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import Any

from padforge.sense.rig.devices import Cause, RigFault, open_port

Place = tuple[float, float, float]
"""x, y and z, mm."""


@dataclass(frozen=True)
class StraightMove:
    """A move of some speed, mm/s, and acceleration, mm/s², both > 0."""

    start: Place
    end: Place
    speed: float
    acceleration: float

    @property
    def length_mm(self) -> float:
        """From start to end."""
        return math.dist(self.start, self.end)

    @property
    def duration_s(self) -> float:
        """From rest to rest."""
        return 2 * self._rise_s + self._cruise_s

    def within(self, speeds: Sequence[float], accelerations: Sequence[float]) -> "StraightMove":
        """The same move, so slow that no axis exceeds its own speed and acceleration."""
        if not self.length_mm:
            return self
        shares = [abs(b - a) / self.length_mm for a, b in zip(self.start, self.end, strict=True)]
        speed, acceleration = (
            min([wanted, *(limit / share for limit, share in zip(limits, shares, strict=True) if share)])
            for wanted, limits in ((self.speed, speeds), (self.acceleration, accelerations))
        )
        return StraightMove(self.start, self.end, speed, acceleration)

    def at(self, t_s: float) -> Place:
        """Where the move is `t_s` seconds after its beginning; its start before that, its end after it."""
        t, left = max(t_s, 0.0), max(self.duration_s - t_s, 0.0)
        if left == 0:
            return self.end
        rise, top = self._rise_s, self.acceleration * self._rise_s
        if t < rise:
            gone = self.acceleration * t * t / 2
        elif left < rise:
            gone = self.length_mm - self.acceleration * left * left / 2
        else:
            gone = top * (t - rise / 2)
        share = gone / self.length_mm
        x, y, z = (a + share * (b - a) for a, b in zip(self.start, self.end, strict=True))
        return x, y, z

    def distance_mm(self, place: Place) -> float:
        """How far a place lies from the way."""
        way, to = ([b - a for a, b in zip(self.start, end, strict=True)] for end in (self.end, place))
        square = self.length_mm**2
        share = sum(a * b for a, b in zip(way, to, strict=True)) / square if square else 0.0
        share = min(max(share, 0.0), 1.0)
        return math.dist(to, [share * a for a in way])

    @property
    def _rise_s(self) -> float:
        return min(self.speed / self.acceleration, math.sqrt(self.length_mm / self.acceleration))

    @property
    def _cruise_s(self) -> float:
        return self.length_mm / (self.acceleration * self._rise_s) - self._rise_s if self._rise_s else 0.0


FIRMWARE = "Marlin"
HALTED = ("halted", "kill()", "STOP called", "stopped")
"""Words of errors after which the firmware takes no further moves; other errors are of a damaged line."""

_NUMBER = r"(-?\d+(?:\.\d+)?)"
_PLACE = re.compile(rf"^X:{_NUMBER} Y:{_NUMBER} Z:{_NUMBER}(?: |$)")
_RESEND = re.compile(r"^(?:Resend:|rs) ?N?(\d+)$")


def numbered(number: int, command: str) -> bytes:
    """A command as a line with its number and the exclusive or of all bytes before the star."""
    text = f"N{number} {command}".encode("ascii")
    return b"%s*%d\n" % (text, reduce(xor, text))


def move(end: Place, speed_mm_s: float) -> str:
    """A straight move of the nozzle."""
    x, y, z = end
    return f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f} F{60 * speed_mm_s:.1f}"


def resend(line: str) -> int | None:
    """The number of the line that is asked for again; None where the line says something else."""
    found = _RESEND.match(line)
    return int(found[1]) if found else None


def place(line: str) -> Place | None:
    """The nozzle's place in an answer to M114; None where the line is none."""
    found = _PLACE.match(line)
    return (float(found[1]), float(found[2]), float(found[3])) if found else None


def waits_for_moves(name: str) -> bool:
    """Whether a firmware of this name answers M114 only once all moves are over, as Marlin did before 2."""
    return re.match(r"Marlin (bugfix-)?1\.", name) is not None


def halts(line: str) -> bool:
    """Whether the line says that the firmware has stopped for good."""
    return line.startswith("Error:") and any(words in line for words in HALTED)


@dataclass(frozen=True)
class PrinterDialect:
    """What a printer says of itself in answer to M115.

    Attributes:
        name: of the firmware, with its version. machine: of the printer.
        capabilities: those it has, such as EMERGENCY_PARSER.
    """

    name: str = ""
    machine: str = ""
    capabilities: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def of(cls, lines: list[str]) -> "PrinterDialect":
        """From the lines of the answer."""
        text = "\n".join(lines)
        name = re.search(r"FIRMWARE_NAME:(.*?)(?: [A-Z_]+:|$)", text, re.MULTILINE)
        machine = re.search(r"MACHINE_TYPE:(.*?)(?: [A-Z_]+:|$)", text, re.MULTILINE)
        able = re.findall(r"^Cap:([A-Z0-9_]+):1$", text, re.MULTILINE)
        return cls(name[1].strip() if name else "", machine[1].strip() if machine else "", frozenset(able))


def limits(lines: list[str], code: str) -> Place | None:
    """The greatest speeds (code M203, mm/s) or accelerations (M201, mm/s²) of x, y and z in the answer to M503."""
    found = re.search(rf"\b{code} X{_NUMBER} Y{_NUMBER} Z{_NUMBER}", "\n".join(lines))
    values = (float(found[1]), float(found[2]), float(found[3])) if found else None
    return values if values and min(values) > 0 else None


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
        self._down_command = self.ended = False

    def begin(self, wait_s: float) -> None:
        """Wait until the printer answers, and count its lines from 0.

        Raises:
            RigFault: "refused" where nothing that speaks G-code answers, or the printer restarts as its port is opened.
        """
        end = time.monotonic() + wait_s
        while time.monotonic() < end:
            self._write(b"\n" + numbered(0, "M110 N0"))
            if any(map(_confirms, list(self._quiet()))):
                self._down_command = True
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
        self._sent.append(numbered(self._number, command))
        answer: list[str] = []
        due, end = 0.0, time.monotonic() + wait_s
        tries = strange = wanted = 0
        while (now := time.monotonic()) < end:
            if now >= due:
                self._write(self._sent[-1])
                answer, due, tries = [], now + _RESEND_S, tries + 1
            for line in self._receive():
                due = time.monotonic() + _RESEND_S
                if (asked := resend(line)) is not None:
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
        self.ended = self.ended or line == "start" or halts(line)
        if line == "start":
            cause: Cause = "lost" if self._down_command else "refused"
            raise RigFault(cause, f"{self._port}: the printer has restarted, so that its place is unknown", HOME)
        if halts(line):
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
