"""Test error of localizers against the time they train, on a simulated recording, for two kinds of inputs.

The published network is trained three ways, by budgets: Levenberg-Marquardt, as published; L-BFGS; and Adam. The masked
network, which bears lost fibres as well, is trained as in a calibration. All learn from the same presses.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design import Morphology
from padforge.design.common.parallel import one_torch_thread
from padforge.sense import settings
from padforge.sense.localizer.calibration.networks.published_training import HIDDEN
from padforge.sense.localizer.features import press_inputs
from padforge.sense.localizer.network import learnt, pooled
from padforge.sense.localizer.normalization import Normalization
from padforge.sense.recordings.processing.limits import Array, Floats, Mask
from padforge.sense.recordings.recording import Recording
from padforge.sense.recordings.simulation.published_protocol import simulate

PRESSES, TEST = 1500, 300
EPOCHS = (3, 10, 30, 100)
"""Steps of Levenberg-Marquardt at most; it looks at all presses in each."""
ITERATIONS = (30, 100, 300)
"""Of L-BFGS, which does likewise."""
PASSES = (30, 100, 300)
"""Of Adam, through batches of BATCH presses."""
STEPS = (50, 200, 800, 3200)
"""Of the masked network of its usual size and, beside it, of the one that corrects the observer."""
FEATURES = ("published", "full")
MARQUARDT = ("published",)
"""Inputs that Levenberg-Marquardt is tried on: with F times as many, each of its steps takes F^2 to F^3 as long."""
BATCH, ADAM_RATE = 128, 3e-3

Predict = Callable[[Array], Array]


def trials() -> Iterator[BenchTrial]:
    """Trainings on PRESSES simulated presses less TEST, in every way, and the time to find one press."""
    with one_torch_thread():
        for features in FEATURES:
            yield from _trainings(features)
        yield from _predictions()


@cache
def recorded() -> Recording:
    return simulate(Morphology.random(3, knots=5, seed=0), settings.RigSettings(presses=PRESSES, seed=0))


def _trainings(features: str) -> Iterator[BenchTrial]:
    scaling, table, inputs, targets = _scaled(features)
    places_mm = recorded().presses_mm[-TEST:]
    flat = inputs.reshape(len(inputs), -1).astype(np.float64)
    x, y = flat[:-TEST], targets[:-TEST].astype(np.float64)

    def judge(predict: Predict) -> Mapping[str, float]:
        off = scaling.places_mm(predict(flat[-TEST:]).astype(np.float32)) - places_mm
        return {"error": float(np.hypot(*off.T).mean())}

    ways: dict[str, tuple[tuple[int, ...], Callable[[int], Predict]]] = {
        "LM": (EPOCHS if features in MARQUARDT else (), partial(_marquardt, x, y)),
        "L-BFGS": (ITERATIONS, partial(_bfgs, x, y)),
        "Adam": (PASSES, partial(_adam, x, y)),
        "masked": (STEPS, partial(_masked, inputs[:-TEST], targets[:-TEST], table)),
    }
    for way, (sizes, train) in ways.items():
        for size in sizes:
            yield BenchTrial(features, way, size, partial(train, size), judge)


def _held(presses: int) -> Mask:
    """(Q,) presses that end a training, where it looks at some, and are not learnt from."""
    return np.arange(presses) % 12 == 0


def _marquardt(x: Array, y: Array, epochs: int) -> Predict:
    from padforge.design.networks import fit

    held = _held(len(x))
    return fit(x[~held], y[~held], np.random.default_rng(0), HIDDEN, epochs, check=(x[held], y[held]))


class _Published:
    """The published network with its squared error, for optimisers that are given slopes."""

    def __init__(self, x: Array, y: Array) -> None:
        import torch

        from padforge.design.networks import initial_weights

        rng = np.random.default_rng(0)
        weights = initial_weights(np.ptp(x, axis=0) > 0, HIDDEN, rng), rng.uniform(-0.5, 0.5, (y.shape[1], HIDDEN + 1))
        self.weights = [torch.from_numpy(part).requires_grad_() for part in weights]
        self._x, self._y = torch.from_numpy(np.column_stack([x, np.ones(len(x))])), torch.from_numpy(y)

    def slope(self, rows: Any = slice(None)) -> Any:
        """The mean squared error of some presses; leaves its slope in the weights."""
        hidden, output = self.weights
        hidden.grad = output.grad = None
        neurons = (self._x[rows] @ hidden.T).tanh()
        loss = (neurons @ output[:, :-1].T + output[:, -1] - self._y[rows]).square().mean()
        loss.backward()
        return loss

    def __call__(self, x: Array) -> Array:
        hidden, output = (weight.detach().numpy() for weight in self.weights)
        return np.tanh(x @ hidden[:, :-1].T + hidden[:, -1]) @ output[:, :-1].T + output[:, -1]


def _bfgs(x: Array, y: Array, iterations: int) -> Predict:
    import torch

    network = _Published(x, y)
    torch.optim.LBFGS(
        network.weights, max_iter=iterations, tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe"
    ).step(network.slope)
    return network


def _adam(x: Array, y: Array, passes: int) -> Predict:
    import torch

    network, generator = _Published(x, y), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(network.weights, lr=ADAM_RATE)
    for _ in range(passes):
        for rows in torch.randperm(len(x), generator=generator).split(BATCH):
            network.slope(rows)
            optimizer.step()
    return network


def _masked(inputs: Floats, targets: Floats, table: Floats, steps: int) -> Predict:
    from padforge.sense.localizer.calibration.networks.training_presses import TrainingPresses
    from padforge.sense.localizer.calibration.training import LEAST_BATCHES, train_members

    shown = TrainingPresses(inputs, np.ones(inputs.shape[:2], dtype=bool), targets)
    batches = max(LEAST_BATCHES, len(inputs) // settings.LocalizerSettings().batch)
    options = settings.LocalizerSettings(epochs=-(-steps // batches))
    trained = train_members(shown, table, options, np.random.default_rng(0), lambda done, total: None)

    def predict(x: Array) -> Array:
        presses = x.reshape(len(x), *inputs.shape[1:]).astype(np.float32)
        every = np.ones(presses.shape[:2], dtype=bool)
        found = learnt(trained.weights, presses, every, observer=trained.observer, corrector=trained.corrector)
        return pooled(found)[0].astype(np.float64)

    return predict


def _predictions() -> Iterator[BenchTrial]:
    """Finding one press after hardly any training: what was learnt does not matter for the time it takes."""
    one = _scaled("published")[2][:1].reshape(1, -1).astype(np.float64)
    rng = np.random.default_rng(0)
    published = _Published(rng.standard_normal((10, one.size)), rng.standard_normal((10, 2)))
    yield BenchTrial("one press", "published", 0, partial(published, one))
    _, table, inputs, targets = _scaled("full")
    masked = _masked(inputs[:-TEST], targets[:-TEST], table, 1)
    yield BenchTrial("one press", "masked", 0, partial(masked, inputs[:1].reshape(1, -1).astype(np.float64)))


def _scaled(features: str) -> tuple[Normalization, Floats, Floats, Floats]:
    """Scaling and table of the presses to learn from, and inputs and targets of all."""
    recording = recorded()
    raw = press_inputs(recording.readings, recording.begun, recording.lifted, features)
    scaling, table = Normalization.fit(raw[:-TEST], recording.presses_mm[:-TEST])
    return scaling, table, scaling.inputs(raw).inputs, scaling.targets(recording.presses_mm)


BENCH = Bench(
    "localizer",
    trials,
    "mean error (mm)",
    ("LM", EPOCHS[-1]),
    ("masked", STEPS[1]),
    plain=("published", "L-BFGS", "Adam"),
    prepare=lambda: [train(np.zeros((4, 1)), np.zeros((4, 2)), 1) for train in (_bfgs, _adam)],
)
