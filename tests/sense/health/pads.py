"""A simulated pad, health learnt of it in a moment, and the ways in which its fibres fail."""

from collections.abc import Callable
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from padforge.sense import Recording
from padforge.sense.health import health_model as learning
from padforge.sense.health import trace_model as fibre_prediction
from padforge.sense.health.fault_detector import FibreFault, examine
from padforge.sense.health.health_model import HealthModel, fit_health_model

Array = NDArray[np.float64]
LEARNT, PRESSES, BAD_FROM = 600, 760, 660


def learn(readings: Array, pad: Recording, presses: int = LEARNT) -> HealthModel:
    """Health by a quick training on the first presses, of which, on this pad, LEARNT suffice to call a fibre weak."""
    end = pad.down_command[presses]
    with mock.patch.object(fibre_prediction, "MOST_STEPS", 250), mock.patch.object(learning, "WEAK_PRESSES", LEARNT):
        return fit_health_model(
            readings[:end],
            pad.times_s[:end],
            pad.down_command[:presses],
            pad.up_command[:presses],
            rng=np.random.default_rng(0),
        )


def later(model: HealthModel, readings: Array, pad: Recording, first: int = LEARNT) -> list[FibreFault]:
    """Findings on the presses that health was not learnt from; press 0 is the first of them."""
    start = pad.up_command[first - 1]
    return examine(
        model, readings[start:], pad.times_s[start:], pad.down_command[first:] - start, pad.up_command[first:] - start
    )


Fault = Callable[[Array, Array, np.random.Generator], Array]
FAULTS: dict[str, Fault] = {
    "stuck": lambda own, before, rng: np.full_like(own, own[0]),
    "open": lambda own, before, rng: np.zeros_like(own),
    "floating": lambda own, before, rng: rng.uniform(0, 3.3, len(own)),
    "noisy": lambda own, before, rng: own + 0.016 * rng.standard_normal(len(own)),
    "offset": lambda own, before, rng: own + 0.1,
    "drifting": lambda own, before, rng: own - 5e-5 * np.arange(len(own)),
    "weak": lambda own, before, rng: (own + np.median(before)) / 2,
}
"""What fibre 1 reads instead of its own readings, of those before, or "swapped" with fibre 4."""


def spoilt(pad: Recording, fault: str, press: int = BAD_FROM, readings: Array | None = None) -> Array:
    """Readings in which a fibre fails from a press on."""
    found, at = (pad.readings if readings is None else readings).copy(), int(pad.down_command[press])
    if fault == "swapped":
        found[at:, [1, 4]] = found[at:, [4, 1]]
    else:
        found[at:, 1] = FAULTS[fault](found[at:, 1], found[at - 400 : at, 1], np.random.default_rng(2))
    return found


def faulty(rng: np.random.Generator, readings: Array) -> Array:
    """Readings (R, C) of which one to three fibres fail, or all of them, from some reading or the first on."""
    readings = readings.copy()
    rows, fibres = readings.shape
    for _ in range(rng.integers(1, 4)):
        fibre, since = int(rng.integers(fibres)), int(rng.integers(rows) * rng.integers(2))
        part = readings[since:, fibre]
        match rng.integers(9):
            case 0:
                part[:] = rng.choice([0.0, 3.3, np.nan, 1e-300, 5e-324, 1e3, -1e3])
            case 1:  # saturated
                np.clip(part, 1.8, 1.85, out=part)
            case 2:
                part[rng.random(len(part)) < rng.choice([0.01, 0.5, 0.99])] = np.nan
            case 3:
                other = int(rng.integers(fibres))
                readings[since:, [fibre, other]] = readings[since:, [other, fibre]]
            case 4:
                part *= rng.choice([1e-300, 1e-9, 1e-3, -1.0, 300.0])
            case 5:
                part += rng.standard_normal(len(part)) * rng.choice([1e-12, 1.0, 100.0])
            case 6:  # spikes
                part[rng.random(len(part)) < 0.01] = rng.choice([1e3, -1e3])
            case 7:
                part += np.linspace(0, rng.choice([1.0, -100.0]), len(part))
            case _:
                readings[since:] = rng.choice([0.0, 1.0, 999.0])
    return readings.clip(-1e3, 1e3)
