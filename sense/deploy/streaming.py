"""What a microcontroller computes of each reading, up to its network; `localizer.h` does the same in float32.

All memory is fixed: a ring holds the latest readings, and exponential moving averages of each fibre, of several time
constants, stand for the history before. They lag LAG readings behind, as a touch is detected only after it began.

The detector of touches is simpler than `signals.press_detection` on purpose: fixed in size, and to be read in C.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_VOLTS, Array, Floats, Indices, Mask
from padforge.sense.localizer.features import DOWN, REST, PressFeatures, interpolate_gaps
from padforge.sense.recording.recording import Recording

RING = 32  # readings stored, a power of two: the rest before a press and PRESS of it
LAG = 8  # readings by which the averages lag; a touch must be detected sooner
SETTLING = 3  # readings after a release in which the baseline is the reading, and no touch is detected
BASELINE_RATE = 0.125  # weight of a new reading in the baseline while the pad is free
RELEASE_SHARE = 0.5  # of the largest deviation; below it the press has ended
MAX_PRESS = 1024  # readings; what lasts longer is a new rest
N_REST, PRESS = -REST[0], DOWN[-1][1]  # readings before a press that its rest is the mean of, and readings of it used
TIME_CONSTANTS = (2, 4, 8, 16, 32, 64, 128, 512, 2048)  # of the averages, readings
N_WINDOWS, N_HISTORY = len(DOWN), len(TIME_CONSTANTS)
RATES = (1 / np.array(TIME_CONSTANTS)).astype(np.float32)  # weight of a new reading in each average

N_LAYERS = 3  # residual layers of a student
MAX_HIDDEN, HIDDEN_STEP = 256, 4  # neurons of a layer at most, and by which it grows
CODE_BYTES = 8192  # of flash for the code: 3 KiB of it on x86-64, and expf and sqrtf of the library
SCALAR_BYTES = 64  # of the state beside its arrays, at most

TOLERANCE = 2  # readings before its command at which a press may be detected: commands are noted a little late
THRESHOLDS = np.geomspace(5, 5e4, 41)  # that the detector is tried with
SCORE_TOLERANCE = 2e-3  # a score so much below the best one counts as good
MIN_NOISE = 0.01  # noise of a fibre, at least, as a share of its response to presses

PRESSED, SUSPECTED, DOWN_COMMAND, UP_COMMAND, PREVIOUS_END, ESTIMATED, TOUCHED = range(7)
"""State of the pad: is it pressed, did the last reading exceed the threshold, the readings with which the press began
and ended and the press before it ended, is its position estimated, and the reading at which it was detected."""

kernel = njit(cache=True, error_model="numpy", nogil=True)


@kernel
def _run_stream(
    readings: Any,
    pressed: Any,
    fibre_mask: Any,
    rates: Any,
    inverse_noise: Any,
    detector: Any,
    windows: Any,
    edges: Any,
    features: Any,
    valid: Any,
) -> int:
    """Fill `edges` (R, 3), `features` (R, C, K + J) and `valid` (R, C) of every press, and return how many there are.

    `pressed` is empty for the detector to decide; `detector` holds its threshold and delay, and `windows` (1 + K, 2)
    the rest before a press and the windows of it.
    """
    n_readings, n_fibres = readings.shape
    ring = np.zeros((RING, n_fibres), np.float32)
    averages = np.zeros((2, n_fibres, len(rates)), np.float32)  # now, and when the press began
    levels = np.zeros((2, n_fibres), np.float32)  # baseline, and the largest deviation of the press
    max_square = np.zeros(1, np.float32)
    missing = np.zeros(n_fibres, np.int64)
    pad = np.zeros(7, np.int64)
    n_presses = 0
    for n in range(n_readings):
        _ingest(n, readings[n], ring, averages[0], levels[0], missing, rates)
        if len(pressed):
            change = _follow(n, pressed[n], pad)
        else:
            change = _detect(n, ring[n % RING], fibre_mask, inverse_noise, detector, levels, max_square, pad)
        if change > 0:
            missing[:] = 0
            pad[ESTIMATED], pad[TOUCHED] = 0, n
            _store_history(n, ring, averages, rates, pad)
        ended = change < 0
        if pad[ESTIMATED] == 0 and (ended or (pad[PRESSED] == 1 and n >= pad[DOWN_COMMAND] + windows[-1, 1] - 1)):
            pad[ESTIMATED] = 1
            edges[n_presses, 0], edges[n_presses, 1], edges[n_presses, 2] = pad[DOWN_COMMAND], n, n_readings
            end = n if ended else n + 1
            for c in range(n_fibres):
                valid[n_presses, c] = 4 * missing[c] <= n - pad[TOUCHED]
                _compute_features(c, end, ring, averages[1, c], pad, windows, features[n_presses, c])
            n_presses += 1
        if ended and n_presses > 0:
            edges[n_presses - 1, 2] = pad[UP_COMMAND]
    return n_presses


@kernel
def _ingest(n: int, row: Any, ring: Any, averages: Any, baseline: Any, missing: Any, rates: Any) -> None:
    """Store a reading; what is missing or beyond MAX_VOLTS repeats the reading before."""
    for c in range(len(row)):
        x = row[c]
        if not abs(x) <= np.float32(MAX_VOLTS):
            missing[c] += 1
            x = ring[(n - 1) % RING, c]
        lagged = ring[(n - LAG) % RING, c]
        ring[n % RING, c] = x
        if n == 0:
            baseline[c] = x
        for j in range(len(rates)):
            if n == 0:
                averages[c, j] = x
            elif n >= LAG:
                averages[c, j] += rates[j] * (lagged - averages[c, j])


@kernel
def _follow(n: int, pressed: bool, pad: Any) -> int:
    """Return 1 if a press begins with this reading, -1 if it ends, 0 otherwise, by what the caller says."""
    if pressed and pad[PRESSED] == 0:
        pad[PRESSED], pad[PREVIOUS_END] = 1, pad[UP_COMMAND]
        pad[DOWN_COMMAND] = max(n, pad[PREVIOUS_END] + 1)
        return 1
    if not pressed and pad[PRESSED] == 1:
        pad[PRESSED], pad[UP_COMMAND] = 0, n
        return -1
    return 0


@kernel
def _detect(
    n: int, row: Any, fibre_mask: Any, inverse_noise: Any, detector: Any, levels: Any, max_square: Any, pad: Any
) -> int:
    """Return the same as decided by the detector."""
    baseline, peak = levels[0], levels[1]
    square, along_peak = np.float32(0), np.float32(0)
    for c in range(len(row)):
        if fibre_mask[c]:
            deviation = (row[c] - baseline[c]) * inverse_noise[c]
            square += deviation * deviation
            along_peak += deviation * peak[c]
    change = 0
    if pad[PRESSED] == 1:
        if square > max_square[0]:
            max_square[0] = square
            for c in range(len(row)):
                peak[c] = (row[c] - baseline[c]) * inverse_noise[c]
        elif along_peak < np.float32(RELEASE_SHARE) * max_square[0] or n - pad[DOWN_COMMAND] > MAX_PRESS:
            pad[PRESSED], pad[UP_COMMAND] = 0, n
            change = -1
            baseline[:] = row
    elif n < pad[UP_COMMAND] + SETTLING:
        baseline[:] = row
    elif square > detector[0]:
        if pad[SUSPECTED] == 1:
            pad[PRESSED], pad[SUSPECTED], pad[PREVIOUS_END] = 1, 0, pad[UP_COMMAND]
            pad[DOWN_COMMAND] = max(n - 1 - int(detector[1]), pad[PREVIOUS_END] + 1)
            max_square[0] = np.float32(0)
            change = 1
        else:
            pad[SUSPECTED] = 1
    else:
        pad[SUSPECTED] = 0
        for c in range(len(row)):
            baseline[c] += np.float32(BASELINE_RATE) * (row[c] - baseline[c])
    return change


@kernel
def _store_history(n: int, ring: Any, averages: Any, rates: Any, pad: Any) -> None:
    """Bring the averages up to the begin of the press, and store them."""
    for c in range(averages.shape[1]):
        for j in range(len(rates)):
            level = averages[0, c, j]
            for i in range(max(n - LAG + 1, 0), pad[DOWN_COMMAND]):
                level += rates[j] * (ring[i % RING, c] - level)
            averages[1, c, j] = level


@kernel
def _compute_features(c: int, end: int, ring: Any, history: Any, pad: Any, windows: Any, out: Any) -> None:
    """Compute the windows of a fibre from the readings of the press before `end`, and its history."""
    down_command, n_windows = pad[DOWN_COMMAND], len(windows) - 1
    first = max(down_command + windows[0, 0], pad[PREVIOUS_END])
    total = np.float32(0)
    for i in range(first, down_command):
        total += ring[i % RING, c]
    rest = total / np.float32(down_command - first)
    for k in range(n_windows):
        low, high = windows[k + 1, 0], windows[k + 1, 1]
        total = np.float32(0)
        for i in range(down_command + low, down_command + high):
            total += ring[max(min(i, end - 1), down_command) % RING, c]
        out[k] = total / np.float32(high - low) - rest
    for j in range(len(history)):
        out[n_windows + j] = history[j] - rest


@dataclass(frozen=True)
class ThresholdDetector:
    """A baseline, a threshold and a few integers, where `signals.press_detection` has Kalman filters in float64.

    While the pad is free, the baseline follows each fibre; the pad is touched when the sum of squared deviations, in
    units of the fibres' noise, exceeds a threshold in two readings in a row, and released when the deviation has gone
    back by half. The baseline then starts anew.
    """

    noise_v: Array  # (C,), infinite for a fibre that does not respond
    threshold: float  # of the sum of squared deviations in units of the noise
    delay: int  # readings from the begin of a press to the first that shows it

    @property
    def inverse_noise(self) -> Floats:
        """(C,) 1/V."""
        return (1 / self.noise_v).astype(np.float32)

    @classmethod
    def fit(cls, recording: Recording, training: Indices) -> "ThresholdDetector":
        """Choose the threshold of the best F1 score on presses, by index; noise is that of successive differences."""
        steps = np.abs(np.diff(interpolate_gaps(recording.readings), axis=0))
        noise = 1.4826 * np.sqrt(0.5) * np.median(steps, axis=0)  # median of the absolute difference to std
        response = commanded_features(recording).windows[training, :, -1]
        noise = np.maximum(noise, MIN_NOISE * np.sqrt(np.square(response).mean(axis=0)))
        noise = np.where(noise > 0, noise, np.inf)
        scores, delays = [], []
        for threshold in THRESHOLDS:
            detected = stream_presses(recording.readings, cls(noise, float(threshold), 0))
            press = match_presses(recording, detected.down_command)
            matched = press >= 0
            n_hits = np.isin(training, press[matched]).sum()
            n_detected = np.isin(np.abs(press) - (press < 0), training).sum()
            scores.append(2 * n_hits / (len(training) + n_detected))
            late = detected.down_command[matched] - recording.down_command[press[matched]]
            delays.append(int(np.clip(np.median(late), 0, LAG - 2)) if len(late) else 0)
        good = np.flatnonzero(np.array(scores) >= max(scores) - SCORE_TOLERANCE)
        best = int(good[len(good) // 2])
        return cls(noise, float(THRESHOLDS[best]), delays[best])


@dataclass(frozen=True)
class StreamedPresses:
    """Q presses as they are detected reading by reading."""

    down_command: Indices  # (Q,) first reading of each
    estimated: Indices  # (Q,) reading with which its position is estimated
    ended: Indices  # (Q,) first reading after it; R if it has not ended
    features: PressFeatures


def stream_presses(
    readings: Array, detector: ThresholdDetector, pressed: Mask | None = None, fibre_mask: Mask | None = None
) -> StreamedPresses:
    """Process (R, C) readings as a microcontroller does; `pressed` (R,) is None for the detector to decide."""
    n_readings, n_fibres = readings.shape
    edges = np.empty((n_readings, 3), np.int64)
    features = np.empty((n_readings, n_fibres, N_WINDOWS + N_HISTORY), np.float32)
    valid = np.empty((n_readings, n_fibres), bool)
    n_presses = _run_stream(
        np.ascontiguousarray(readings, np.float32),
        np.zeros(0, bool) if pressed is None else pressed,
        np.ones(n_fibres, bool) if fibre_mask is None else fibre_mask,
        RATES,
        detector.inverse_noise,
        np.array([detector.threshold, detector.delay], np.float32),
        np.array([REST, *DOWN]),
        edges,
        features,
        valid,
    )
    windows, history = np.split(features[:n_presses].astype(np.float64), [N_WINDOWS], axis=2)
    return StreamedPresses(*edges[:n_presses].T.copy(), PressFeatures(windows, history, valid[:n_presses].copy()))


def commanded_presses(recording: Recording) -> Mask:
    """Return (R,) whether the pad was pressed, by the commands; a free reading lies between two presses."""
    pressed = np.zeros(len(recording.readings) + 1, bool)
    for first, end in zip(recording.down_command, recording.up_command, strict=True):
        pressed[first - 1] = False
        pressed[first:end] = True
    return pressed[:-1]


def commanded_features(recording: Recording) -> PressFeatures:
    """Return the features of every press as commanded; one that the readings end too soon for has no valid fibre."""
    unused = ThresholdDetector(np.full(recording.fibres, np.inf), np.inf, 0)
    presses = stream_presses(recording.readings, unused, commanded_presses(recording))
    rows = np.searchsorted(recording.down_command, presses.down_command)

    def of_all(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((len(recording.down_command), *values.shape[1:]), values.dtype)
        out[rows] = values
        return out

    return PressFeatures(*map(of_all, vars(presses.features).values()))


def match_presses(recording: Recording, down_command: Indices) -> Indices:
    """Return the index of the recording's press that each detection, by its first reading, is the first of.

    It is -1 - i for a false detection after press i has begun.
    """
    press = np.maximum(np.searchsorted(recording.down_command, down_command + TOLERANCE, side="right") - 1, 0)
    inside = (down_command >= recording.down_command[press] - TOLERANCE) & (down_command < recording.up_command[press])
    inside[1:] &= ~(inside[:-1] & (press[1:] == press[:-1]))
    return np.where(inside, press, -1 - press)


@dataclass(frozen=True)
class MemoryBudget:
    """Memory that a student may use, bytes."""

    flash: int  # for code and tables
    ram: int  # for the state with its working arrays
    quantized: bool = False  # whether the weights are int8, not float32


def table_bytes(n_fibres: int, n_measures: int, n_levels: int, hidden: int, quantized: bool) -> int:
    """Return the bytes of a student's tables; intervals are calibrated for `n_levels` numbers of failed fibres."""
    n_inputs, n_outputs = n_fibres * (N_WINDOWS + 1), 2 * (2 + n_measures)
    weights = n_inputs * hidden + N_LAYERS * hidden * hidden + hidden * n_outputs
    biases = (N_LAYERS + 1) * hidden + n_outputs
    network = weights + 8 * biases if quantized else 4 * (weights + biases)  # int8: each bias comes with a scale
    scaler = n_fibres * (2 * N_WINDOWS + N_HISTORY * (1 + N_WINDOWS))
    return network + 4 * (scaler + n_fibres + N_HISTORY + n_levels * (3 + n_measures))


def state_bytes(n_fibres: int, n_measures: int, hidden: int) -> int:
    """Return the bytes of `localizer_state`, at most."""
    n_inputs, n_outputs = n_fibres * (N_WINDOWS + 1), 2 * (2 + n_measures)
    floats = n_fibres * (RING + 2 * N_HISTORY + 2) + n_inputs + 2 * hidden + n_outputs
    return 4 * floats + 7 * n_fibres + SCALAR_BYTES


def max_hidden(n_fibres: int, n_measures: int, n_levels: int, budget: MemoryBudget) -> int:
    """Return the neurons of a layer that a budget allows; InputError if not even the smallest student fits."""
    sizes = range(HIDDEN_STEP, MAX_HIDDEN + 1, HIDDEN_STEP)
    flash = [CODE_BYTES + table_bytes(n_fibres, n_measures, n_levels, size, budget.quantized) for size in sizes]
    ram = [state_bytes(n_fibres, n_measures, size) for size in sizes]
    for name, allowed, least in (("flash", budget.flash, flash[0]), ("ram", budget.ram, ram[0])):
        if least > allowed:
            raise InputError(
                f"--{name} is {allowed} bytes: the smallest localizer of {n_fibres} fibres takes {least}, "
                "allowed is that or more"
            )
    return max(size for size, f, r in zip(sizes, flash, ram, strict=True) if f <= budget.flash and r <= budget.ram)
