"""Press detection in the readings alone, as they come (`PressDetector`) and in a recording (`detect_presses`).

The detector learns the noise of every fibre, follows drift, creep and the return from the overshoot after a release,
and copes with spikes, missing readings, and fibres that are dead, saturated or noisy, or that fail. The pad must rest
for the first eight readings or quarter of a second, and the probe must sink in within half a second.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.validation import InputError, check_int
from padforge.sense.arrays import MAX_FIBRES, Array, Indices, check_stream, press_bounds
from padforge.sense.signals.detector_kernels import FURTHER, Change, State, detect, initial_state

P_REJECT = 1e-3  # probability that white noise makes a block leave the levels
P_ACCEPT = 1e-9  # probability that white noise passes for a change
TOUCH_DELAY_S = 0.16  # time from the command down to its first effect, mean of the published recording
RELEASE_DELAY_S = 0.08  # the same from the command up
MAX_LEAD = 2  # readings before its command at which a press may show: commands are noted a little late


class PressEvent(NamedTuple):
    """A touch or a release."""

    down: bool  # whether it is a touch
    reading: int  # index of the first reading that shows it, from the start of the stream


class Presses(NamedTuple):
    """Detected presses."""

    touched: Indices  # first reading that shows each press; shape (Q,), ascending
    released: Indices  # first reading that shows its end, or R if it has none; shape (Q,)


class PressDetector:
    """Detect presses as readings come.

    A touch is reported a block or two after its first reading (see `detector_kernels`), a tap or a touch in an unusual
    direction only when it is released. Touches and releases alternate, and their readings ascend.

    Args:
        fibres: number of fibres, C.

    Attributes:
        further: readings, found by the last update, from which on a pad that was pressed is pressed further: deeper,
            elsewhere or by a second finger.

    Raises:
        InputError: fewer than one fibre, or too many.
    """

    def __init__(self, fibres: int) -> None:
        from scipy.special import chdtri  # slow to import, and needed here only

        fibres = check_int("fibres", fibres, 1, MAX_FIBRES)
        self._fibres, self._pad = initial_state(fibres)
        self._last_s = -np.inf
        self.further: list[int] = []
        degrees = np.arange(1, fibres + 1)
        self._reject_limit = np.concatenate([[0.0], chdtri(degrees, P_REJECT)])
        self._accept_limit = np.concatenate([[0.0], chdtri(degrees, P_ACCEPT)])

    def update(self, times_s: ArrayLike, readings: ArrayLike) -> list[PressEvent]:
        """Process further readings; return the events that they have made clear.

        Args:
            times_s: ascending, after those of the last call; shape (n,), s.
            readings: NaN where missing; shape (n, C), V.
        """
        times, rows = check_stream(times_s, readings, len(self._fibres))
        if len(times) and not times[0] > self._last_s:
            raise InputError(f"times begin at {times[0]:g} s, expected later than the last reading, {self._last_s:g} s")
        self._last_s = times[-1] if len(times) else self._last_s
        events = np.empty((2 * len(times), 2), np.int64)
        times, rows = np.array(times), np.array(rows, order="C")  # `detect` would compile again for read-only arrays
        count = detect(self._fibres, self._pad, times, rows, self._reject_limit, self._accept_limit, events)
        changes = events[:count].tolist()
        self.further = [reading for kind, reading in changes if kind == FURTHER]
        return [PressEvent(bool(kind), reading) for kind, reading in changes if kind != FURTHER]

    def hold(self, step_v: Array) -> None:
        """Take the latest release for that of one of two presses; the pad is still pressed.

        Args:
            step_v: response to the other press; shape (C,), V.
        """
        self._fibres["press_step"] = step_v
        self._pad["state"] = State.PRESSED
        if self._pad["in_change"]:
            self._pad["change"] = Change.PARTIAL


def detect_presses(readings: ArrayLike, times_s: ArrayLike) -> Presses:
    """Detect the presses in readings of a pad.

    Args:
        readings: NaN where missing; shape (R, C), V.
        times_s: ascending; shape (R,), s.
    """
    times_s, readings = check_stream(times_s, readings)
    events = PressDetector(readings.shape[1]).update(times_s, readings)
    touched = [event.reading for event in events if event.down]
    released = [event.reading for event in events if not event.down]
    released += [len(readings)] * (len(touched) - len(released))
    return Presses(np.array(touched, dtype=np.int64), np.array(released, dtype=np.int64))


def estimate_commands(presses: Presses, times_s: Array) -> tuple[Indices, Indices]:
    """Estimate `down_command` and `up_command` (Q,) of a `Recording` in which a probe made the detected presses.

    `up_command` is R where a press has no end; `times_s` are those of the readings, shape (R,), s.
    """
    touched, released = presses
    up_command = np.searchsorted(times_s, np.append(times_s, np.inf)[released] - RELEASE_DELAY_S)
    up_command = np.maximum(up_command, touched + 1)
    # Presses may follow each other closely: none begins before the one before it has ended.
    down_command = np.searchsorted(times_s, times_s[touched] - TOUCH_DELAY_S)
    previous_end, _ = press_bounds(down_command, up_command, len(times_s))
    return np.maximum(down_command, previous_end + 1), up_command


def first_readings(readings: Array, times_s: Array, down_command: Indices, up_command: Indices) -> Indices:
    """Return the first readings (Q,) that show commanded presses; for one that is not detected, the usual reading."""
    touched = detect_presses(readings, times_s).touched
    usual = np.searchsorted(times_s, times_s[down_command] + TOUCH_DELAY_S)
    if len(touched):
        nearest = touched[_nearest(touched, down_command)]
        usual = np.where((nearest >= down_command - MAX_LEAD) & (nearest < up_command), nearest, usual)
    return np.minimum(usual, up_command)


def _nearest(touched: Indices, down_command: Indices) -> Indices:
    """Return for each commanded press the index (Q,) of the first detected one that may be it."""
    return np.minimum(np.searchsorted(touched, down_command - MAX_LEAD), len(touched) - 1)


def align_to_detected(
    readings: Array, times_s: Array, down_command: Indices, up_command: Indices
) -> tuple[Indices, Indices]:
    """Replace commanded presses by those that a detector finds in the readings.

    A probe takes up to 0.4 s from its command to the pad. Live presses are aligned by the readings, and a model of them
    must be trained on presses that are aligned in the same way, since an error of one reading in the release costs
    several millimetres. A press that is not detected keeps its commands.
    """
    presses = detect_presses(readings, times_s)
    downs, ups = estimate_commands(presses, times_s)
    if len(downs) == 0:
        return down_command, up_command
    nearest = _nearest(presses.touched, down_command)
    touched, released = presses.touched[nearest], presses.released[nearest]
    _, next_down = press_bounds(down_command, up_command, len(readings))
    is_same = (touched >= down_command - MAX_LEAD) & (touched < up_command)
    is_same &= (released >= up_command - MAX_LEAD) & (released < next_down)
    return np.where(is_same, downs[nearest], down_command), np.where(is_same, ups[nearest], up_command)
