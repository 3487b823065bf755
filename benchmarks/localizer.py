"""Test error of localizers against training time on a simulated recording, for two sets of features of whole presses.

The published network is trained by Levenberg-Marquardt, as published, by L-BFGS and by Adam. Masked networks, which
also serve failed fibres and, with windows as features, any moment, are trained as in a calibration. All are trained on
the same presses.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
import torch

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.common.parallel import one_thread
from padforge.common.progress import ignore_progress
from padforge.design import Morphology
from padforge.design.published.networks import fit_batch, initial_weights
from padforge.sense import settings
from padforge.sense.arrays import Array, Floats
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.network import predict
from padforge.sense.localizer.scaler import FeatureScaler, ScaledFeatures, TrainingPresses
from padforge.sense.localizer.training import MIN_BATCHES, train_members
from padforge.sense.localizer.training import PUBLISHED_HIDDEN as HIDDEN
from padforge.sense.recording.recording import Recording
from padforge.sense.simulation.simulated_recording import simulate

PRESSES = 1500  # of the recording
TEST = 300  # the last ones, which are tested on
EPOCHS = (3, 10, 30, 100)  # maximum steps of Levenberg-Marquardt; each uses all presses
ITERATIONS = (30, 100, 300)  # iterations of L-BFGS; each uses all presses
PASSES = (30, 100, 300)  # passes of Adam through batches of BATCH presses
STEPS = (50, 200, 800, 3200)  # training steps of a masked network for a phase of relative length 1
FEATURES = ("published", "windows")
MARQUARDT = ("published",)
"""Features that Levenberg-Marquardt is run on: with F times as many, a step takes F^2 to F^3 times as long."""
BATCH = 128  # presses in a step of Adam
ADAM_RATE = 3e-3  # learning rate of Adam
Predict = Callable[[Array], Array]


def trials() -> Iterator[BenchTrial]:
    """Yield trainings by all ways, and the prediction of one press."""
    with one_thread():
        for features in FEATURES:
            yield from _trainings(features)
        # the time of a prediction does not depend on the training
        press = _flat(_scaled(FEATURES[0])[2])[:1]
        rng = np.random.default_rng(0)
        published = _PublishedNetwork(rng.standard_normal((10, press.size)), rng.standard_normal((10, 2)))
        yield BenchTrial("one press", "published", 0, partial(published, press))
        _, table, presses, _ = _scaled(FEATURES[-1])
        masked = _train_masked(presses, table, 1)
        press = _flat(presses)[:1]
        yield BenchTrial("one press", "ensemble", 0, partial(masked, press))


@cache
def recorded() -> Recording:
    """Simulate the recording."""
    return simulate(Morphology.random(3, knots=5, seed=0), settings.RigSettings(presses=PRESSES, seed=0))


def _trainings(features: str) -> Iterator[BenchTrial]:
    scaling, table, presses, test = _scaled(features)
    x, y = _flat(presses), presses.targets.astype(np.float64)

    def evaluate(predict: Predict) -> Mapping[str, float]:
        error_mm = scaling.positions_mm(predict(_flat(test)).astype(np.float32)) - recorded().presses_mm[-TEST:]
        return {"error": float(np.hypot(*error_mm.T).mean())}

    ways: dict[str, tuple[tuple[int, ...], Callable[[int], Predict]]] = {
        "LM": (EPOCHS if features in MARQUARDT else (), partial(_train_marquardt, x, y)),
        "L-BFGS": (ITERATIONS, partial(_train_lbfgs, x, y)),
        "Adam": (PASSES, partial(_train_adam, x, y)),
        "ensemble": (STEPS, partial(_train_masked, presses, table)),
    }
    for way, (sizes, train) in ways.items():
        for size in sizes:
            yield BenchTrial(features, way, size, partial(train, size), evaluate)


def _scaled(features: str) -> tuple[FeatureScaler, Floats, TrainingPresses, ScaledFeatures]:
    """Return the scaling and the table of the training presses, these presses, and those of the test."""
    recording, is_published = recorded(), features == "published"
    commands = recording.down_command, recording.up_command
    raw = compute_features(recording.readings, *commands, is_published=is_published)
    training = raw[:-TEST], recording.presses_mm[:-TEST]
    scaling, table = FeatureScaler.fit(*training)
    presses = scaling.training_presses(*training, rate_hz=recording.rate_hz)
    return scaling, table, presses, scaling.transform(raw[-TEST:])


def _flat(presses: ScaledFeatures) -> Array:
    return presses.inputs.reshape(len(presses), -1).astype(np.float64)


class _PublishedNetwork:
    """The published network with its squared error, for optimisers that use gradients."""

    def __init__(self, x: Array, y: Array) -> None:
        rng = np.random.default_rng(0)
        weights = initial_weights(np.ptp(x, axis=0) > 0, HIDDEN, rng), rng.uniform(-0.5, 0.5, (y.shape[1], HIDDEN + 1))
        self.weights = [torch.from_numpy(matrix).requires_grad_() for matrix in weights]
        self._x, self._y = torch.from_numpy(np.column_stack([x, np.ones(len(x))])), torch.from_numpy(y)

    def backward(self, rows: Any = slice(None)) -> Any:
        """Return the mean squared error of some presses, with its gradient in the weights."""
        hidden, output = self.weights
        hidden.grad = output.grad = None
        neurons = (self._x[rows] @ hidden.T).tanh()
        loss = (neurons @ output[:, :-1].T + output[:, -1] - self._y[rows]).square().mean()
        loss.backward()
        return loss

    def __call__(self, x: Array) -> Array:
        hidden, output = (weight.detach().numpy() for weight in self.weights)
        return np.tanh(x @ hidden[:, :-1].T + hidden[:, -1]) @ output[:, :-1].T + output[:, -1]


def _train_marquardt(x: Array, y: Array, epochs: int) -> Predict:
    held_out = np.arange(len(x)) % 12 == 0
    validation = x[held_out][None], y[held_out]
    return fit_batch(x[~held_out], y[~held_out], [np.random.default_rng(0)], HIDDEN, epochs, validation)[0]


def _train_lbfgs(x: Array, y: Array, iterations: int) -> Predict:
    network = _PublishedNetwork(x, y)
    torch.optim.LBFGS(
        network.weights, max_iter=iterations, tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe"
    ).step(network.backward)
    return network


def _train_adam(x: Array, y: Array, passes: int) -> Predict:
    network, generator = _PublishedNetwork(x, y), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(network.weights, lr=ADAM_RATE)
    for _ in range(passes):
        for rows in torch.randperm(len(x), generator=generator).split(BATCH):
            network.backward(rows)
            optimizer.step()
    return network


def _train_masked(presses: TrainingPresses, table: Floats, steps: int) -> Predict:
    batches = max(MIN_BATCHES, len(presses) // settings.LocalizerSettings().batch)
    options = settings.LocalizerSettings(epochs=-(-steps // batches))
    trained = train_members(presses, table, options, np.random.default_rng(0), ignore_progress)

    def positions(x: Array) -> Array:
        features = x.reshape(len(x), *presses.inputs.shape[1:]).astype(np.float32)
        masks = (np.ones((len(x), each.shape[1]), bool) for each in (presses.fibre_mask, presses.complete))
        new = ScaledFeatures(features, *masks)
        return predict(trained.networks, new, trained.bayes, trained.residual_network)[0].astype(np.float64)

    return positions


BENCH = Bench(
    "localizer",
    trials,
    "mean error (mm)",
    reference=("LM", EPOCHS[-1]),
    default=("ensemble", STEPS[1]),
    baselines=("published", "L-BFGS", "Adam"),
    prepare=lambda: [train(np.zeros((4, 1)), np.zeros((4, 2)), 1) for train in (_train_lbfgs, _train_adam)],
)
