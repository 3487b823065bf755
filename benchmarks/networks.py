"""Run time of training the networks of a study as a batch, beside plain Levenberg-Marquardt one after another."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.common.parallel import one_thread
from padforge.design.contact import signals
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.published.networks import (
    TRAINING_SHARE,
    VALIDATION_SHARE,
    FailureSet,
    Network,
    RangeScaler,
    SimulatedPresses,
    initial_weights,
)
from padforge.design.settings import PUBLISHED_CONTACT

HIDDEN = 50
EPOCHS = 1000
PATIENCE = 6  # steps without improvement on the validation samples before training stops
FAILED = 2  # failed fibres of each network
SETS = 14  # sets of failed fibres, whose networks are trained as one batch
MAX_DAMPING = 1e10


def trials() -> Iterator[BenchTrial]:
    """Yield the networks for SETS sets of failed fibres of two 4 x 4 pads by both ways.

    Both ways train on the same samples and are tested on the same fresh presses; the plain way uses as many threads as
    NumPy does.
    """
    with one_thread():
        for case, pad in (("square", Morphology.straight(4)), ("random N=5", Morphology.random(4, 5, seed=1))):
            presses = SimulatedPresses.simulate(pad, 32, 2000, 0, partial(signals, pad, contact=PUBLISHED_CONTACT))
            failures = failure_subsets(len(pad.knots), FAILED, SETS)
            batched, plain = partial(presses.fit, failures, HIDDEN), partial(_fit_all_plain, presses, failures)
            for way, work in (("batched", batched), ("plain numpy", plain)):
                yield BenchTrial(case, way, 0, work, partial(_evaluate, presses, failures), items=SETS)


def _evaluate(
    presses: SimulatedPresses, failures: Sequence[FailureSet], networks: Sequence[Network]
) -> Mapping[str, float]:
    errors = [presses.test_errors(network, failed).mean() for network, failed in zip(networks, failures, strict=True)]
    return {"error": float(np.mean(errors))}


def _fit_all_plain(presses: SimulatedPresses, failures: Sequence[FailureSet]) -> list[Network]:
    networks = []
    for failed in failures:
        inputs = np.delete(presses.train_signals, list(failed), axis=1)
        networks.append(fit_plain(inputs, presses.train_positions, np.random.default_rng([2, 0, len(failed), *failed])))
    return networks


def fit_plain(inputs: Array, targets: Array, rng: np.random.Generator) -> Network:
    """Fit the published network by textbook Levenberg-Marquardt: full Jacobian, all weights at once."""
    input_scale, target_scale = RangeScaler.fit(inputs), RangeScaler.fit(targets)
    order = rng.permutation(len(inputs))
    n_train = round(TRAINING_SHARE * len(inputs))
    train, validation = order[:n_train], order[n_train : n_train + round(VALIDATION_SHARE * len(inputs))]
    x, y = np.column_stack([input_scale.transform(inputs), np.ones(len(inputs))]), target_scale.transform(targets)
    outputs, n_hidden_weights = y.shape[1], HIDDEN * x.shape[1]
    first = initial_weights(input_scale.half > 0, HIDDEN, rng)
    weights = np.concatenate([first.ravel(), rng.uniform(-0.5, 0.5, outputs * (HIDDEN + 1))])

    def split(weights: Array) -> tuple[Array, Array]:
        return weights[:n_hidden_weights].reshape(HIDDEN, -1), weights[n_hidden_weights:].reshape(outputs, HIDDEN + 1)

    def forward(weights: Array, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the neurons, with a column of ones, and the residuals."""
        hidden, output = split(weights)
        neurons = np.column_stack([np.tanh(x[rows] @ hidden.T), np.ones(len(rows))])
        return neurons, neurons @ output.T - y[rows]

    neurons, residual = forward(weights, train)
    best, best_loss = weights, (forward(weights, validation)[1] ** 2).sum()
    steps, n_failures, damping = 0, 0, 1e-3
    while steps < EPOCHS and n_failures < PATIENCE:
        jacobian = _jacobian(x[train], neurons, split(weights)[1])
        hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residual.ravel()
        while damping <= MAX_DAMPING:  # until a step reduces the training loss
            candidate = weights - np.linalg.solve(hessian + damping * np.eye(len(weights)), gradient)
            new_neurons, new_residual = forward(candidate, train)
            if (new_residual**2).sum() < (residual**2).sum():
                break
            damping *= 10
        else:
            break
        weights, neurons, residual, damping, steps = candidate, new_neurons, new_residual, damping / 10, steps + 1
        loss = (forward(weights, validation)[1] ** 2).sum()
        if loss < best_loss:
            best, best_loss, n_failures = weights, loss, 0
        else:
            n_failures += 1
    return Network(*split(best), input_scale, target_scale, steps)


def _jacobian(x: Array, neurons: Array, output: Array) -> Array:
    """Return the derivatives of the outputs by all weights; shape (Q outputs, weights)."""
    samples, outputs = len(x), len(output)
    slope = 1 - neurons[:, :-1] ** 2
    hidden = [((slope * row[:-1])[:, :, None] * x[:, None, :]).reshape(samples, -1) for row in output]
    linear = [np.kron(row, neurons) for row in np.eye(outputs)]
    blocks = [np.hstack(pair) for pair in zip(hidden, linear, strict=True)]
    return np.stack(blocks, axis=1).reshape(samples * outputs, -1)


BENCH = Bench(
    "networks",
    trials,
    "mean error (grid units)",
    reference=("plain numpy", 0),
    default=("batched", 0),
    baselines=("plain numpy",),
)
