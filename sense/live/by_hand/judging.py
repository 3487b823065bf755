"""What readings say against a press, that it was too weak or that the finger moved; and against the finder of presses.

A finder that takes a finger that slid away for one that was lifted takes the lift for the next touch, and so on. But a
pad that nothing touches gives what it gave untouched before, whatever the finder says.

Measured on the published recording, found as here: one press in 370 is weaker than `WEAK` of the usual one, one in 80
changes by more than `ALIKE` while it is held.
"""

import numpy as np

from padforge.sense.localizer.features import REST
from padforge.sense.recordings.processing.limits import Array

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


def answers(readings: Array, begun: int, lifted: int) -> Array:
    """(2, C) V, what fibres give early in a press, sunk in, and at its end, beyond their rest before; 0 where missing.

    Args:
        readings: (n, C) V, NaN where missing. begun, lifted: as in a `Recording`, 0 < begun < lifted <= n.
    """
    quarter = max((lifted - begun) // 4, 1)
    early, last = begun + quarter, lifted - 1  # the last reading may show the finger leave
    parts = (
        readings[max(begun + REST[0], 0) : begun],
        readings[early : early + quarter],
        readings[max(last - quarter, begun) : last],
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
