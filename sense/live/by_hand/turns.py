"""Whose turn it is: what a person is asked for at any moment, and whether a press was the one that was asked for.

All times are those of readings, s.
"""

from collections import deque
from typing import Literal

from padforge.sense.recordings.processing.limits import Array

Phase = Literal["settle", "wait", "press", "hold", "lift", "done"]
"""Hands off before the first press; wait until the pad has recovered; press; hold it; lift; all presses are made."""

SETTLE_S = 2.0
"""The pad is left alone for so long before the first press: its rest and its noise are learnt from that."""
SEEN_S = 0.6
"""A place must have been shown for so long: a press sooner than that was meant for the one before, or is its echo."""
LEAST, MOST = 0.8, 4.0
"""Shares of the hold that a press must, and may at most, be held for: people lift a little before they are told to."""

Place = tuple[float, float]


class Turns:
    """Places to press, one after the other, each asked for until a press of it is kept.

    Attributes:
        hold_s: for how long presses are to be held, and the pad left alone after each, > 0.
        kept: places of the presses that were kept, oldest first.
    """

    def __init__(self, targets_mm: Array, hold_s: float, now_s: float) -> None:
        """Begin with the first of the places (Q, 2) mm."""
        self._left: deque[Place] = deque((x, y) for x, y in targets_mm.tolist())
        self.hold_s, self.kept = hold_s, list[Place]()
        self._since_s, self._ready_s, self._settling = now_s, now_s + SETTLE_S, True
        self._touched_s: float | None = None
        self._fault = ""  # of the press under way

    @property
    def target(self) -> Place | None:
        """The place to press; None when all are done."""
        return self._left[0] if self._left else None

    @property
    def following(self) -> Place | None:
        """The one after it."""
        return self._left[1] if len(self._left) > 1 else None

    @property
    def left(self) -> int:
        """How many places there are still to press."""
        return len(self._left)

    @property
    def pressed(self) -> bool:
        """Whether the pad is pressed."""
        return self._touched_s is not None

    def held_s(self, now_s: float) -> float:
        """For how long the pad has been pressed; 0 where it is not."""
        return 0.0 if self._touched_s is None else now_s - self._touched_s

    def phase(self, now_s: float) -> Phase:
        """What is asked for now."""
        if self.pressed:
            return "lift" if self._fault or self.held_s(now_s) >= self.hold_s else "hold"
        if now_s < self._ready_s:
            return "settle" if self._settling else "wait"
        return "press" if self._left else "done"

    def progress(self, now_s: float) -> float:
        """How far the wait or the hold has gone, 0 to 1."""
        waited = (now_s - self._since_s) / (self._ready_s - self._since_s)
        return min(max(self.held_s(now_s) / self.hold_s if self.pressed else waited, 0.0), 1.0)

    def touch(self, at_s: float) -> Place | None:
        """The pad was touched: the place that was meant, None for a press that was not asked for."""
        self._touched_s = at_s
        self._fault = "" if self._left and at_s >= self._ready_s else "it came before it was asked for"
        return None if self._fault else self._left[0]

    def release(self, at_s: float) -> str:
        """The pad was let go: why the press does not count, "" where nothing is known against it."""
        held_s, fault = self.held_s(at_s), self._fault
        if not fault and held_s < LEAST * self.hold_s:
            fault = f"it was held for {held_s:.1f} s, hold it for {self.hold_s:.1f} s"
        elif not fault and held_s > MOST * self.hold_s:
            fault = f"it was held for {held_s:.1f} s, lift after {self.hold_s:.1f} s"
        self._touched_s, self._settling = None, False
        self.wait(at_s)
        return fault

    def wait(self, now_s: float) -> None:
        """Wait until the pad has recovered that was let go now."""
        self._wait(now_s, now_s + self.hold_s)

    def keep(self, now_s: float) -> None:
        """The press that was let go last counts: on to the next place."""
        self.kept.append(self._left.popleft())
        self._wait(now_s, self._ready_s)

    def skip(self, now_s: float) -> None:
        """Leave the target out, and the press under way, if any."""
        self._spoil("its place was skipped")
        if self._left:
            self._left.popleft()
        self._wait(now_s, self._ready_s)

    def take_back(self, now_s: float) -> bool:
        """Ask again for the place of the press under way, or of the last one that was kept; whether it was that."""
        if self.pressed or not self.kept:
            self._spoil("it was taken back")
            return False
        self._left.appendleft(self.kept.pop())
        self._wait(now_s, self._ready_s)
        return True

    def drop(self) -> None:
        """The press under way was none, or is over already."""
        self._spoil("nothing touches the pad")

    def _spoil(self, why: str) -> None:
        self._fault = self._fault or why if self.pressed else ""

    def _wait(self, now_s: float, until_s: float) -> None:
        """Wait until a moment, and at least until the target can have been seen."""
        self._since_s, self._ready_s = now_s, max(until_s, now_s + SEEN_S)
