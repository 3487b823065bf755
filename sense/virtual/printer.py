"""Marlin as far as a presser needs it: lines in, answers out, and straight moves in the time that the caller tells.

A stand-in for the printer, which fails on demand.
"""

import math
import re
import threading
import time
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, replace
from functools import reduce
from operator import xor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.sense.arrays import Array
from padforge.sense.rig.arms.printer_link import Place, StraightMove
from padforge.sense.virtual.boards import SerialDevice

PLANNED = 16
"""Moves that wait for their turn; a further one waits at the door."""
START_S = 0.1
"""How long the first move waits for others."""
BUSY_S = 2.0
"""Pause between two lines that say that the firmware is busy."""
STEPS_MM = (80, 80, 400)
IDENTITY = (
    "FIRMWARE_NAME:Marlin 2.1.2 (emulated) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin PROTOCOL_VERSION:1.0"
    " MACHINE_TYPE:Emulated printer EXTRUDER_COUNT:1 UUID:cede2a2f-41a2-4748-9b12-c55c62f367ff"
)

_LINE = re.compile(rb"^N(-?\d+) ?(.*?)\*(-?\d+)$")
_AT_ONCE = re.compile(rb"^(?:N\d+ )?M(112|410)\b")


@dataclass(frozen=True)
class Made:
    """A move, when it began, and how many seconds of it were made."""

    begun_s: float
    move: StraightMove
    lasted_s: float

    def at(self, time_s: float) -> Place:
        """Where the nozzle was at a time from its beginning on."""
        return self.move.at(min(time_s - self.begun_s, self.lasted_s))

    @property
    def end_s(self) -> float:
        """When it ended."""
        return self.begun_s + self.lasted_s


class Firmware:
    """A printer whose nozzle stands at `at`, mm from its true origin, and that was homed there.

    Attributes:
        made: all moves, the first a stand at the beginning.
        halted: whether it was killed. homed: whether it knows where it is.
    """

    def __init__(
        self,
        at: Place,
        *,
        max_mm_s: Place = (500.0, 500.0, 15.0),
        max_mm_s2: Place = (3000.0, 3000.0, 100.0),
        bed_mm: Place = (220.0, 220.0, 250.0),
        emergency_parser: bool = True,
        realtime: bool = True,
    ) -> None:
        """Describe the printer: limits and reach of its axes, whether M112 and M410 act at once, whether M114 has R."""
        self._speeds, self._accelerations, self._bed = max_mm_s, max_mm_s2, bed_mm
        self._emergency_parser, self._realtime = emergency_parser, realtime
        self.made: list[Made] = [Made(-math.inf, StraightMove(at, at, 1.0, 1.0), 0.0)]
        self._origin: Place = (0.0, 0.0, 0.0)
        self._acceleration, self._feed = 500.0, 25.0
        self._text, self._lines = bytearray(), deque[bytes]()
        self._last = 0
        self._out = bytearray()
        self._waits_s: float | None = None
        self._told_s = self._busy_until_s = -math.inf
        self.halted, self.homed = False, True

    def at(self, time_s: float) -> Place:
        """Where the nozzle truly was at a time, mm."""
        moves = self.made
        return moves[max(bisect_right(moves, time_s, key=lambda made: made.begun_s) - 1, 0)].at(time_s)

    def busy(self, until_s: float) -> None:
        """Take no command before a time: somebody is at the display."""
        self._busy_until_s = until_s

    def kill(self, now_s: float) -> None:
        """Stop for good."""
        self._cut(now_s)
        self._say("Error:Printer halted. kill() called!")
        self.halted = True
        self._lines.clear()

    def restart(self, now_s: float) -> None:
        """Begin anew, as after a reset: wherever the nozzle is, the firmware takes it for 0, 0, 0."""
        self._cut(now_s)
        self._origin, self.homed, self.halted, self._last = self.at(now_s), False, False, 0
        self._text.clear()
        self._lines.clear()
        self._busy_until_s = -math.inf
        self._say("start", "Marlin 2.1.2", "echo: Last Updated: 2023-07-16 | Author: (none, default config)")

    def home(self) -> None:
        """Find out where the nozzle is, as a person makes it do."""
        self._origin, self.homed = (0.0, 0.0, 0.0), True

    def hear(self, data: bytes, now_s: float) -> None:
        """Take what came in."""
        if self.halted:
            return
        *lines, rest = (bytes(self._text) + data).split(b"\n")
        self._text[:] = rest
        for line in filter(None, (line.strip() for line in lines)):
            if self._emergency_parser and (order := _AT_ONCE.match(line)):
                self.kill(now_s) if order[1] == b"112" else self._cut(now_s)
            self._lines.append(line)

    def speak(self, now_s: float) -> bytes:
        """Do what can be done by now; what is said about it."""
        while self._lines and not self.halted and self._free(self._lines[0], now_s):
            self._waits_s = None
            self._execute(self._lines.popleft(), now_s)
        if self._lines and not self.halted and now_s - self._told_s >= BUSY_S:
            self._told_s = now_s
            self._say("echo:busy: processing")
        said = bytes(self._out)
        self._out.clear()
        return said

    def _free(self, line: bytes, now_s: float) -> bool:
        """Whether a line can be executed now, or has to wait."""
        waiting = sum(made.end_s > now_s for made in self.made[-PLANNED:])
        rests = b"M400" not in line or not waiting
        free = now_s >= self._busy_until_s and rests and waiting < PLANNED
        if not free and self._waits_s is None:
            self._waits_s = self._told_s = now_s
        return free

    def _execute(self, line: bytes, now_s: float) -> None:
        if line.startswith(b"N"):
            command = self._checked(line)
            if command is None:
                return
        else:
            command = line
        code, *words = command.decode("ascii", "replace").split() or [""]
        do = getattr(self, f"_do_{code.lower()}", None) if code.isascii() and code.isalnum() else None
        if do is None:
            self._say(f'echo:Unknown command: "{command.decode("ascii", "replace")}"')
        else:
            do({word[0]: word[1:] for word in words}, now_s)
        if not self.halted:
            self._say("ok")

    def _checked(self, line: bytes) -> bytes | None:
        """The command of a numbered line; None, and it is asked for again, where something is wrong with it."""
        whole = _LINE.match(line)
        begins = re.match(rb"^N(-?\d+)", line)
        number = int(begins[1]) if begins else 0
        resets = b"M110" in line
        if number != self._last + 1 and not resets:
            self._again("Line Number is not Last Line Number+1")
        elif whole is None:
            self._again("No Checksum with line number")
        elif reduce(xor, line[: line.rindex(b"*")]) != int(whole[3]):
            self._again("checksum mismatch")
        else:
            self._last = int(line.rpartition(b"N")[2].partition(b"*")[0]) if resets else number
            return whole[2]
        return None

    def _again(self, error: str) -> None:
        self._say(f"Error:{error}, Last Line: {self._last}", f"Resend: {self._last + 1}", "ok")
        self._lines.clear()

    def _do_g1(self, words: dict[str, str], now_s: float) -> None:
        start = self._planned()
        x, y, z = (float(words.get(axis, value)) for axis, value in zip("XYZ", self._believed(start), strict=True))
        end = self._true((x, y, z))
        if self.homed:  # software endstops heed axes that were homed
            x, y, z = (min(max(value, 0.0), most) for value, most in zip(end, self._bed, strict=True))
            end = x, y, z
        self._feed = float(words["F"]) / 60 if "F" in words else self._feed
        move = StraightMove(start, end, self._feed, self._acceleration).within(self._speeds, self._accelerations)
        if move.length_mm:
            down_command = max(now_s + START_S, self.made[-1].end_s)
            self.made.append(Made(down_command, move, move.duration_s))

    _do_g0 = _do_g1

    def _do_m114(self, words: dict[str, str], now_s: float) -> None:
        x, y, z = self._believed(self.at(now_s) if self._realtime and "R" in words else self._planned())
        counts = [round(value * steps) for value, steps in zip((x, y, z), STEPS_MM, strict=True)]
        self._say(
            f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:0.00 Count X:{counts[0]} Y:{counts[1]} Z:{counts[2]}",
        )

    def _do_m115(self, words: dict[str, str], now_s: float) -> None:
        able = {"EEPROM": 1, "AUTOREPORT_POS": 0, "EMERGENCY_PARSER": int(self._emergency_parser), "MOTION_MODES": 0}
        self._say(IDENTITY, *(f"Cap:{name}:{value}" for name, value in able.items()))

    def _do_m204(self, words: dict[str, str], now_s: float) -> None:
        self._acceleration = float(words.get("T", self._acceleration))

    def _do_m410(self, words: dict[str, str], now_s: float) -> None:
        self._cut(now_s)

    def _do_m112(self, words: dict[str, str], now_s: float) -> None:
        self.kill(now_s)

    def _do_m503(self, words: dict[str, str], now_s: float) -> None:
        for code, name, values in (("M203", "feedrates", self._speeds), ("M201", "Acceleration", self._accelerations)):
            x, y, z = values
            self._say(f"echo:; Maximum {name} (units/s):", f"echo:  {code} X{x:.2f} Y{y:.2f} Z{z:.2f} E25.00")

    def _do_nothing(self, words: dict[str, str], now_s: float) -> None:
        """Settings that change nothing here, and M400, which has waited already."""

    _do_g21 = _do_g90 = _do_m84 = _do_m110 = _do_m211 = _do_m220 = _do_m400 = _do_nothing

    def _planned(self) -> Place:
        return self.made[-1].move.at(self.made[-1].lasted_s)

    def _cut(self, now_s: float) -> None:
        """End all moves at once; those that have not begun are never made."""
        down_command = [made for made in self.made if made.begun_s < now_s]
        self.made = [
            *down_command[:-1],
            replace(down_command[-1], lasted_s=min(down_command[-1].lasted_s, now_s - down_command[-1].begun_s)),
        ]

    def _believed(self, true: Place) -> Place:
        x, y, z = (value - origin for value, origin in zip(true, self._origin, strict=True))
        return x, y, z

    def _true(self, believed: Place) -> Place:
        x, y, z = (value + origin for value, origin in zip(believed, self._origin, strict=True))
        return x, y, z

    def _say(self, *lines: str) -> None:
        self._out += "".join(f"{line}\n" for line in lines).encode("ascii", "replace")


_PAUSE_S = 0.005


class EmulatedPrinter(SerialDevice):
    """The printer at a serial port.

    Attributes:
        firmware: what it runs; to be looked at once the printer stands or is unplugged.
    """

    def __init__(self, at: Place, *, restarts: bool = False, seed: int = 0, **firmware: Any) -> None:
        """Open the pseudo-terminal.

        Args:
            at: where the nozzle stands. restarts: begin anew at the first sign of a host, as many boards do.
            seed: of the damage by `garble`. firmware: see `Firmware`.
        """
        super().__init__("printer", seed)
        self.firmware, self._restarts = Firmware(at, **firmware), restarts
        self._lock = threading.Lock()

    def halt(self) -> None:
        """Let the firmware find something wrong and stop for good."""
        with self._lock:
            self.firmware.kill(time.monotonic())

    def restart(self) -> None:
        """Let the board begin anew: it no longer knows where it is."""
        with self._lock:
            self.firmware.restart(time.monotonic())

    def home(self) -> None:
        """What a person does at the display."""
        with self._lock:
            self.firmware.home()

    def busy(self, seconds: float) -> None:
        """Take no command for so long: somebody is at the display."""
        with self._lock:
            self.firmware.busy(time.monotonic() + seconds)

    def garble(self, probability: float) -> None:
        """Flip a bit of, drop or double each byte of both directions with `probability`."""
        self._garble = probability

    def nozzle_at(self, times_s: ArrayLike) -> Array:
        """(n, 3) true places of the nozzle at monotonic times (n,), mm."""
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64)).tolist()
        with self._lock:
            return np.array([self.firmware.at(time_s) for time_s in times]).reshape(-1, 3)

    def _turn(self, data: bytes) -> None:
        data = self._damaged(data)
        with self._lock:
            now = time.monotonic()
            if data and self._restarts:
                self._restarts, data = False, b""
                self.firmware.restart(now)
            self.firmware.hear(data, now)
            self._out += self._damaged(self.firmware.speak(now))

    def _pause_s(self) -> float:
        return _PAUSE_S
