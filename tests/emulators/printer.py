"""An emulated 3D printer at a pseudo-terminal, with as much of Marlin as pressing needs; it fails on demand."""

import math
import re
import threading
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, replace
from functools import partialmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.sense.arrays import Array
from padforge.sense.rig import clock
from padforge.sense.rig.arms.motion import Position, StraightMove
from padforge.sense.rig.arms.printer_link import checksum
from tests.emulators.boards import SerialDevice

MAX_PLANNED = 16  # moves that the planner holds; a further one waits
START_S = 0.1  # how long the first move waits for others
BUSY_S = 2.0  # pause between two lines that say that the firmware is busy
STEPS_PER_MM = (80, 80, 400)
IDENTITY = (
    "FIRMWARE_NAME:Marlin 2.1.2 (emulated) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin PROTOCOL_VERSION:1.0"
    " MACHINE_TYPE:Emulated printer EXTRUDER_COUNT:1 UUID:cede2a2f-41a2-4748-9b12-c55c62f367ff"
)

_LINE = re.compile(rb"^N(-?\d+) ?(.*?)\*(-?\d+)$")
_EMERGENCY = re.compile(rb"^(?:N\d+ )?M(112|410)\b")


@dataclass(frozen=True)
class ExecutedMove:
    """A move that was executed, perhaps not to its end."""

    start_s: float  # time of its start
    move: StraightMove  # as planned
    duration_s: float  # how much of it was executed

    @property
    def end_s(self) -> float:
        return self.start_s + self.duration_s

    def position(self, time_s: float) -> Position:
        return self.move.position(min(time_s - self.start_s, self.duration_s))


class Firmware:
    """Marlin without its port: lines in, answers out, and straight moves, at times that the caller passes."""

    def __init__(
        self,
        position: Position,
        *,
        max_mm_s: Position = (500.0, 500.0, 15.0),
        max_mm_s2: Position = (3000.0, 3000.0, 100.0),
        bed_mm: Position = (220.0, 220.0, 250.0),
        emergency_parser: bool = True,
        realtime: bool = True,
    ) -> None:
        """Switch on a printer that was homed; mm, mm/s and mm/s² of x, y and z."""
        self._max_mm_s, self._max_mm_s2, self._bed_mm = max_mm_s, max_mm_s2, bed_mm
        self._emergency_parser, self._realtime = emergency_parser, realtime
        self.moves: list[ExecutedMove] = [ExecutedMove(-math.inf, StraightMove(position, position, 1.0, 1.0), 0.0)]
        self._acceleration, self._feed = 500.0, 25.0
        self._text, self._lines = bytearray(), deque[bytes]()
        self._last_number = 0
        self._out = bytearray()
        self._waiting = False
        self._last_busy_s = self._busy_until_s = -math.inf
        self.halted = False

    def position(self, time_s: float) -> Position:
        number = bisect_right(self.moves, time_s, key=lambda move: move.start_s) - 1
        return self.moves[max(number, 0)].position(time_s)

    def busy(self, until_s: float) -> None:
        """Take no command before a time: a person is at the display."""
        self._busy_until_s = until_s

    def kill(self, now_s: float) -> None:
        self._cut(now_s)
        self._say("Error:Printer halted. kill() called!")
        self.halted = True
        self._lines.clear()

    def restart(self, now_s: float) -> None:
        self._cut(now_s)
        self.halted, self._last_number = False, 0
        self._text.clear()
        self._lines.clear()
        self._busy_until_s = -math.inf
        self._say("start", "Marlin 2.1.2", "echo: Last Updated: 2023-07-16 | Author: (none, default config)")

    def receive(self, data: bytes, now_s: float) -> None:
        if self.halted:
            return
        *lines, tail = (bytes(self._text) + data).split(b"\n")
        self._text[:] = tail
        for line in filter(None, (line.strip() for line in lines)):
            if self._emergency_parser and (match := _EMERGENCY.match(line)):
                self.kill(now_s) if match[1] == b"112" else self._cut(now_s)
            self._lines.append(line)

    def run(self, now_s: float) -> bytes:
        """Execute what can be executed by now and return the answers."""
        while self._lines and not self.halted and self._can_execute(self._lines[0], now_s):
            self._waiting = False
            self._execute(self._lines.popleft(), now_s)
        if self._lines and not self.halted and now_s - self._last_busy_s >= BUSY_S:
            self._last_busy_s = now_s
            self._say("echo:busy: processing")
        answers = bytes(self._out)
        self._out.clear()
        return answers

    def _can_execute(self, line: bytes, now_s: float) -> bool:
        n_planned = sum(move.end_s > now_s for move in self.moves[-MAX_PLANNED:])
        blocked = b"M400" in line and n_planned
        ready = now_s >= self._busy_until_s and not blocked and n_planned < MAX_PLANNED
        if not ready and not self._waiting:
            self._waiting, self._last_busy_s = True, now_s
        return ready

    def _execute(self, line: bytes, now_s: float) -> None:
        command = self._verify(line) if line.startswith(b"N") else line
        if command is None:
            return
        code, *words = command.decode("ascii", "replace").split() or [""]
        do = getattr(self, f"_do_{code.lower()}", None) if code.isascii() and code.isalnum() else None
        if do is None:
            self._say(f'echo:Unknown command: "{command.decode("ascii", "replace")}"')
        else:
            do({word[0]: word[1:] for word in words}, now_s)
        if not self.halted:
            self._say("ok")

    def _verify(self, line: bytes) -> bytes | None:
        """Return the command of a numbered line; if it is damaged or out of order, request it again and return None."""
        match = _LINE.match(line)
        prefix = re.match(rb"^N(-?\d+)", line)
        number = int(prefix[1]) if prefix else 0
        resets = b"M110" in line
        if number != self._last_number + 1 and not resets:
            self._request_resend("Line Number is not Last Line Number+1")
        elif match is None:
            self._request_resend("No Checksum with line number")
        elif checksum(line[: line.rindex(b"*")]) != int(match[3]):
            self._request_resend("checksum mismatch")
        else:
            self._last_number = int(line.rpartition(b"N")[2].partition(b"*")[0]) if resets else number
            return match[2]
        return None

    def _request_resend(self, error: str) -> None:
        last = self._last_number
        self._say(f"Error:{error}, Last Line: {last}", f"Resend: {last + 1}", "ok")
        self._lines.clear()

    def _do_g1(self, words: dict[str, str], now_s: float) -> None:
        start = self._planned_position()
        end = (float(words.get(axis, value)) for axis, value in zip("XYZ", start, strict=True))
        x, y, z = (min(max(value, 0.0), limit) for value, limit in zip(end, self._bed_mm, strict=True))  # endstops
        self._feed = float(words["F"]) / 60 if "F" in words else self._feed
        move = StraightMove(start, (x, y, z), self._feed, self._acceleration)
        move = move.limit_axes(self._max_mm_s, self._max_mm_s2)
        if move.length_mm:
            start_s = max(now_s + START_S, self.moves[-1].end_s)
            self.moves.append(ExecutedMove(start_s, move, move.duration_s))

    def _do_m114(self, words: dict[str, str], now_s: float) -> None:
        x, y, z = self.position(now_s) if self._realtime and "R" in words else self._planned_position()
        counts = [round(value * steps) for value, steps in zip((x, y, z), STEPS_PER_MM, strict=True)]
        self._say(f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:0.00 Count X:{counts[0]} Y:{counts[1]} Z:{counts[2]}")

    def _do_m115(self, words: dict[str, str], now_s: float) -> None:
        capabilities = {"EEPROM": 1, "AUTOREPORT_POS": 0, "EMERGENCY_PARSER": int(self._emergency_parser)}
        self._say(IDENTITY, *(f"Cap:{name}:{value}" for name, value in capabilities.items()))

    def _do_m204(self, words: dict[str, str], now_s: float) -> None:
        self._acceleration = float(words.get("T", self._acceleration))

    def _do_m410(self, words: dict[str, str], now_s: float) -> None:
        self._cut(now_s)

    def _do_m112(self, words: dict[str, str], now_s: float) -> None:
        self.kill(now_s)

    def _do_m503(self, words: dict[str, str], now_s: float) -> None:
        limits = (("M203", "feedrates", self._max_mm_s), ("M201", "Acceleration", self._max_mm_s2))
        for code, name, (x, y, z) in limits:
            self._say(f"echo:; Maximum {name} (units/s):", f"echo:  {code} X{x:.2f} Y{y:.2f} Z{z:.2f} E25.00")

    def _do_nothing(self, words: dict[str, str], now_s: float) -> None:
        """Accept settings that change nothing here, and M400, which has waited already."""

    _do_g21 = _do_g90 = _do_m84 = _do_m110 = _do_m211 = _do_m220 = _do_m400 = _do_nothing

    def _planned_position(self) -> Position:
        return self.moves[-1].move.position(self.moves[-1].duration_s)

    def _cut(self, now_s: float) -> None:
        """End all moves at once; those that have not started are never executed."""
        *moves, last = [move for move in self.moves if move.start_s < now_s]
        self.moves = [*moves, replace(last, duration_s=min(last.duration_s, now_s - last.start_s))]

    def _say(self, *lines: str) -> None:
        self._out += "".join(f"{line}\n" for line in lines).encode("ascii", "replace")


class EmulatedPrinter(SerialDevice):
    """The printer at a serial port, its `firmware` read once it stands; the noise of `garble` is on both directions."""

    def __init__(self, position: Position, *, restarts: bool = False, seed: int = 0, **firmware: Any) -> None:
        """Open the pseudo-terminal; with `restarts` it restarts at the first bytes from a host, as many boards do."""
        super().__init__("printer", seed)
        self.firmware, self._restarts = Firmware(position, **firmware), restarts
        self._lock = threading.Lock()

    def _change(self, name: str, seconds: float = 0.0) -> None:
        with self._lock:
            getattr(self.firmware, name)(clock.now() + seconds)

    halt = partialmethod(_change, "kill")  # the firmware finds a fault and stops for good
    restart = partialmethod(_change, "restart")  # it no longer knows where it is
    busy = partialmethod(_change, "busy")  # take no command for some seconds: a person is at the display

    def true_positions(self, times_s: ArrayLike) -> Array:
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64)).tolist()
        with self._lock:
            return np.array([self.firmware.position(time_s) for time_s in times]).reshape(-1, 3)

    def _step(self, data: bytes) -> None:
        data = self._add_noise(data)
        with self._lock:
            now_s = clock.now()
            if data and self._restarts:
                self._restarts, data = False, b""
                self.firmware.restart(now_s)
            self.firmware.receive(data, now_s)
            self._out += self._add_noise(self.firmware.run(now_s))

    def _wait_s(self) -> float:
        return 0.005
