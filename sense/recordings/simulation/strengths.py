"""How strongly a recorded pad drifts, and what its silicone keeps of a press: what a simulated pad is told in `[rig]`.

A press leaves a share of its answer behind, the other way round, which goes by and by: so rests differ from press to
press. How much they do by the time between them, their variogram, tells what goes within some presses from what
drifts over minutes; how far a fibre comes back beyond its rest, set against its answer, tells the share.
"""

import numpy as np
from scipy.optimize import nnls

from padforge.sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Indices
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.simulation.pad_model import DELAY_S, DRIFT_S, TRAVEL_S

LEAST_PRESSES = 100
"""Presses that can tell."""
REST_S, LEFT_S = 0.7, (0.7, 1.4)
"""Time before a press, and range of times after it, in which fibres are at rest and show what it left behind."""
LASTING_S = np.geomspace(1.0, 100.0, 41)
"""Times in which that may go."""


def strengths(recording: Recording) -> dict[str, float]:
    """Values for `noise_mv`, `drift_mv`, `hysteresis` and `hysteresis_s` of `[rig]` by which a simulated pad is alike.

    Channels that miss readings or never change are left out; places need not be known.

    Returns:
        None of them where fewer than LEAST_PRESSES, or no channel, can tell.
    """
    begun, lifted, rate_hz = recording.begun[:-1], recording.lifted[:-1], recording.rate_hz
    whole = np.isfinite(recording.readings).all(axis=0) & (np.ptp(recording.readings, axis=0) > LEAST_SPREAD_V)
    if len(begun) < LEAST_PRESSES or not whole.any():
        return {}
    readings, after = recording.readings[:, whole], recording.begun[1:]
    settled, rested, first, last = np.ceil(np.array([DELAY_S[1] + TRAVEL_S, REST_S, *LEFT_S]) * rate_hz).astype(int)
    rest = _means(readings, np.maximum(begun - rested, np.append(0, lifted[:-1])), begun)
    answer = _means(readings, np.minimum(begun + settled, lifted - 1), lifted) - rest
    left = _means(readings, np.minimum(lifted + first, after - 1), np.minimum(lifted + last, after)) - rest
    lasting_s, drift_v = _memory(rest, float(np.median(np.diff(recording.times_s[begun]))))
    answer, left = answer - answer.mean(axis=0), left - left.mean(axis=0)
    share = -float((answer * left).sum() / (answer**2).sum()) * np.exp(np.mean(LEFT_S) / lasting_s)
    middle = (begun + lifted) // 2
    bends = readings[middle - 1] - 2 * readings[middle] + readings[middle + 1]
    return {
        "noise_mv": 1e3 * float(np.sqrt((bends**2).mean() / 6)),  # white noise bends by six times its variance
        "drift_mv": 1e3 * drift_v,
        "hysteresis": float(np.clip(share, 0, 0.99)),
        "hysteresis_s": lasting_s,
    }


def _means(readings: Array, first: Indices, end: Indices) -> Array:
    """(Q, C) means of the readings from first (Q,) to before end (Q,), of one at least."""
    return np.array([readings[a : max(b, a + 1)].mean(axis=0) for a, b in zip(first, end, strict=True)])


def _memory(rest: Array, apart_s: float) -> tuple[float, float]:
    """In which time what presses leave behind goes, s, and the standard deviation of the drift, V."""
    lags = np.unique(np.geomspace(1, len(rest) // 2, 24).astype(int))
    seen = np.array([((rest[lag:] - rest[:-lag]) ** 2).mean() / 2 for lag in lags])
    found: list[tuple[float, float, float]] = []
    for lasting_s in LASTING_S.tolist():
        shapes = 1 - np.exp(-lags[:, None] * apart_s / np.array([lasting_s, DRIFT_S]))
        (_, drift), misfit = nnls(shapes / np.maximum(seen, LEAST_SPREAD_V**2)[:, None], np.ones(len(lags)))
        found.append((float(misfit), lasting_s, float(np.sqrt(drift))))
    return min(found)[1:]
