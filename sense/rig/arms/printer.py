"""A 3D printer with Marlin as an arm: a probe clamped beside its nozzle presses, G-code over a serial port moves it.

Poses are those of the probe's tip in the printer's own frame: the nozzle's position plus `[rig] tcp_mm`. The tip cannot
turn, and a printer measures no force.

A thread owns the port. It moves the nozzle and polls its position. A firmware with a real-time position (`M114 R`)
reports where the nozzle is. Others report the end of the move; during a move the position is then computed from the
commanded motion. A move has ended when the firmware has emptied its queue (`M400`) and the nozzle stands at its target.
"""

import math
import queue
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from typing import Any, NoReturn

import numpy as np

from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig import clock
from padforge.sense.rig.arms.motion import Position, StraightMove
from padforge.sense.rig.arms.printer_link import (
    FIRMWARE,
    HOMING_ADVICE,
    MarlinLink,
    format_move,
    parse_axis_limits,
    parse_identity,
    parse_position,
)
from padforge.sense.rig.devices import ArmState, Array, RigFault
from padforge.sense.rig.safety import MAX_STATE_AGE_S, check_finite_move, check_probe
from padforge.sense.settings import RigSettings

CONNECT_S = 3.0  # longest wait for a printer that restarts as its port is opened
SETTINGS = ("G21", "G90", "M220 S100", "M211 S1", "M84 S0")
"""Millimetres, absolute positions, speeds at 100 %, software endstops on, motors always energized."""

_POLL_S = 0.03  # pause between two requests for the position
_TOLERANCE_MM = 0.05  # tolerance of a position at rest: its last decimal and one motor step
_START_S = 0.1  # time for which a firmware waits for further moves before it starts the first
_MAX_LATE_S = 1.2  # a move that lasts longer than planned by more than this is implausible
_MAX_OFF_PATH_MM = 1.0  # a position farther from the straight path is implausible
_MAX_IMPLAUSIBLE = 3  # implausible positions in a row; fewer are noise


class NozzleThread(threading.Thread):
    """The thread that moves the nozzle and polls its position; its states are those of the tip."""

    def __init__(
        self, link: MarlinLink, position: Position, rig: RigSettings, max_mm_s: Position, max_mm_s2: Position
    ) -> None:
        super().__init__(name="printer", daemon=True)
        self._link, self._rig, self._max_mm_s, self._max_mm_s2 = link, rig, max_mm_s, max_mm_s2
        self._position = position  # the last one at rest
        self._reported = position  # the last one that was reported
        self._move: StraightMove | None = None
        self._move_start_s, self._acceleration, self._n_implausible = 0.0, 0.0, 0
        self._commands: queue.Queue[tuple[Callable[[], None], Future[None]]] = queue.Queue()
        self._states: deque[ArmState] = deque(maxlen=100_000)  # for `drain`
        self._ending = threading.Event()
        self.fault: RigFault | None = None  # why the position is unknown, if it is
        self.latest = self._to_arm_state(clock.now(), position, 0.0)

    def run(self) -> None:
        """Poll the position and execute commands until `end` is called or a fault occurs."""
        try:
            while not self._ending.is_set():
                try:
                    command, result = self._commands.get(timeout=_POLL_S)
                except queue.Empty:
                    self._poll()
                else:
                    self._execute(command, result)
        except RigFault as fault:
            self.fault = fault
        except Exception as error:  # a thread that dies silently would look like a printer at rest
            self.fault = RigFault("lost", f"the thread that moves the printer has failed ({error!r})")

    def drain(self) -> list[ArmState]:
        """Return the states since the last call."""
        return [self._states.popleft() for _ in range(len(self._states))]

    def move(self, end: Position, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Start a straight move; return as soon as the firmware has confirmed its target, or raise RigFault."""
        self._submit(lambda: self._start_move(end, speed_mm_s, acceleration_mm_s2), timeout_s=0.8)

    def stop(self) -> None:
        """Stop the current move; if the quick stop is not confirmed, halt the printer and raise RigFault("lost")."""
        if self._move is None or self._link.halted:
            return
        try:
            self._submit(self._quick_stop, timeout_s=0.3)
        except RigFault:
            self._link.send_unnumbered("M112")
            self._move = None
            reason = "the printer did not confirm the stop, and was told to halt"
            self.fault = RigFault("lost", reason, f"see that it stands, or switch it off; {HOMING_ADVICE}")
            raise self.fault from None

    def end(self) -> None:
        """End the thread."""
        self._ending.set()
        self.join()

    def _submit(self, command: Callable[[], None], timeout_s: float) -> None:
        if self.fault is not None:
            raise self.fault
        result: Future[None] = Future()
        self._commands.put((command, result))
        deadline_s = clock.now() + timeout_s
        while not result.done() and clock.now() < deadline_s:
            wait([result], _POLL_S)
        if not result.done():
            result.cancel()  # otherwise it could run later, when nobody waits for it
            raise self.fault or RigFault("deadline", f"the printer did not answer within {timeout_s} s")
        result.result()

    def _execute(self, command: Callable[[], None], result: "Future[None]") -> None:
        if not result.set_running_or_notify_cancel():
            return
        try:
            command()
        except RigFault as fault:
            result.set_exception(fault)
            if fault.cause != "refused":
                raise
        else:
            result.set_result(None)

    def _start_move(self, end: Position, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        if self._move is not None:
            raise RigFault("refused", "a move of the printer is under way", "wait for its end or stop it")
        move = StraightMove(self._position, end, speed_mm_s, acceleration_mm_s2)
        move = move.limit_axes(self._max_mm_s, self._max_mm_s2)
        if not move.length_mm:
            return
        self._move = move  # set before anything is sent, since `stop` does nothing without a move
        if move.acceleration != self._acceleration:
            self._link.execute(f"M204 P{move.acceleration:.1f} T{move.acceleration:.1f}")
            self._acceleration = move.acceleration
        self._link.execute(format_move(end, move.speed))
        self._move_start_s = clock.now()
        # M114 without R reports the planned target, which the software endstops may have clipped.
        if math.dist(planned := self._ask_position("M114", end), end) > _TOLERANCE_MM:
            self._quick_stop()
            self._raise_displaced(f"is about to go to {_format(planned)}", end)
        self._add_state(clock.now(), move.start)

    def _poll(self) -> None:
        move = self._move
        if move is None:
            self._check_at_rest(self._position)
            self._add_state(clock.now(), self._position)
            return
        position = self._ask_position("M114 R", None)
        now_s = clock.now()
        elapsed_s = now_s - self._move_start_s
        is_at_end = math.dist(position, move.end) <= _TOLERANCE_MM
        if is_at_end and elapsed_s >= move.duration_s:
            self._add_state(now_s, position)
            self._link.execute("M400")
            self._check_at_rest(move.end)
            self._stop_at(move.end)
            return
        if is_at_end:  # too early: the firmware reports its target, and no real-time position
            position = move.position(elapsed_s - _START_S)
        is_late = elapsed_s > move.duration_s + _MAX_LATE_S
        is_off_path = move.distance_mm(position) > _MAX_OFF_PATH_MM
        self._n_implausible = self._n_implausible + 1 if is_late or is_off_path else 0
        if self._n_implausible >= _MAX_IMPLAUSIBLE:
            self._raise_displaced(f"is at {_format(position)}", move.end)
        if not self._n_implausible:
            self._add_state(now_s, position)

    def _quick_stop(self) -> None:
        self._link.execute("M410")
        self._link.execute("M400")
        self._stop_at(self._ask_position("M114", None))

    def _stop_at(self, position: Position) -> None:
        self._move, self._position, self._n_implausible = None, position, 0
        self._add_state(clock.now(), position)

    def _check_at_rest(self, expected: Position) -> None:
        if math.dist(position := self._ask_position("M114 R", expected), expected) > _TOLERANCE_MM:
            self._raise_displaced(f"stands at {_format(position)}", expected)

    def _ask_position(self, command: str, expected: Position | None) -> Position:
        """Return the nozzle's position; repeat the request if the answer is damaged or not the expected position."""
        position = None
        for _ in range(_MAX_IMPLAUSIBLE):
            for line in self._link.execute(command):
                position = parse_position(line) or position
            if position and (expected is None or math.dist(position, expected) <= _TOLERANCE_MM):
                break
        if position is None:
            advice = "its link may be noisy: check its cable"
            raise RigFault("stale", "the printer does not report its position", advice)
        return position

    def _raise_displaced(self, problem: str, target: Position) -> NoReturn:
        advice = f"something else moves it, or it cannot go there: {HOMING_ADVICE}"
        raise RigFault("lost", f"the printer {problem} mm, but was sent to {_format(target)} mm", advice)

    def _add_state(self, now_s: float, position: Position) -> None:
        elapsed_s = now_s - self.latest.time_s
        is_moving = self._move is not None and elapsed_s > 0
        speed_mm_s = math.dist(position, self._reported) / elapsed_s if is_moving else 0.0
        self._reported, self.latest = position, self._to_arm_state(now_s, position, speed_mm_s)
        self._states.append(self.latest)

    def _to_arm_state(self, now_s: float, position: Position, speed_mm_s: float) -> ArmState:
        x, y, z = (a + b for a, b in zip(position, _tip_offset(self._rig), strict=True))
        moving = self._move is not None
        return ArmState(now_s, (x, y, z, *self._rig.tool_rad), speed_mm_s, None, False, False, moving)


def _tip_offset(rig: RigSettings) -> Position:
    """Return the probe's tip from the nozzle, or the nozzle itself if the tip is unknown."""
    return rig.tcp_mm or (0.0, 0.0, 0.0)


def _format(position: Position) -> str:
    return ", ".join(f"{value:.2f}" for value in position)


class Printer:
    """The printer at `[rig] printer_port`; implements `Arm`.

    The driver never homes the printer, since the probe would hit the bed; a person homes it. If this process ends, the
    printer completes its current move and stops.
    """

    def __init__(self, rig: RigSettings) -> None:
        self._rig = rig
        self._link: MarlinLink | None = None
        self._thread: NozzleThread | None = None

    @classmethod
    def from_settings(cls, rig: RigSettings) -> "Printer":
        """Return the printer that `[rig]` names."""
        return cls(rig)

    def connect(self) -> Mapping[str, Any]:
        """Open the port and set the printer up, without moving it.

        Without `[rig] tcp_mm`, poses are those of the nozzle and `move` is refused.

        Raises:
            RigFault: "refused" if no printer with Marlin answers, it has not been homed, it restarts as its port is
                opened, or its axes are too slow for the presses.
        """
        self.close()
        rig = self._rig
        if rig.printer_port is None:
            raise RigFault("refused", "[rig] printer_port is unknown, allowed is a serial port such as /dev/ttyUSB0")
        self._link = link = MarlinLink(rig.printer_port, rig.printer_baud)
        try:
            link.handshake(CONNECT_S)
            identity = _identify(link)
            max_mm_s, max_mm_s2 = _read_axis_limits(link)
            self._check_press_time(max_mm_s, max_mm_s2)
            for command in SETTINGS:
                link.execute(command)
            position = _ask_home_position(link)
        except BaseException:
            self.close()
            raise
        self._thread = NozzleThread(link, position, rig, max_mm_s, max_mm_s2)
        self._thread.start()
        return {
            "port": rig.printer_port,
            "baud": rig.printer_baud,
            **identity,
            "max_mm_s": list(max_mm_s),
            "max_mm_s2": list(max_mm_s2),
        }

    def state(self) -> ArmState:
        """Return the latest state; see `Arm.state`."""
        state = self._connected().latest
        if (age_s := clock.now() - state.time_s) > MAX_STATE_AGE_S:
            message = f"the printer's last answer is {age_s:.2f} s old; allowed {MAX_STATE_AGE_S} s"
            raise RigFault("stale", message, "it may be busy: look at its display")
        return state

    def drain(self) -> Array:
        """Return the (n, 10) states since the last call; a fault is raised once those before it are returned."""
        states = self._thread.drain() if self._thread else []
        if not states:
            self._connected()
            return np.empty((0, len(STATE_COLUMNS)))
        return np.array([state.to_row() for state in states])

    def move(self, pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Start a straight move from rest, slowed to the limits of the axes; a turn of the tool is refused, too."""
        check_finite_move(pose, speed_mm_s, acceleration_mm_s2)
        check_probe(self._rig)
        if not np.allclose(pose[3:], self._rig.tool_rad, atol=1e-6):
            raise RigFault("refused", f"a turn of the tool to {list(pose[3:])} rad; a printer cannot turn it")
        x, y, z = (float(value) - offset for value, offset in zip(pose, _tip_offset(self._rig), strict=False))
        self._connected().move((x, y, z), speed_mm_s, acceleration_mm_s2)

    def stop(self) -> None:
        """Stop the printer, and halt it for good if it does not confirm the stop; see `Arm.stop`."""
        if self._thread is not None:
            self._thread.stop()

    def close(self) -> None:
        """Stop the printer and close the port; never raises."""
        if self._thread is not None:
            with suppress(RigFault):
                self._thread.stop()
            self._thread.end()
        if self._link is not None:
            self._link.close()
        self._thread = self._link = None

    def _connected(self) -> NozzleThread:
        if self._thread is None:
            raise RigFault("lost", "there is no link to the printer", "connect first")
        if self._thread.fault:
            raise self._thread.fault
        return self._thread

    def _check_press_time(self, max_mm_s: Position, max_mm_s2: Position) -> None:
        """Raise RigFault("refused") if a press would end before the tip has reached its depth."""
        rig = self._rig
        depth_mm = rig.clearance_mm + max(rig.press_depths_mm)
        down = StraightMove((0, 0, depth_mm), (0, 0, 0), rig.press_mm_s, rig.acceleration_mm_s2)
        down_s = down.limit_axes(max_mm_s, max_mm_s2).duration_s
        if down_s >= (half_s := rig.half_cycle_s):
            raise RigFault(
                "refused",
                f"the printer's way down of {depth_mm:g} mm takes {down_s:.1f} s, allowed is less than {half_s:.2g} s,"
                " half of a press's cycle",
                "lower [rig] clearance_mm, or raise readings_per_press or press_mm_s",
            )


def _identify(link: MarlinLink) -> dict[str, Any]:
    """Return the printer's identity; RigFault("refused") unless its firmware is Marlin 2."""
    lines = link.execute("M115")
    firmware = parse_identity(lines, "FIRMWARE_NAME")
    if FIRMWARE not in firmware:
        raise RigFault("refused", f"the firmware is {firmware or 'of no name'!r}, allowed is Marlin")
    if re.match(r"Marlin (bugfix-)?1\.", firmware):  # it answers M114 only after all moves
        message = f"the firmware is {firmware!r}, which reports its position only once it stands"
        raise RigFault("refused", message, "allowed is Marlin 2")
    machine, halts_at_once = parse_identity(lines, "MACHINE_TYPE"), "Cap:EMERGENCY_PARSER:1" in lines
    return {"firmware": firmware, "machine": machine, "halts_at_once": halts_at_once}


def _read_axis_limits(link: MarlinLink) -> tuple[Position, Position]:
    lines = link.execute("M503", CONNECT_S)
    speeds, accelerations = parse_axis_limits(lines, "M203"), parse_axis_limits(lines, "M201")
    if speeds is None or accelerations is None:
        raise RigFault("refused", "the printer does not report the limits of its axes (M503: M203 and M201)")
    return speeds, accelerations


def _ask_home_position(link: MarlinLink) -> Position:
    """Return the position of the nozzle; RigFault("refused") if the printer has not been homed."""
    answers = [position for _ in range(3) for line in link.execute("M114") if (position := parse_position(line))]
    if not answers:
        raise RigFault("refused", "the printer does not report its position (M114)")
    if math.hypot(*answers[-1]) == 0:
        message = "the printer says that it is at 0, 0, 0: it has not been homed, or not raised"
        raise RigFault("refused", message, HOMING_ADVICE)
    return answers[-1]
