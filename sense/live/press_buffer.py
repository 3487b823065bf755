"""The press under way, and the latest readings it is told from; by the indices of readings in their stream."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from padforge.sense.health.fibre_prediction import RELEASED
from padforge.sense.localizer.features import DOWN, EARLY, MEDIAN, SLOW, UP
from padforge.sense.recordings.processing.limits import Array

HISTORY = SLOW[-1]
"""Readings before a press that its localizer looks at, as far as there are so many."""
SUNK = DOWN[-1][1]
"""Readings after the probe was sent down that are looked at; of the others until it is sent up, none is."""
NEEDS = {
    "early": (DOWN[EARLY - 1][1], 0),
    "causal": (SUNK, 0),
    "published": (SUNK, 10 + MEDIAN // 2 + 1),
    "full": (SUNK, UP[-1][1]),
}
"""Readings that features take after the probe was sent down, and after it was sent up."""
DONE = max(UP[-1][1], RELEASED)
"""Readings after the probe was sent up with which a press is done."""
SLACK = 4096
"""Readings kept beyond `HISTORY`: a press is found only some readings after it began."""


class Ring:
    """The latest rows of a stream, at least `HISTORY` + `SLACK` of them.

    Attributes:
        end: how many rows there have been.
    """

    def __init__(self, columns: int) -> None:
        self._rows = np.empty((2 * (HISTORY + SLACK), columns))
        self._filled = 0
        self.end = 0

    def append(self, row: Array) -> None:
        """Add a row (columns,)."""
        if self._filled == len(self._rows):
            self._filled //= 2
            self._rows[: self._filled] = self._rows[self._filled :]
        self._rows[self._filled] = row
        self._filled += 1
        self.end += 1

    def rows(self, first: int, end: int) -> Array:
        """(n, columns) those of `first` <= index < `end` that are there still; a view, good until the next `append`."""
        gone = self.end - self._filled
        return self._rows[max(first - gone, 0) : max(min(end - gone, self._filled), 0)]

    def sent(self, reading: int, delay_s: float) -> int:
        """Index of the reading, times being column 0, at which a probe would have been sent that shows `delay_s` later.

        Args:
            reading: index of the first one that shows it.
        """
        times_s = self.rows(0, reading + 1)[:, 0]
        return reading + 1 - len(times_s) + int(np.searchsorted(times_s, times_s[-1] - delay_s))


class Excerpt(NamedTuple):
    """The readings (n, C) V that tell of a press, and at which of them it begins and ends, and the one before ended."""

    readings: Array
    begun: int
    lifted: int
    free: int


@dataclass
class BufferedPress:
    """A press under way.

    Attributes:
        number: counted from 0. time_s: when the pad was touched. touched: index of the first reading that shows it.
        begun: index of the first reading after the probe was sent down, or would have been.
        free: index of the reading at which the press before was let go, < begun.
        rest: (C,) V before it.
        lifted: index of the first reading after it was let go; None while it is held.
        told: how many localizers have told its place.
    """

    number: int
    time_s: float
    touched: int
    begun: int
    free: int
    rest: Array
    lifted: int | None = None
    told: int = 0
    _opening: Array | None = None

    def let_go(self, lifted: int) -> None:
        """It was let go by the reading of index `lifted`."""
        self.lifted = max(lifted, self.begun + 1)

    def enough(self, features: str) -> int | None:
        """Index of the first reading that `features` can do without; None while that is not known."""
        down, up = NEEDS[features]
        if up == 0:
            return self.begun + down if self.lifted is None else min(self.begun + down, self.lifted)
        return None if self.lifted is None else self.lifted + up

    def keep_opening(self, ring: Ring) -> None:
        """Keep what was before it and its first readings, once these are there, however long it will be held."""
        if self._opening is None and self.lifted is None and ring.end >= self.begun + SUNK:
            self._opening = ring.rows(self.begun - HISTORY, self.begun + SUNK)[:, 1:].copy()

    def excerpt(self, ring: Ring, end: int) -> Excerpt:
        """Its readings up to index `end`; of a press that was held for long, without those that nobody looks at."""
        lifted = end if self.lifted is None else min(self.lifted, end)
        if self._opening is None or lifted <= self.begun + SUNK:
            readings = ring.rows(self.begun - HISTORY, end)[:, 1:]
            begun = len(readings) - (end - self.begun)
            up = begun + lifted - self.begun
        else:
            readings = np.concatenate([self._opening, ring.rows(lifted, end)[:, 1:]])
            up = len(self._opening)
            begun = up - SUNK
        return Excerpt(readings, begun, up, max(begun - (self.begun - self.free), 0))
