"""What a microcontroller computes of each reading, up to its network; `localizer.h` does the same in float32.

All memory is fixed: a ring holds the latest readings, and exponential moving averages of each fibre, of several time
constants, stand for the history before. They lag LAG readings behind, as a touch is detected only after it began. The
windows of a press are kept as they are complete, so that it may last, and its position is estimated at every reading.

The detector of touches is simpler than `signals.press_detection` on purpose: fixed in size, and to be read in C.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.compilation import inner_kernel, kernel
from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_VOLTS, Array, Floats, Indices, Mask
from padforge.sense.localizer.features import DOWN, NOW, REST, PressFeatures, interpolate_gaps
from padforge.sense.localizer.moments import count_complete
from padforge.sense.recording.recording import Recording

RING = 32  # readings stored, a power of two: the rest before a press, and what of it was read before it is detected
LAG = 8  # readings by which the averages lag; a touch must be detected sooner
SETTLING = 3  # readings after a release in which the baseline is the reading, and no touch is detected
BASELINE_RATE = 0.125  # weight of a new reading in the baseline while the pad is free
RELEASE_SHARE = 0.5  # of the largest deviation; below it the press has ended
RELEASE_LAG = 1  # readings that show a release before it is detected; the final estimate does without them
MAX_PRESS = 1024  # readings; what lasts longer is a new rest
N_REST = -REST[0]  # readings before a press that its rest is the mean of
TIME_CONSTANTS = (2, 4, 8, 16, 32, 64, 128, 512, 2048)  # of the averages, readings
N_WINDOWS, N_FEATURES, N_HISTORY = len(DOWN), len(DOWN) + len(NOW), len(TIME_CONSTANTS)
RATES = (1 / np.array(TIME_CONSTANTS)).astype(np.float32)  # weight of a new reading in each average

N_LAYERS = 3  # residual layers of a student
MAX_HIDDEN, HIDDEN_STEP = 256, 4  # neurons of a layer at most, and by which it grows
CODE_BYTES = 8192  # of flash for the code: 3 KiB of it on x86-64, and expf and sqrtf of the library
SCALAR_BYTES = 64  # of the state beside its arrays, at most

TOLERANCE = 2  # readings before its command at which a press may be detected: commands are noted a little late
THRESHOLDS = np.geomspace(5, 5e4, 41)  # that the detector is tried with
SCORE_TOLERANCE = 2e-3  # a score so much below the best one counts as good
MIN_NOISE = 0.01  # noise of a fibre, at least, as a share of its response to presses

PRESSED, SUSPECTED, DOWN_COMMAND, UP_COMMAND, PREVIOUS_END, TOUCHED, N_COMPLETE, N_ESTIMATES = range(8)
"""State of the pad: is it pressed, did the last reading exceed the threshold, the readings with which the press began
and ended and the press before it ended, the reading at which it was detected, how many windows of it are complete, and
how often its position was estimated."""


@kernel
def _run_stream(
    readings: Any,
    pressed: Any,
    fibre_mask: Any,
    rates: Any,
    inverse_noise: Any,
    detector: Any,
    rest_length: int,
    down: Any,
    now: Any,
    edges: Any,
    moments: Any,
    features: Any,
    valid: Any,
) -> tuple[int, int]:
    """Fill `edges` of every press, and a row of the others for every estimate; return how many there are of both.

    `pressed` is empty for the detector to decide; `detector` holds its threshold and delay, and `down` (K, 2) and `now`
    the windows. `edges` (R, 2) are the first reading of a press and the first after it, `moments` (R, 4) of an estimate
    the press, the reading, and how many readings of the press it uses and windows of it are complete, `features`
    (R, C, F + J) and `valid` (R, C) what it uses.
    """
    n_readings, n_fibres = readings.shape
    n_windows, n_features = len(down), len(down) + len(now)
    ring = np.zeros((RING, n_fibres), np.float32)
    averages = np.zeros((n_fibres, len(rates)), np.float32)
    history = np.zeros((n_fibres, len(rates)), np.float32)  # the averages when the press began, from its rest
    rest = np.zeros(n_fibres, np.float32)
    windows = np.zeros((n_fibres, n_windows), np.float32)  # of the press, as far as they are complete
    levels = np.zeros((2, n_fibres), np.float32)  # baseline, and the largest deviation of the press
    max_square = np.zeros(1, np.float32)
    missing = np.zeros(n_fibres, np.int64)
    pad = np.zeros(8, np.int64)
    n_presses = n_estimates = 0
    for n in range(n_readings):
        _ingest(n, readings[n], ring, averages, missing, rates)
        if len(pressed):
            change = _follow(n, pressed[n], pad)
        else:
            change = _detect(n, ring[n % RING], fibre_mask, inverse_noise, detector, levels, max_square, pad)
        if change > 0:
            missing[:] = 0
            pad[TOUCHED], pad[N_COMPLETE], pad[N_ESTIMATES] = n, 0, 0
            _store_begin(n, rest_length, ring, averages, rates, pad, rest, history)
        ended = change < 0
        if pad[PRESSED] == 0 and not ended:
            continue
        end = n + 1
        if ended:
            end = n if len(pressed) else n - RELEASE_LAG
        while pad[N_COMPLETE] < n_windows and (ended or pad[DOWN_COMMAND] + down[pad[N_COMPLETE], 1] <= end):
            k = pad[N_COMPLETE]
            for c in range(n_fibres):
                windows[c, k] = _window_mean(c, pad[DOWN_COMMAND], down[k], end, ring, pad) - rest[c]
            pad[N_COMPLETE] += 1
        if pad[N_COMPLETE] == 0:
            continue
        if pad[N_ESTIMATES] == 0:
            edges[n_presses, 0], edges[n_presses, 1] = pad[DOWN_COMMAND], n_readings
            n_presses += 1
        pad[N_ESTIMATES] += 1
        if ended:
            edges[n_presses - 1, 1] = n
        moments[n_estimates, 0], moments[n_estimates, 1] = n_presses - 1, n
        moments[n_estimates, 2], moments[n_estimates, 3] = max(end - pad[DOWN_COMMAND], 0), pad[N_COMPLETE]
        for c in range(n_fibres):
            out = features[n_estimates, c]
            valid[n_estimates, c] = 4 * missing[c] <= n - pad[TOUCHED]
            out[:n_windows] = windows[c]
            out[pad[N_COMPLETE] : n_windows] = 0
            for k in range(len(now)):
                out[n_windows + k] = _window_mean(c, end, now[k], end, ring, pad) - rest[c]
            out[n_features:] = history[c]
        n_estimates += 1
    return n_presses, n_estimates


@inner_kernel
def _ingest(n: int, row: Any, ring: Any, averages: Any, missing: Any, rates: Any) -> None:
    """Store a reading; what is missing or beyond MAX_VOLTS repeats the reading before."""
    for c in range(len(row)):
        x = row[c]
        if not abs(x) <= np.float32(MAX_VOLTS):
            missing[c] += 1
            x = ring[(n - 1) % RING, c]
        lagged = ring[(n - LAG) % RING, c]
        ring[n % RING, c] = x
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


@inner_kernel
def _store_begin(
    n: int, rest_length: int, ring: Any, averages: Any, rates: Any, pad: Any, rest: Any, history: Any
) -> None:
    """Store the rest before the press, and the averages, brought up to its begin, from that rest."""
    first = max(pad[DOWN_COMMAND] - rest_length, pad[PREVIOUS_END])
    for c in range(len(rest)):
        total = np.float32(0)
        for i in range(first, pad[DOWN_COMMAND]):
            total += ring[i % RING, c]
        rest[c] = total / np.float32(pad[DOWN_COMMAND] - first)
        for j in range(len(rates)):
            level = averages[c, j]
            for i in range(max(n - LAG + 1, 0), pad[DOWN_COMMAND]):
                level += rates[j] * (ring[i % RING, c] - level)
            history[c, j] = level - rest[c]


@inner_kernel
def _window_mean(c: int, origin: int, window: Any, end: int, ring: Any, pad: Any) -> Any:
    """Return the mean of a fibre over a window; what is not of the press before `end` repeats the nearest reading."""
    total = np.float32(0)
    for i in range(origin + window[0], origin + window[1]):
        total += ring[max(min(i, end - 1), pad[DOWN_COMMAND]) % RING, c]
    return total / np.float32(window[1] - window[0])


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
        response = commanded_features(recording).windows[training, :, N_WINDOWS - 1]
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
    """P presses as they are detected reading by reading, and Q estimates of their positions, in their order."""

    down_command: Indices  # (P,) first reading of each press
    ended: Indices  # (P,) first reading after it; R if it has not ended
    press: Indices  # (Q,) press of each estimate
    reading: Indices  # (Q,) with which it comes; `ended` of the press for its final estimate
    n_readings: Indices  # (Q,) readings of the press that it uses
    features: PressFeatures  # of the estimates

    @property
    def last(self) -> Indices:
        """(P,) the last estimate of each press, which is the final one where the press has ended."""
        return np.searchsorted(self.press, np.arange(len(self.down_command)), side="right") - 1

    def at(self, n_complete: int) -> Indices:
        """(P,) the first estimate of each press with so many windows complete, or the last where it has fewer."""
        too_early = count_complete(self.features.seen) < n_complete
        n_before = np.bincount(self.press[too_early], minlength=len(self.down_command))
        return np.minimum(np.searchsorted(self.press, np.arange(len(self.down_command))) + n_before, self.last)


def stream_presses(
    readings: Array, detector: ThresholdDetector, pressed: Mask | None = None, fibre_mask: Mask | None = None
) -> StreamedPresses:
    """Process (R, C) readings as a microcontroller does; `pressed` (R,) is None for the detector to decide."""
    n_readings, n_fibres = readings.shape
    edges, moments = np.empty((n_readings, 2), np.int64), np.empty((n_readings, 4), np.int64)
    features = np.empty((n_readings, n_fibres, N_FEATURES + N_HISTORY), np.float32)
    valid = np.empty((n_readings, n_fibres), bool)
    n_presses, n_estimates = _run_stream(
        np.ascontiguousarray(readings, np.float32),
        np.zeros(0, bool) if pressed is None else pressed,
        np.ones(n_fibres, bool) if fibre_mask is None else fibre_mask,
        RATES,
        detector.inverse_noise,
        np.array([detector.threshold, detector.delay], np.float32),
        N_REST,
        np.array(DOWN),
        np.array(NOW),
        edges,
        moments,
        features,
        valid,
    )
    windows, history = np.split(features[:n_estimates].astype(np.float64), [N_FEATURES], axis=2)
    press, reading, length, n_complete = moments[:n_estimates].T.copy()
    down_command, ended = edges[:n_presses].T.copy()
    seen = np.arange(N_WINDOWS) < n_complete[:, None]
    estimated = PressFeatures(windows, history, valid[:n_estimates].copy(), seen)
    return StreamedPresses(down_command, ended, press, reading, length, estimated)


def commanded_presses(recording: Recording) -> Mask:
    """Return (R,) whether the pad was pressed, by the commands; a free reading lies between two presses."""
    pressed = np.zeros(len(recording.readings) + 1, bool)
    for first, end in zip(recording.down_command, recording.up_command, strict=True):
        pressed[first - 1] = False
        pressed[first:end] = True
    return pressed[:-1]


def commanded_features(recording: Recording, n_complete: int | None = None) -> PressFeatures:
    """Return the features of every press as commanded, when so many windows of it are complete, or at its end if None.

    One that the readings end too soon for has no valid fibre.
    """
    unused = ThresholdDetector(np.full(recording.fibres, np.inf), np.inf, 0)
    presses = stream_presses(recording.readings, unused, commanded_presses(recording))
    features = presses.features[presses.last if n_complete is None else presses.at(n_complete)]
    read = np.flatnonzero(count_complete(features.seen) >= (n_complete or N_WINDOWS))
    rows = np.searchsorted(recording.down_command, presses.down_command[read])

    def of_all(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((len(recording.down_command), *values.shape[1:]), values.dtype)
        out[rows] = values
        return out

    return PressFeatures(*map(of_all, vars(features[read]).values()))


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
    n_inputs, n_outputs = n_fibres * (N_FEATURES + 1) + N_WINDOWS, 2 * (2 + n_measures)
    weights = n_inputs * hidden + N_LAYERS * hidden * hidden + hidden * n_outputs
    biases = (N_LAYERS + 1) * hidden + n_outputs
    network = weights + 8 * biases if quantized else 4 * (weights + biases)  # int8: each bias comes with a scale
    scaler = n_fibres * (2 * N_FEATURES + N_HISTORY * (1 + N_FEATURES))
    return network + 4 * (scaler + n_fibres + N_HISTORY + N_WINDOWS * n_levels * (2 + n_measures))


def state_bytes(n_fibres: int, n_measures: int, hidden: int) -> int:
    """Return the bytes of `localizer_state`, at most."""
    n_inputs, n_outputs = n_fibres * (N_FEATURES + 1) + N_WINDOWS, 2 * (2 + n_measures)
    floats = n_fibres * (RING + 2 * N_HISTORY + 3 + N_WINDOWS) + n_inputs + 2 * hidden + n_outputs
    return 4 * floats + 5 * n_fibres + SCALAR_BYTES


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
