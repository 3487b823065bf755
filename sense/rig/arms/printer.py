"""The thread that has a printer's port: it moves the nozzle, and asks where it is again and again.
A firmware with a clock of its own for moves (`M114 R`) tells where the nozzle is; others tell where the move leads,
and between its ends the place is that of the straight move commanded. A move is over when the firmware says that
nothing is left of it (`M400`) and the nozzle stands where it was sent.

A 3D printer with Marlin as an arm: a probe clamped beside its nozzle presses, G-code over a serial port moves it.
Poses are of the probe's tip, in the printer's own frame: the nozzle's place and `[rig] tcp_mm`. The tip cannot turn.
A printer feels no force.
"""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig.arms import printer_link as marlin
from padforge.sense.rig.arms.printer_link import HOME, MarlinLink, Place, StraightMove
from padforge.sense.rig.devices import ArmState, Array, Pose, RigFault
from padforge.sense.rig.safety import check_finite_move
from padforge.sense.settings import RigSettings

LOOK_S = 0.03
"""Pause between two looks at the place."""
SLACK_MM = 0.05
"""How far from where it was sent a nozzle at rest may be said to stand: half a hundredth, and a step of its motors."""

_KEPT = 100_000
_TOLD_S = 0.8
_STOP_S = 0.3
_START_S = 0.1
"""How long a firmware waits for further moves before it begins the first."""
_LATE_S = 1.2
"""How much longer than its limits say a move may take."""
_OFF_MM = 1.0
"""How far from its straight way a nozzle may be said to be."""
_ODD = 3
"""So many places that cannot be, one after the other, are no noise."""


@dataclass(frozen=True)
class ObservedState:
    """Where the nozzle was: when that was said, its place, its speed in mm/s, and whether a move was under way."""

    time_s: float
    at: Place
    speed_mm_s: float
    moving: bool


class Mover(threading.Thread):
    """Moves a nozzle that stands at `at`.

    Attributes:
        latest: where it was last. fault: why nothing is known any more; None while all is well.
    """

    def __init__(self, link: MarlinLink, at: Place, max_mm_s: Place, max_mm_s2: Place) -> None:
        super().__init__(name="printer", daemon=True)
        self._link, self._speeds, self._accelerations = link, max_mm_s, max_mm_s2
        self._stand = at
        self._move: StraightMove | None = None
        self._begun_s, self._acceleration, self._odd = 0.0, 0.0, 0
        self._orders: queue.Queue[tuple[Callable[[], None], Future[None]]] = queue.Queue()
        self._seen: deque[ObservedState] = deque(maxlen=_KEPT)
        self._ending = threading.Event()
        self.fault: RigFault | None = None
        self.latest = ObservedState(time.monotonic(), at, 0.0, False)

    def run(self) -> None:
        """Look, and do what is ordered, until the end or a fault."""
        try:
            while not self._ending.is_set():
                try:
                    work, answer = self._orders.get(timeout=LOOK_S)
                except queue.Empty:
                    self._look()
                else:
                    self._obey(work, answer)
        except RigFault as fault:
            self.fault = fault
        except Exception as error:  # a thread that dies silently would look like a printer at rest
            self.fault = RigFault("lost", f"what moves the printer has failed ({error!r})")

    def take(self) -> list[ObservedState]:
        """What was seen since the last call."""
        return [self._seen.popleft() for _ in range(len(self._seen))]

    def move(self, end: Place, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Begin a straight move and return as soon as the firmware has understood it; RigFault where it has not."""
        self._order(lambda: self._go(end, speed_mm_s, acceleration_mm_s2), _TOLD_S)

    def stop(self) -> None:
        """End the move that is under way, by an emergency stop where the printer does not confirm another one.

        Raises:
            RigFault: "lost" where it was not confirmed.
        """
        if self._move is None or self._link.ended:
            return
        try:
            self._order(self._halt, _STOP_S)
        except RigFault:
            self._link.shout("M112")
            self._move = None
            reason = "the printer did not confirm the stop, and was told to halt"
            self.fault = RigFault("lost", reason, f"see that it stands, or switch it off; {HOME}")
            raise self.fault from None

    def end(self) -> None:
        """End the thread."""
        self._ending.set()
        self.join()

    def _order(self, work: Callable[[], None], wait_s: float) -> None:
        if self.fault is not None:
            raise self.fault
        answer: Future[None] = Future()
        self._orders.put((work, answer))
        try:
            answer.result(wait_s)
        except TimeoutError:
            raise self.fault or RigFault("deadline", f"the printer did not answer within {wait_s} s") from None

    def _obey(self, work: Callable[[], None], answer: "Future[None]") -> None:
        try:
            work()
        except RigFault as fault:
            answer.set_exception(fault)
            if fault.cause != "refused":
                raise
        else:
            answer.set_result(None)

    def _go(self, end: Place, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        if self._move is not None:
            raise RigFault("refused", "a move of the printer is under way", "wait for its end or stop it")
        move = StraightMove(self._stand, end, speed_mm_s, acceleration_mm_s2).within(self._speeds, self._accelerations)
        if not move.length_mm:
            return
        if move.acceleration != self._acceleration:
            self._link.ask(f"M204 P{move.acceleration:.1f} T{move.acceleration:.1f}")
            self._acceleration = move.acceleration
        self._move = move
        self._link.ask(marlin.move(end, move.speed))
        self._begun_s = time.monotonic()
        if math.dist(at := self._place("M114", end), end) > SLACK_MM:
            self._halt()
            self._elsewhere(f"is about to go to {_said(at)}", end)
        self._note(time.monotonic(), move.start)

    def _look(self) -> None:
        move = self._move
        if move is None:
            if math.dist(at := self._place("M114 R", self._stand), self._stand) > SLACK_MM:
                self._elsewhere(f"stands at {_said(at)}", self._stand)
            self._note(time.monotonic(), self._stand)
            return
        at = self._place("M114 R", None)
        now = time.monotonic()
        gone_s = now - self._begun_s
        if math.dist(at, move.end) <= SLACK_MM:
            if gone_s >= move.duration_s:
                self._note(now, at)
                self._arrive(move)
                return
            at = move.at(gone_s - _START_S)
        late = gone_s > move.duration_s + _LATE_S
        self._odd = self._odd + 1 if late or move.distance_mm(at) > _OFF_MM else 0
        if self._odd >= _ODD:
            self._elsewhere(f"is at {_said(at)}", move.end)
        if not self._odd:
            self._note(now, at)

    def _arrive(self, move: StraightMove) -> None:
        self._link.ask("M400")
        if math.dist(at := self._place("M114 R", move.end), move.end) > SLACK_MM:
            self._elsewhere(f"stands at {_said(at)}", move.end)
        self._rest(move.end)

    def _halt(self) -> None:
        self._link.ask("M410")
        self._link.ask("M400")
        self._rest(self._place("M114", None))

    def _rest(self, at: Place) -> None:
        self._move, self._stand, self._odd = None, at, 0
        self._note(time.monotonic(), at)

    def _place(self, command: str, expected: Place | None) -> Place:
        """What the firmware says of the nozzle's place: damaged answers, and odd ones, are asked for again."""
        at = None
        for _ in range(_ODD):
            places = [place for line in self._link.ask(command) if (place := marlin.place(line)) is not None]
            at = places[-1] if places else at
            if places and (expected is None or math.dist(places[-1], expected) <= SLACK_MM):
                break
        if at is None:
            raise RigFault("stale", "the printer does not say where it is", "its link may be noisy: check its cable")
        return at

    def _elsewhere(self, where: str, sent: Place) -> NoReturn:
        advice = f"something else moves it, or it cannot go there: {HOME}"
        raise RigFault("lost", f"the printer {where} mm, but was sent to {_said(sent)} mm", advice)

    def _note(self, now_s: float, at: Place) -> None:
        before, moving = self.latest, self._move is not None
        passed_s = now_s - before.time_s
        speed = math.dist(at, before.at) / passed_s if moving and passed_s > 0 else 0.0
        self.latest = ObservedState(now_s, at, speed, moving)
        self._seen.append(self.latest)


def _said(at: Place) -> str:
    return ", ".join(f"{value:.2f}" for value in at)


CONNECT_S = 3.0
"""Longest wait for a printer that restarts as its port is opened."""
STALE_S = 0.5
SETTINGS = ("G21", "G90", "M220 S100", "M211 S1", "M84 S0")
"""Millimetres, places from the origin, speeds as said, ends of the axes heeded, and motors that never let go."""


class Printer:
    """The printer at `[rig] printer_port`.

    It is never homed from here, for the probe would meet the bed: a person does that. If this process ends, the printer
    ends the one move that is under way and stands.
    """

    def __init__(self, rig: RigSettings) -> None:
        self._rig = rig
        self._link: MarlinLink | None = None
        self._mover: Mover | None = None
        self._tcp: Place = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, rig: RigSettings) -> "Printer":
        """The printer that `[rig]` names."""
        return cls(rig)

    def connect(self) -> Mapping[str, Any]:
        """Open the port and set the printer up; nothing moves.

        Returns:
            port, baud, firmware and machine by name, the greatest speeds (mm/s) and accelerations (mm/s²) of its axes,
            and whether it can halt at once.

        Raises:
            RigFault: "refused" where there is no printer with Marlin, it has not been homed, it restarts as its port is
                opened, its axes are too slow for the presses wanted, or a setting is missing; "lost", "stale".
        """
        self.close()
        rig = self._rig
        if rig.printer_port is None:
            raise RigFault("refused", "[rig] printer_port is unknown, allowed is a serial port such as /dev/ttyUSB0")
        if rig.tcp_mm is None:
            message = "[rig] tcp_mm is unknown, allowed are x, y and z of the probe's tip from the nozzle"
            raise RigFault("refused", message, "measure them with the probe in place")
        self._tcp = rig.tcp_mm
        self._link = link = MarlinLink(rig.printer_port, rig.printer_baud)
        try:
            link.begin(CONNECT_S)
            firmware = marlin.PrinterDialect.of(link.ask("M115"))
            if marlin.FIRMWARE not in firmware.name:
                raise RigFault("refused", f"the firmware is {firmware.name or 'of no name'!r}, allowed is Marlin")
            if marlin.waits_for_moves(firmware.name):
                message = f"the firmware is {firmware.name!r}, which says where it is only once it stands"
                raise RigFault("refused", message, "allowed is Marlin 2")
            speeds, accelerations = self._limits(link)
            self._require_quick(speeds, accelerations)
            for command in SETTINGS:
                link.ask(command)
            at = _standing(link)
        except BaseException:
            self.close()
            raise
        self._mover = Mover(link, at, speeds, accelerations)
        self._mover.start()
        return {
            "port": rig.printer_port,
            "baud": rig.printer_baud,
            "firmware": firmware.name,
            "machine": firmware.machine,
            "max_mm_s": list(speeds),
            "max_mm_s2": list(accelerations),
            "halts_at_once": "EMERGENCY_PARSER" in firmware.capabilities,
        }

    def state(self) -> ArmState:
        """The latest state; see `Arm.state`."""
        seen = self._running().latest
        if (age := time.monotonic() - seen.time_s) > STALE_S:
            message = f"the printer's last answer is {age:.2f} s old; allowed {STALE_S} s"
            raise RigFault("stale", message, "it may be busy: look at its display")
        return ArmState(seen.time_s, self._pose(seen.at), seen.speed_mm_s, None, False, False, seen.moving)

    def drain(self) -> Array:
        """(n, 10) states since the last call; those before a fault come before it."""
        mover = self._mover
        seen = mover.take() if mover else []
        if not seen:
            self._running()
            return np.empty((0, len(STATE_COLUMNS)))
        return np.array([[one.time_s, *self._pose(one.at), one.speed_mm_s, np.nan, 1.0] for one in seen])

    def move(self, pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Begin a straight move from rest, as fast as wanted or as the printer's axes can.

        Args:
            pose: x, y, z in mm of the tip, and `[rig] tool_rad`. speed_mm_s, acceleration_mm_s2: of the tip.

        Raises:
            RigFault: "refused" for what is no pose or speed, or another turn of the tool; "lost", "stale".
        """
        check_finite_move(pose, speed_mm_s, acceleration_mm_s2)
        if not np.allclose(pose[3:], self._rig.tool_rad, atol=1e-6):
            raise RigFault("refused", f"a turn of the tool to {list(pose[3:])} rad; a printer cannot turn it")
        x, y, z = (float(value) - offset for value, offset in zip(pose, self._tcp, strict=False))
        self._running().move((x, y, z), speed_mm_s, acceleration_mm_s2)

    def stop(self) -> None:
        """Stop the printer, for good where it does not confirm it; see `Arm.stop`."""
        if self._mover is not None:
            self._mover.stop()

    def close(self) -> None:
        """Stop the printer and close the port; never raises."""
        if self._mover is not None:
            with suppress(RigFault):
                self._mover.stop()
            self._mover.end()
        if self._link is not None:
            self._link.close()
        self._mover = self._link = None

    def _running(self) -> Mover:
        if self._mover is None:
            raise RigFault("lost", "there is no link to the printer", "connect first")
        if fault := self._mover.fault:
            raise fault
        return self._mover

    def _pose(self, nozzle: Place) -> Pose:
        x, y, z = (a + b for a, b in zip(nozzle, self._tcp, strict=True))
        return (x, y, z, *self._rig.tool_rad)

    def _limits(self, link: MarlinLink) -> tuple[Place, Place]:
        lines = link.ask("M503", CONNECT_S)
        speeds, accelerations = marlin.limits(lines, "M203"), marlin.limits(lines, "M201")
        if speeds is None or accelerations is None:
            raise RigFault("refused", "the printer does not tell the limits of its axes (M503: M203 and M201)")
        return speeds, accelerations

    def _require_quick(self, speeds: Place, accelerations: Place) -> None:
        """Refuse presses that would be over before the tip is down."""
        rig = self._rig
        way = rig.clearance_mm + max(rig.depths_mm or (rig.depth_mm,))
        down = StraightMove((0, 0, way), (0, 0, 0), rig.press_mm_s, rig.acceleration_mm_s2)
        down_s = down.within(speeds, accelerations).duration_s
        if down_s >= (half_s := rig.readings_per_press / 2 / rig.rate_hz):
            raise RigFault(
                "refused",
                f"the printer's way down of {way:g} mm takes {down_s:.1f} s, allowed is less than {half_s:.2g} s,"
                " half of a press's cycle",
                "lower [rig] clearance_mm, or raise readings_per_press or press_mm_s",
            )


def _standing(link: MarlinLink) -> Place:
    """Where the nozzle stands; RigFault("refused") where it has not been homed."""
    places = [place for _ in range(3) for line in link.ask("M114") if (place := marlin.place(line)) is not None]
    if not places:
        raise RigFault("refused", "the printer does not say where it is (M114)")
    if math.hypot(*places[-1]) == 0:
        raise RigFault("refused", "the printer says that it is at 0, 0, 0: it has not been homed, or not raised", HOME)
    return places[-1]
