"""The thread that has a printer's port: it moves the nozzle, and asks where it is again and again.

A firmware with a clock of its own for moves (`M114 R`) tells where the nozzle is; others tell where the move leads,
and between its ends the place is that of the straight move commanded. A move is over when the firmware says that
nothing is left of it (`M400`) and the nozzle stands where it was sent.
"""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import NoReturn

from padforge.sense.rig.devices.protocols import RigFault

from padforge.sense.rig.arms.printer import marlin
from padforge.sense.rig.arms.printer.link import HOME, MarlinLink
from padforge.sense.rig.arms.printer.motion import Place, StraightMove

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
