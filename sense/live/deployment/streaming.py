"""The Python twin of `localizer.h` as far as it goes without its network: presses as seen reading by reading."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.sense.localizer.features import Inputs, bridged
from padforge.sense.recordings.processing.limits import Array, Floats, Indices, Mask
from padforge.sense.recordings.recording import Recording

from padforge.sense.live.deployment.kernels.press_stream import LAG, WINDOWS, follow

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
        steps = np.abs(np.diff(bridged(recording.readings), axis=0))
        noise = 1.4826 * np.sqrt(0.5) * np.median(steps, axis=0)
        plateau = commanded(recording).windows[training, :, len(WINDOWS) - 1]
        noise = np.maximum(noise, LEAST_NOISE * np.sqrt(np.square(plateau).mean(axis=0)))
        noise = np.where(noise > 0, noise, np.inf)
        scores, lates = [], []
        for threshold in THRESHOLDS:
            found = seen(recording.readings, cls(noise, float(threshold), 0))
            press = owners(recording, found.begun)
            inside = press >= 0
            hits = np.isin(training, press[inside]).sum()
            owned = np.isin(np.abs(press) - (press < 0), training).sum()
            scores.append(2 * hits / (len(training) + owned))
            late = found.begun[inside] - recording.begun[press[inside]]
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

    begun: Indices
    told: Indices
    ended: Indices
    inputs: Inputs


def seen(readings: Array, detector: Detector, held: Mask | None = None, alive: Mask | None = None) -> Seen:
    """Presses as they are seen reading by reading.

    Args:
        readings: (R, C) V, NaN where missing. held: (R,) whether the pad is pressed; None where the detector judges.
        alive: (C,) fibres that count for it; all if None.
    """
    count, fibres = readings.shape
    edges = np.empty((count, 3), np.int64)
    shown = np.empty((count, fibres, len(WINDOWS) + len(POLES)), np.float32)
    there = np.empty((count, fibres), bool)
    found = follow(
        np.ascontiguousarray(readings, np.float32),
        np.zeros(0, bool) if held is None else held,
        np.ones(fibres, bool) if alive is None else alive,
        rates(),
        detector.quiet,
        np.array([detector.threshold, detector.late], np.float32),
        edges,
        shown,
        there,
    )
    windows, history = np.split(shown[:found].astype(np.float64), [len(WINDOWS)], axis=2)
    begun, told, ended = edges[:found].T.copy()
    return Seen(begun, told, ended, Inputs(windows, history, there[:found].copy()))


def rates() -> Floats:
    """(J,) share of its way that each average goes to a reading."""
    return (1 / np.array(POLES)).astype(np.float32)


def held(recording: Recording) -> Mask:
    """(R,) whether the pad was pressed, as commanded; there is a free reading between two presses."""
    pressed = np.zeros(len(recording.readings) + 1, bool)
    for first, end in zip(recording.begun, recording.lifted, strict=True):
        pressed[first - 1] = False
        pressed[first:end] = True
    return pressed[:-1]


def commanded(recording: Recording) -> Inputs:
    """What is seen of every press as it was commanded; no fibre is alive in one that the readings end too soon for."""
    nothing = Detector(np.full(recording.fibres, np.inf), np.inf, 0)
    found = seen(recording.readings, nothing, held(recording))
    rows = np.searchsorted(recording.begun, found.begun)

    def of_all(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((len(recording.begun), *values.shape[1:]), values.dtype)
        out[rows] = values
        return out

    return Inputs(of_all(found.inputs.windows), of_all(found.inputs.history), of_all(found.inputs.alive))


def owners(recording: Recording, begun: Indices) -> Indices:
    """(Q,) which press each of the presses found is, by index; -1 - i where it is none, after press i has begun.

    Of several found in one press, the first is it.
    """
    press = np.maximum(np.searchsorted(recording.begun, begun + EARLY, side="right") - 1, 0)
    inside = (begun >= recording.begun[press] - EARLY) & (begun < recording.lifted[press])
    inside[1:] &= ~(inside[:-1] & (press[1:] == press[:-1]))
    return np.where(inside, press, -1 - press)
