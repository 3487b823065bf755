"""What `localizer.h` does with every reading: the same operations on float32, in the same order.
A ring keeps the latest readings. A bank of averages of each fibre, each of which goes another share of its way to every
reading, stands for all that came before; it lags some readings behind, as a touch is known only after it began.
The detector is a simple one. While the pad is free, a baseline follows each fibre within some readings, and the pad is
touched when the squares of the deviations from it, in units of each fibre's noise, add up to more than a threshold in
two readings in a row. The baseline stands still while the pad is pressed. It is let go when the deviations have gone
back by half of the farthest that they went, and the baseline begins anew there.

The Python twin of `localizer.h` as far as it goes without its network: presses as seen reading by reading.

What fits into a microcontroller: bytes of the tables and of the state of `localizer.h`, and the largest network.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.localizer.features import PressFeatures, interpolate_gaps
from padforge.sense.recording.recording import Recording

RING = 32
"""Readings kept, a power of two: `REST` before a press and `SEEN` of it."""
LAG = 8
"""Readings by which the bank is behind: a touch must be found sooner."""
SETTLING = 3
"""Readings after a release in which the baseline is each one as it comes, and no touch is found."""
FOLLOWING = 0.125
"""Share of its way to a reading that the baseline goes while the pad is free."""
GONE_BACK = 0.5
"""Share of the farthest deviation below which a press is over."""
LONGEST = 1024
"""Readings after which what the detector took for a press is taken for the pad's new rest."""
REST, SEEN = 10, 20
"""Readings before a press that its rest is the mean of, and readings of it that are looked at."""
MOST_V = 1e3
"""What is further from 0 is no reading."""
WINDOWS = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Readings of a press, counted from its first, that are looked at together."""

PRESSED, SUSPECTED, BEGUN, LIFTED, FREE, TOLD, TOUCHED = range(7)
"""Numbers of what is known of the pad: whether it is pressed, whether the last reading looked like a touch, the
readings with which the press began and ended, the end of the press before it, whether its place is told, and the
reading at which the press was found."""


@njit(cache=True, error_model="numpy", nogil=True)
def follow(
    readings: Any, held: Any, fibre_mask: Any, poles: Any, quiet: Any, judge: Any, edges: Any, shown: Any, there: Any
) -> int:
    """Take readings in order, and give what is seen of every press.

    Args:
        readings: (R, C) V, NaN where missing. held: (R,) whether the pad is pressed, as told from outside; empty where
            the detector is to judge. fibre_mask: (C,) fibres that count for it.
        poles: (J,) shares. quiet: (C,) 1/V, one over the noise. judge: threshold, and readings from the beginning of a
            press to the first that shows it.
        edges: (R, 3) overwritten with the readings with which each press began, was seen enough of, and ended; R if it
            has not. shown: (R, C, 9 + J) overwritten with its windows and its history, V, from its rest.
        there: (R, C) overwritten with whether each fibre gave enough of it.

    Returns:
        The number of presses of which enough was seen.
    """
    count, fibres = readings.shape
    ring = np.zeros((RING, fibres), np.float32)
    bank = np.zeros((2, fibres, len(poles)), np.float32)  # as it is, and as it was when the press began
    levels = np.zeros((2, fibres), np.float32)  # baseline, and the farthest deviation of the press
    farthest = np.zeros(1, np.float32)
    missing = np.zeros(fibres, np.int64)
    pad = np.zeros(7, np.int64)
    presses = 0
    for n in range(count):
        _take(n, readings[n], ring, bank[0], levels[0], missing, poles)
        if len(held):
            change = _told(n, held[n], pad)
        else:
            change = _judged(n, ring[n % RING], fibre_mask, quiet, judge, levels, farthest, pad)
        if change > 0:
            missing[:] = 0
            pad[TOLD], pad[TOUCHED] = 0, n
            _remember(n, ring, bank, poles, pad)
        ended = change < 0
        if pad[TOLD] == 0 and (ended or (pad[PRESSED] == 1 and n >= pad[BEGUN] + SEEN - 1)):
            pad[TOLD] = 1
            edges[presses, 0], edges[presses, 1], edges[presses, 2] = pad[BEGUN], n, count
            end = n if ended else n + 1
            for c in range(fibres):
                there[presses, c] = 4 * missing[c] <= n - pad[TOUCHED]
                _look(c, end, ring, bank[1, c], pad, shown[presses, c])
            presses += 1
        if ended and presses > 0:
            edges[presses - 1, 2] = pad[LIFTED]
    return presses


@njit(cache=True, error_model="numpy", nogil=True)
def _take(n: int, row: Any, ring: Any, bank: Any, base: Any, missing: Any, poles: Any) -> None:
    """Keep a reading; what is missing or beyond `MOST_V` is as it was in the reading before."""
    for c in range(len(row)):
        x = row[c]
        if not abs(x) <= np.float32(MOST_V):
            missing[c] += 1
            x = ring[(n - 1) % RING, c]
        old = ring[(n - LAG) % RING, c]
        ring[n % RING, c] = x
        if n == 0:
            base[c] = x
        for j in range(len(poles)):
            if n == 0:
                bank[c, j] = x
            elif n >= LAG:
                bank[c, j] += poles[j] * (old - bank[c, j])


@njit(cache=True, error_model="numpy", nogil=True)
def _told(n: int, held: bool, pad: Any) -> int:
    """1 if a press begins with this reading, -1 if it ends, 0 if neither, as told from outside."""
    if held and pad[PRESSED] == 0:
        pad[PRESSED], pad[FREE] = 1, pad[LIFTED]
        pad[BEGUN] = max(n, pad[FREE] + 1)
        return 1
    if not held and pad[PRESSED] == 1:
        pad[PRESSED], pad[LIFTED] = 0, n
        return -1
    return 0


@njit(cache=True, error_model="numpy", nogil=True)
def _judged(n: int, row: Any, fibre_mask: Any, quiet: Any, judge: Any, levels: Any, farthest: Any, pad: Any) -> int:
    """The same as the detector judges."""
    base, peak = levels[0], levels[1]
    square, along = np.float32(0), np.float32(0)
    for c in range(len(row)):
        if fibre_mask[c]:
            off = (row[c] - base[c]) * quiet[c]
            square += off * off
            along += off * peak[c]
    change = 0
    if pad[PRESSED] == 1:
        if square > farthest[0]:
            farthest[0] = square
            for c in range(len(row)):
                peak[c] = (row[c] - base[c]) * quiet[c]
        elif along < np.float32(GONE_BACK) * farthest[0] or n - pad[BEGUN] > LONGEST:
            pad[PRESSED], pad[LIFTED] = 0, n
            change = -1
            base[:] = row
    elif n < pad[LIFTED] + SETTLING:
        base[:] = row
    elif square > judge[0]:
        if pad[SUSPECTED] == 1:
            pad[PRESSED], pad[SUSPECTED], pad[FREE] = 1, 0, pad[LIFTED]
            pad[BEGUN] = max(n - 1 - int(judge[1]), pad[FREE] + 1)
            farthest[0] = np.float32(0)
            change = 1
        else:
            pad[SUSPECTED] = 1
    else:
        pad[SUSPECTED] = 0
        for c in range(len(row)):
            base[c] += np.float32(FOLLOWING) * (row[c] - base[c])
    return change


@njit(cache=True, error_model="numpy", nogil=True)
def _remember(n: int, ring: Any, bank: Any, poles: Any, pad: Any) -> None:
    """Keep the bank as it was when the press began."""
    for c in range(bank.shape[1]):
        for j in range(len(poles)):
            level = bank[0, c, j]
            for i in range(max(n - LAG + 1, 0), pad[BEGUN]):
                level += poles[j] * (ring[i % RING, c] - level)
            bank[1, c, j] = level


@njit(cache=True, error_model="numpy", nogil=True)
def _look(c: int, end: int, ring: Any, past: Any, pad: Any, out: Any) -> None:
    """Windows of a fibre in the press, of which readings below `end` count, and its history, from its rest."""
    down_command = pad[BEGUN]
    first = max(down_command - REST, pad[FREE])
    total = np.float32(0)
    for i in range(first, down_command):
        total += ring[i % RING, c]
    rest = total / np.float32(down_command - first)
    for k in range(len(WINDOWS)):
        total = np.float32(0)
        for i in range(down_command + WINDOWS[k][0], down_command + WINDOWS[k][1]):
            total += ring[max(min(i, end - 1), down_command) % RING, c]
        out[k] = total / np.float32(WINDOWS[k][1] - WINDOWS[k][0]) - rest
    for j in range(len(past)):
        out[len(WINDOWS) + j] = past[j] - rest


POLES = (2, 4, 8, 16, 32, 64, 128, 512, 2048)
"""Readings that the averages of the history go back by: each goes one such share of its way to every reading."""
EARLY = 2
"""Readings before its command at which a press may begin by the detector: commands are noted a little late."""
THRESHOLDS = np.geomspace(5, 5e4, 41)
"""Thresholds that the detector is tried with."""
AS_GOOD = 2e-3
"""A score so much below the best one is as good."""
LEAST_NOISE = 0.01
"""Noise of a fibre, as a share of what it gives for presses, at least."""


@dataclass(frozen=True)
class Detector:
    """The simple detector of touches, see `kernels.press_stream`.

    Attributes:
        noise_v: (C,) V, infinite for a fibre that tells nothing. threshold: of the squares of deviations over it.
        late: readings from the beginning of a press to the first that shows it.
    """

    noise_v: Array
    threshold: float
    late: int

    @property
    def quiet(self) -> Floats:
        """(C,) 1/V, one over the noise."""
        return (1 / self.noise_v).astype(np.float32)

    @classmethod
    def fit(cls, recording: Recording, training: Indices) -> "Detector":
        """The one that finds most of the presses `training`, by index, and least else beside them.

        The noise is that of the differences of neighbouring readings.
        """
        steps = np.abs(np.diff(interpolate_gaps(recording.readings), axis=0))
        noise = 1.4826 * np.sqrt(0.5) * np.median(steps, axis=0)
        plateau = commanded(recording).windows[training, :, len(WINDOWS) - 1]
        noise = np.maximum(noise, LEAST_NOISE * np.sqrt(np.square(plateau).mean(axis=0)))
        noise = np.where(noise > 0, noise, np.inf)
        scores, lates = [], []
        for threshold in THRESHOLDS:
            found = seen(recording.readings, cls(noise, float(threshold), 0))
            press = owners(recording, found.down_command)
            inside = press >= 0
            hits = np.isin(training, press[inside]).sum()
            owned = np.isin(np.abs(press) - (press < 0), training).sum()
            scores.append(2 * hits / (len(training) + owned))
            late = found.down_command[inside] - recording.down_command[press[inside]]
            lates.append(int(np.clip(np.median(late), 0, LAG - 2)) if len(late) else 0)
        good = np.flatnonzero(np.array(scores) >= max(scores) - AS_GOOD)
        best = int(good[len(good) // 2])
        return cls(noise, float(THRESHOLDS[best]), lates[best])


@dataclass(frozen=True)
class Seen:
    """Presses of which enough was seen.

    Attributes:
        begun, told, ended: (Q,) first reading of each, the one with which enough was seen, and the first after it; R
            if it has not ended.
        inputs: what was seen.
    """

    down_command: Indices
    told: Indices
    ended: Indices
    inputs: PressFeatures


def seen(readings: Array, detector: Detector, held: Mask | None = None, fibre_mask: Mask | None = None) -> Seen:
    """Presses as they are seen reading by reading.

    Args:
        readings: (R, C) V, NaN where missing. held: (R,) whether the pad is pressed; None where the detector judges.
        fibre_mask: (C,) fibres that count for it; all if None.
    """
    count, fibres = readings.shape
    edges = np.empty((count, 3), np.int64)
    shown = np.empty((count, fibres, len(WINDOWS) + len(POLES)), np.float32)
    there = np.empty((count, fibres), bool)
    found = follow(
        np.ascontiguousarray(readings, np.float32),
        np.zeros(0, bool) if held is None else held,
        np.ones(fibres, bool) if fibre_mask is None else fibre_mask,
        rates(),
        detector.quiet,
        np.array([detector.threshold, detector.late], np.float32),
        edges,
        shown,
        there,
    )
    windows, history = np.split(shown[:found].astype(np.float64), [len(WINDOWS)], axis=2)
    down_command, told, ended = edges[:found].T.copy()
    return Seen(down_command, told, ended, PressFeatures(windows, history, there[:found].copy()))


def rates() -> Floats:
    """(J,) share of its way that each average goes to a reading."""
    return (1 / np.array(POLES)).astype(np.float32)


def held(recording: Recording) -> Mask:
    """(R,) whether the pad was pressed, as commanded; there is a free reading between two presses."""
    pressed = np.zeros(len(recording.readings) + 1, bool)
    for first, end in zip(recording.down_command, recording.up_command, strict=True):
        pressed[first - 1] = False
        pressed[first:end] = True
    return pressed[:-1]


def commanded(recording: Recording) -> PressFeatures:
    """What is seen of every press as it was commanded; no fibre is alive in one that the readings end too soon for."""
    nothing = Detector(np.full(recording.fibres, np.inf), np.inf, 0)
    found = seen(recording.readings, nothing, held(recording))
    rows = np.searchsorted(recording.down_command, found.down_command)

    def of_all(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((len(recording.down_command), *values.shape[1:]), values.dtype)
        out[rows] = values
        return out

    return PressFeatures(of_all(found.inputs.windows), of_all(found.inputs.history), of_all(found.inputs.fibre_mask))


def owners(recording: Recording, down_command: Indices) -> Indices:
    """(Q,) which press each of the presses found is, by index; -1 - i where it is none, after press i has begun.

    Of several found in one press, the first is it.
    """
    press = np.maximum(np.searchsorted(recording.down_command, down_command + EARLY, side="right") - 1, 0)
    inside = (down_command >= recording.down_command[press] - EARLY) & (down_command < recording.up_command[press])
    inside[1:] &= ~(inside[:-1] & (press[1:] == press[:-1]))
    return np.where(inside, press, -1 - press)


LAYERS = 3
"""Residual layers of a student."""
WIDEST, STEP = 256, 4
"""Neurons of a layer at most, and by which it grows."""
CODE = 8192
"""Bytes of flash left for the code: 3 KiB of them on x86-64, and the expf and sqrtf of the library."""
SCALARS = 64
"""Bytes of the state beside its arrays, at most."""
_HISTORY, _INPUTS = len(POLES), len(WINDOWS)


@dataclass(frozen=True)
class Budget:
    """What a student may take.

    Attributes:
        flash, ram: bytes for code and tables, and for the state, its working arrays included.
        quantized: whether the weights are int8, not float32.
    """

    flash: int
    ram: int
    quantized: bool = False


def table_bytes(fibres: int, measures: int, levels: int, hidden: int, quantized: bool) -> int:
    """Bytes of all constant tables of a student.

    Args:
        measures: what is learnt beside the place. levels: numbers of lost fibres that radii are known for.
    """
    entries, outputs = fibres * (_INPUTS + 1), 2 * (2 + measures)
    weights = entries * hidden + LAYERS * hidden * hidden + hidden * outputs
    biases = (LAYERS + 1) * hidden + outputs
    network = weights + 8 * biases if quantized else 4 * (weights + biases)  # of int8, one scale goes with each bias
    memory = fibres * (2 * _INPUTS + _HISTORY * (1 + _INPUTS))
    return network + 4 * (memory + fibres + _HISTORY + levels * (3 + measures))


def state_bytes(fibres: int, measures: int, hidden: int) -> int:
    """Bytes of `localizer_state`, at most."""
    entries, outputs = fibres * (_INPUTS + 1), 2 * (2 + measures)
    kept = fibres * (RING + 2 * _HISTORY + 2) + entries + 2 * hidden + outputs
    return 4 * kept + 3 * fibres + 4 * fibres + SCALARS


def widest(fibres: int, measures: int, levels: int, budget: Budget) -> int:
    """Neurons of a layer that a budget allows.

    Raises:
        InputError: not even the least student fits.
    """

    def takes(hidden: int) -> tuple[int, int]:
        flash = CODE + table_bytes(fibres, measures, levels, hidden, budget.quantized)
        return flash, state_bytes(fibres, measures, hidden)

    fitting = [
        hidden
        for hidden in range(STEP, WIDEST + 1, STEP)
        if takes(hidden)[0] <= budget.flash and takes(hidden)[1] <= budget.ram
    ]
    if not fitting:
        flash, ram = takes(STEP)
        name, given, needed = ("flash", budget.flash, flash) if flash > budget.flash else ("ram", budget.ram, ram)
        raise InputError(
            f"--{name} is {given} bytes: the least localizer of {fibres} fibres takes {needed}, allowed is that or more"
        )
    return fitting[-1]
