"""Presses as trainings take them."""

from dataclasses import dataclass

from sense.recordings.processing.limits import Floats, Mask


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
