"""A simulated pad, a model of it that is trained in a moment, and the ways in which its fibres fail."""

from collections.abc import Callable
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from padforge.sense import FaultDetector, FibreFault, HealthModel, Recording
from padforge.sense.health import health_model, trace_model

Array = NDArray[np.float64]
TRAINED, PRESSES, BAD_FROM = 600, 760, 660
FEW = 320
"""Presses that a model can be trained on, but not enough to detect a reduced gain."""


def fit(readings: Array, pad: Recording, presses: int = TRAINED) -> HealthModel:
    """A quick training on the first presses, of which, on this pad, TRAINED suffice to detect a reduced gain."""
    end = pad.down_command[presses]
    with mock.patch.object(trace_model, "MAX_STEPS", 250), mock.patch.object(health_model, "MIN_GAIN_PRESSES", TRAINED):
        return health_model.fit_health_model(
            readings[:end],
            pad.rate_hz,
            pad.down_command[:presses],
            pad.up_command[:presses],
            rng=np.random.default_rng(0),
            provenance={},
        )


def part_of(pad: Recording, first: int, stop: int, end: int, readings: Array | None = None) -> Recording:
    """Presses first .. stop - 1 with the readings from the release before them to `end`."""
    start = int(pad.up_command[first - 1]) if first else 0
    readings = pad.readings if readings is None else readings
    commands = pad.down_command[first:stop] - start, pad.up_command[first:stop] - start
    return Recording(readings[start:end], pad.times_s[start:end], pad.presses_mm[first:stop], *commands)


def detect(model: HealthModel, recording: Recording) -> list[FibreFault]:
    detector = FaultDetector()
    detector.model_ = model
    return detector.predict(recording)


def detect_later(model: HealthModel, readings: Array, pad: Recording, first: int = TRAINED) -> list[FibreFault]:
    """Faults in the presses that the model was not trained on; press 0 is the first of them."""
    return detect(model, part_of(pad, first, len(pad.down_command), len(readings), readings))


Fault = Callable[[Array, Array, np.random.Generator], Array]
FAULTS: dict[str, Fault] = {
    "stuck": lambda values, before, rng: np.full_like(values, values[0]),
    "open": lambda values, before, rng: np.zeros_like(values),
    "floating": lambda values, before, rng: rng.uniform(0, 3.3, len(values)),
    "noisy": lambda values, before, rng: values + 0.016 * rng.standard_normal(len(values)),
    "offset": lambda values, before, rng: values + 0.1,
    "drifting": lambda values, before, rng: values - 5e-5 * np.arange(len(values)),
    "reduced_gain": lambda values, before, rng: (values + np.median(before)) / 2,
    "inverted": lambda values, before, rng: 2 * np.median(before) - values,
}
"""Readings of a faulty fibre 1, from its own and those before; "swapped" is with fibre 4."""


def plant(pad: Recording, fault: str, press: int = BAD_FROM, readings: Array | None = None) -> Array:
    """Readings in which a fibre fails from a press on."""
    readings = (pad.readings if readings is None else readings).copy()
    start = int(pad.down_command[press])
    if fault == "swapped":
        readings[start:, [1, 4]] = readings[start:, [4, 1]]
    else:
        before = readings[start - 400 : start, 1]
        readings[start:, 1] = FAULTS[fault](readings[start:, 1], before, np.random.default_rng(2))
    return readings


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
