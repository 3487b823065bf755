"""Recordings of other values, and presses to train on, made of arrays."""

from dataclasses import replace
from typing import Any

import numpy as np

from padforge.sense import Recording
from padforge.sense.localizer.moments import LATEST_WINDOWS, PRESS_WINDOWS
from padforge.sense.localizer.scaler import TrainingPresses


def changed(recording: Recording, name: str, where: Any, value: Any) -> Recording:
    """The recording with another value, or values, somewhere in one of its arrays."""
    array = np.array(getattr(recording, name))
    array[where] = value
    return replace(recording, **{name: array})


def training_presses(
    inputs: np.ndarray, fibre_mask: np.ndarray, targets: np.ndarray, n_timed: int = 0, speed: float = 0.0
) -> TrainingPresses:
    """Presses whose first windows are complete one after the other, and whose windows of now need no rescaling.

    Args:
        inputs: (Q, C, F) scaled features.
        fibre_mask: (Q, C).
        targets: (Q, 2) scaled positions.
        n_timed: K; 0 for features that know no moment.
        speed: scaled distance that 1 mm/s goes from one reading to the next; the scale is 20 mm.
    """
    factor = np.ones((inputs.shape[1], len(LATEST_WINDOWS), len(PRESS_WINDOWS) if n_timed else 0), np.float32)
    return TrainingPresses(
        inputs.astype(np.float32),
        fibre_mask,
        np.ones((len(inputs), n_timed), dtype=bool),
        targets.astype(np.float32),
        depth_gain=0.0,
        latest_factor=factor,
        latest_offset=np.zeros_like(factor),
        per_mm=1 / 20,
        speed=speed,
    )
