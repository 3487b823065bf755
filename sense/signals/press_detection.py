"""Finding presses in readings: from when a pad was touched, and from when it was let go, whatever the protocol.
The same code finds them as readings come (`PressDetector`) and in a recording (`detect_presses`). It learns the noise of every
fibre, follows drift, creep and the return from the overshoot after a release, and bears spikes, missing readings and
fibres that are dead, saturated, noisy or break meanwhile. It expects a pad that begins at rest, for eight readings or
a quarter of a second, and a probe that sinks in within about half a second.

The presses of a recording as they would be found in its readings, beside those that were commanded.
A probe takes up to 0.4 s from its command to the pad, more or less; a press found in the readings is aligned by what
it does to them. What is learnt from commanded presses alone is lost on such that were found, and so when it follows a
pad live: a release that is off by one reading costs several millimetres.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.validation import InputError, check_int
from padforge.sense.arrays import MAX_FIBRES, Array, Indices, stream_of
from padforge.sense.signals.detector_kernels import find, unknown

DOUBT, SURE = 1e-3, 1e-9
"""Chances that white noise leaves the levels for a look, and that it is taken for a change."""
SENT_DOWN_S, SENT_UP_S = 0.16, 0.08
"""From a command to its first effect: a touch showed 2.2 readings after the first that followed the command, a release
0.5 readings (means of the published recording at 14.3 Hz)."""
_PART = 65_536
"""Readings taken at a time, so that a long recording is not copied as a whole."""


class PressEvent(NamedTuple):
    """What became of the pad.

    Attributes:
        down: True if it was touched, False if it was let go.
        reading: the first reading that shows it, counted from the first one fed.
    """

    down: bool
    reading: int


class Presses(NamedTuple):
    """Presses found.

    Attributes:
        touched: (Q,) first reading that shows the press. released: (Q,) first that shows its end; R if it has none.
    """

    touched: Indices
    released: Indices


class PressDetector:
    """Finds presses as readings come.

    A touch is told a look or two after its first reading (see `kernels.level_tracking`), a tap or a touch of a rare
    kind only as it is released. Touches and releases take turns, and their readings ascend.

    Args:
        fibres: C, the number of fibres read.

    Raises:
        InputError: no fibre, or too many.
    """

    def __init__(self, fibres: int) -> None:
        fibres = check_int("fibres", fibres, 1, MAX_FIBRES)
        self._fibres, self._pad = unknown(fibres)
        self._last_s = -np.inf
        self._doubt, self._sure = (chi_square_limits(fibres, chance) for chance in (DOUBT, SURE))

    def feed(self, times_s: ArrayLike, readings: ArrayLike) -> list[PressEvent]:
        """Take (n,) times in s, ascending, and (n, C) volts, NaN where missing; what became of the pad meanwhile.

        Raises:
            InputError: as `limits.stream_of`, or times before those that were fed last.
        """
        times, rows = stream_of(times_s, readings, len(self._fibres))
        if len(times) and not times[0] > self._last_s:
            raise InputError(f"times begin at {times[0]:g} s, expected later than the last reading, {self._last_s:g} s")
        return self.follow(times, rows)

    def follow(self, times_s: Array, readings: Array) -> list[PressEvent]:
        """The same of arrays of float64 that were checked already."""
        events = np.empty((2 * len(times_s), 2), np.int64)
        rows = np.ascontiguousarray(readings)
        self._last_s = times_s[-1] if len(times_s) else self._last_s
        count = find(self._fibres, self._pad, times_s, rows, self._doubt, self._sure, events)
        return [PressEvent(bool(down), reading) for down, reading in events[:count].tolist()]


def detect_presses(readings: ArrayLike, times_s: ArrayLike) -> Presses:
    """Presses in readings of a pad.

    Args:
        readings: (R, C) volts, NaN where missing. times_s: (R,) ascending, s.

    Raises:
        InputError: as `limits.stream_of`.
    """
    times_s, readings = stream_of(times_s, readings)
    finder = PressDetector(readings.shape[1])
    parts = (slice(first, first + _PART) for first in range(0, len(readings), _PART))
    events = [event for part in parts for event in finder.follow(times_s[part], readings[part])]
    touched = [event.reading for event in events if event.down]
    released = [event.reading for event in events if not event.down]
    released += [len(readings)] * (len(touched) - len(released))
    return Presses(np.array(touched, dtype=np.int64), np.array(released, dtype=np.int64))


def as_commanded(presses: Presses, times_s: Array) -> tuple[Indices, Indices]:
    """Presses found, as if they had been commanded: `down_command` and `up_command` of a `Recording`.

    Args:
        presses: found in readings taken at times_s (R,) s.

    Returns:
        (Q,) first reading after the probe would have been sent down, and up; R where a press has no end.
    """
    touched, released = presses
    sent_up = np.searchsorted(times_s, np.append(times_s, np.inf)[released] - SENT_UP_S)
    up_command = np.maximum(sent_up, touched + 1)
    # Presses may follow each other closely: none begins before the one before it has ended.
    sent_down = np.searchsorted(times_s, times_s[touched] - SENT_DOWN_S)
    return np.maximum(sent_down, np.concatenate([[0], up_command[:-1]]) + 1), up_command


def chi_square_limits(most: int, chance: float) -> Array:
    """(most + 1,) what the sum of squares of n standard normal numbers exceeds by `chance`, for n = 0 .. most.

    By Newton's way from above on the logarithm of the upper tail, which is sums of n / 2 terms (M. Abramowitz and
    I. A. Stegun, 1964, 26.4.4 and 26.4.5): readings are followed without SciPy, which a small machine may lack.
    """
    limits = [0.0]
    for n in range(1, most + 1):
        limit = limits[-1] + 20.0
        for _ in range(200):
            tail, density = _chi_square(limit, n)
            step = math.log(tail / chance) * tail / density
            limit += step
            if abs(step) < 1e-13 * limit:
                break
        limits.append(limit)
    return np.array(limits)


def _chi_square(x: float, n: int) -> tuple[float, float]:
    """Upper tail and density at x > 0 of the sum of squares of n standard normal numbers."""
    half, odd = x / 2, n % 2
    tail = math.erfc(math.sqrt(half)) if odd else 0.0
    terms = (half**0.5 * math.exp(-half) / math.gamma(1.5), 1.5) if odd else (math.exp(-half), 1.0)
    term, at = terms
    for _ in range((n - odd) // 2):
        tail += term
        term *= half / at
        at += 1
    return tail, math.exp((n / 2 - 1) * math.log(half) - half - math.lgamma(n / 2)) / 2


EARLY = 2
"""Readings before its command at which a press may show: commands are noted a little late."""


def as_detected(readings: Array, times_s: Array, down_command: Indices, up_command: Indices) -> tuple[Indices, Indices]:
    """Presses as one who follows the readings live would have them.

    Args:
        readings: (R, C) volts, NaN where missing. times_s: (R,) s.
        down_command, up_command: (Q,) first reading after the probe was sent down, and up.

    Returns:
        The same as found in the readings; of a press that is not found, as given.
    """
    found = detect_presses(readings, times_s)
    downs, ups = as_commanded(found, times_s)
    if len(downs) == 0:
        return down_command, up_command
    nearest = np.minimum(np.searchsorted(found.touched, down_command - EARLY), len(downs) - 1)
    touched, released = found.touched[nearest], found.released[nearest]
    following = np.append(down_command[1:], len(readings))
    sure = (
        (touched >= down_command - EARLY)
        & (touched < up_command)
        & (released >= up_command - EARLY)
        & (released < following)
    )
    return np.where(sure, downs[nearest], down_command), np.where(sure, ups[nearest], up_command)
