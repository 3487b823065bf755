"""The published localizer as a preset: 50 tanh neurons trained by Levenberg-Marquardt.

It knows no lost fibres; the published way is to train another network for every set of them (`fibre_loss_study`). Set
torch to one thread: see `padforge.design.networks`.
"""

import numpy as np

from padforge.design.networks import fit_batch
from padforge.sense.localizer.network import Weights

from padforge.sense.localizer.calibration.networks.training_presses import TrainingPresses

HIDDEN = 50
"""Neurons of the experiment's network."""


def train_published(learn: TrainingPresses, check: TrainingPresses, rng: np.random.Generator) -> Weights:
    """Fit the published network.

    Args:
        learn, check: presses to learn from, and to tell by when to stop.
        rng: source of the first weights.

    Returns:
        Weights as `network.forward` takes them, the scales of the published network folded in.
    """
    x, y, *checks = (_flat(part) for part in (learn.inputs, learn.targets, check.inputs, check.targets))
    network = fit_batch(x[None], y, [rng], HIDDEN, validation=(checks[0][None], checks[1]))[0]
    into, onto = network.inputs, network.targets
    plain = network.hidden[:, :-1]
    slope = np.divide(plain, into.half, out=np.zeros_like(plain), where=into.half > 0)
    weights = {
        "first.w": slope.T,
        "first.b": (network.hidden[:, -1] - slope @ into.middle)[None],
        "last.w": (onto.half[:, None] * network.output[:, :-1]).T,
        "last.b": (onto.middle + onto.half * network.output[:, -1])[None],
    }
    return {name: np.ascontiguousarray(weight[None], dtype=np.float32) for name, weight in weights.items()}


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1).astype(np.float64)
