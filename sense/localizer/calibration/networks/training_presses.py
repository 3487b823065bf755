"""Presses as trainings take them."""

from dataclasses import dataclass, replace

import numpy as np

from padforge.sense.localizer.response.response_model import leverages, looked_up
from padforge.sense.recordings.processing.limits import Floats, Mask


@dataclass(frozen=True)
class TrainingPresses:
    """Presses to learn from or to check on.

    Attributes:
        inputs: (Q, C, F) scaled. alive: (Q, C).
        targets: (Q, 2 + T) what the network is to give. stretch: see `Normalization`.
    """

    inputs: Floats
    alive: Mask
    targets: Floats
    stretch: float = 0.0


MOST_LEVERAGE = 0.9
"""Of a press far from all others; what it leaves is made ten times as much at most."""


def as_unseen(presses: TrainingPresses, table: Floats) -> TrainingPresses:
    """Presses as far from a table (S, S, C, F) of expected inputs as if it had been fitted without each of them.

    Of a linear fit, what a press leaves when it is left out is what it leaves now, divided by 1 - its leverage: of a
    few hundred presses, a third more. It takes all presses of a place as one.
    """
    targets = presses.targets.astype(np.float64)
    places, strengths = targets[:, :2], np.ones(len(targets))
    if presses.stretch:
        strengths += presses.stretch * targets[:, 2]
    expected = looked_up(table.reshape(*table.shape[:2], -1), places).reshape(presses.inputs.shape)
    expected = strengths[:, None, None] * expected
    share = np.minimum(leverages(places, strengths), MOST_LEVERAGE)[:, None, None]
    rest = (presses.inputs - expected) / np.where(table.any(axis=(0, 1)), 1 - share, 1.0)
    return replace(presses, inputs=(expected + rest).astype(np.float32))
