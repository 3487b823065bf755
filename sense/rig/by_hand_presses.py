"""What readings say against a press, that it was too weak or that the finger moved; and against the finder of presses.
A finder that takes a finger that slid away for one that was lifted takes the lift for the next touch, and so on. But a
pad that nothing touches gives what it gave untouched before, whatever the finder says.
Measured on the published recording, found as here: one press in 370 is weaker than `WEAK` of the usual one, one in 80
changes by more than `ALIKE` while it is held.

Whose turn it is: what a person is asked for at any moment, and whether a press was the one that was asked for.
All times are those of readings, s.
"""

from collections import deque
from typing import Literal

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.localizer.features import REST

WEAK = 0.15
"""Share of the usual answer, all fibres together, below which a press tells too little."""
ALIKE = 0.95
"""Cosine between what the fibres give early in a press and at its end, below which it was not one place."""
LEARNT = 5
"""Presses from which on it is known what is usual."""
AWAY, BACK = 0.5, 0.25
"""Shares of the usual answer: a pad that is farther from its rest is touched, one that is nearer is not."""
SOON_S, GONE_S = 0.4, 1.0
"""After so long a touch has sunk in, and a release has come to its end but for a slow rest."""


def answers(readings: Array, down_command: int, up_command: int) -> Array:
    """(2, C) V, what fibres give early in a press, sunk in, and at its end, beyond their rest before; 0 where missing.

    Args:
        readings: (n, C) V, NaN where missing. down_command, up_command: as in a `Recording`, 0 < begun < lifted <= n.
    """
    quarter = max((up_command - down_command) // 4, 1)
    early, last = down_command + quarter, up_command - 1  # the last reading may show the finger leave
    parts = (
        readings[max(down_command + REST[0], 0) : down_command],
        readings[early : early + quarter],
        readings[max(last - quarter, down_command) : last],
    )
    rest, *held = (_mean(part) for part in parts)
    return np.nan_to_num(np.array(held) - rest)


def _mean(readings: Array) -> Array:
    """(C,) means of readings that are there; NaN of none."""
    there = ~np.isnan(readings)
    count = there.sum(axis=0)
    return np.where(count > 0, np.where(there, readings, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


class Judge:
    """Learns from the presses that count what is usual, and where the pad rests."""

    def __init__(self) -> None:
        self._sizes_v: list[float] = []
        self._rest: Array | None = None

    def keep(self, answered: Array, rest: Array) -> None:
        """A press counts that had these `answers`, from this rest (C,) V."""
        self._sizes_v.append(float(np.linalg.norm(answered[1])))
        self._rest = rest

    def take_back(self) -> None:
        """The last press that counted does not."""
        self._sizes_v.pop()

    def share(self, volts: Array) -> float:
        """The size of (C,) V as a share of the usual answer; inf before `LEARNT` presses are known."""
        known = len(self._sizes_v) >= LEARNT
        return float(np.linalg.norm(np.nan_to_num(volts)) / np.median(self._sizes_v)) if known else np.inf

    def fault_of(self, answered: Array) -> str:
        """Why a press does not count by its `answers`; "" where nothing speaks against it."""
        if self.share(answered[1]) < WEAK:
            return "it was much weaker than the others, press deeper"
        early, end = np.linalg.norm(answered, axis=1)
        if answered[0] @ answered[1] < ALIKE * early * end:
            return "it changed while it was held, press one place with one finger"
        return ""

    def untouched(self, volts: Array, before: Array, held_s: float) -> bool:
        """Whether nothing touches a pad that was taken for touched.

        Either it is as it was before: that was no touch, or its end was missed. Or it is back where it rests: that was
        the end of a press that had been taken for over.

        Args:
            volts: (C,) what it gives now. before: (C,) before the touch, which was `held_s` ago.
        """
        if held_s > GONE_S and self.share(volts - before) < WEAK:
            return True
        if held_s < SOON_S or self._rest is None:
            return False
        return self.share(volts - self._rest) < BACK and AWAY < self.share(before - self._rest) < np.inf

    def touched(self, volts: Array) -> bool | None:
        """Whether something touches a pad, whatever was found, that gives (C,) V; None where that is not clear.

        Where nothing does, that is where it rests from now on: the rest drifts.
        """
        share = np.inf if self._rest is None else self.share(volts - self._rest)
        if share < BACK:
            self._rest = volts
            return False
        return True if AWAY < share < np.inf else None

    def rest_anew(self) -> None:
        """Nothing touches the pad, wherever it rests now: that is learnt from the next press that counts."""
        self._rest = None


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
