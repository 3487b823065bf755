"""The networks of a robustness study: trained as batches, beside one after another by plain Levenberg-Marquardt."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from padforge.benchmarks import harness
from padforge.design.common.parallel import one_torch_thread
from padforge.design.contact import signals
from padforge.design.morphology import Array, Morphology
from padforge.design.networks import (
    TRAINING_SHARE,
    VALIDATION_SHARE,
    FailureSet,
    Network,
    RangeScaler,
    SimulatedPresses,
    initial_weights,
)
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.settings import PUBLISHED_CONTACT

HIDDEN = 50
EPOCHS = 1000
FAILURES = 6
LOST, SETS = 2, 14
"""Fibres lost at once, and how many sets of them: as many networks as are trained as one batch."""


def trials() -> Iterator[harness.BenchTrial]:
    """Networks for SETS of lost fibres of two 4 x 4 pads, the square grid and a random one, both ways.

    The plain way makes the whole Jacobian and solves for all weights, as textbooks have it, on as many threads as NumPy
    takes; both ways learn from the same samples, and are tested on the same fresh presses.
    """
    with one_torch_thread():
        for case, pad in (("square", Morphology.straight(4)), ("random N=5", Morphology.random(4, 5, seed=1))):
            trial = SimulatedPresses.simulate(pad, 32, 2000, 0, partial(signals, pad, contact=PUBLISHED_CONTACT))
            losses = failure_subsets(len(pad.knots), LOST, SETS)
            judge = partial(_judge, trial, losses)
            yield harness.BenchTrial(case, "batched", 0, partial(trial.fit, losses, HIDDEN), judge, items=SETS)
            yield harness.BenchTrial(case, "plain numpy", 0, partial(_learn_plain, trial, losses), judge, items=SETS)


def _judge(trial: SimulatedPresses, losses: Sequence[FailureSet], networks: Sequence[Network]) -> Mapping[str, float]:
    errors = [trial.test_errors(network, loss).mean() for network, loss in zip(networks, losses, strict=True)]
    return {"error": float(np.mean(errors))}


def _learn_plain(trial: SimulatedPresses, losses: Sequence[FailureSet]) -> list[Network]:
    kept = [np.setdiff1d(np.arange(trial.train_signals.shape[1]), loss) for loss in losses]
    rngs = [np.random.default_rng([2, 0, len(loss), *loss]) for loss in losses]
    return [
        fit_plain(trial.train_signals[:, left], trial.train_positions, rng)
        for left, rng in zip(kept, rngs, strict=True)
    ]


def fit_plain(inputs: Array, targets: Array, rng: np.random.Generator) -> Network:
    """`levenberg_marquardt.fit` as textbooks have it: whole Jacobian, all weights at once, damping in tens."""
    into, onto = RangeScaler.fit(inputs), RangeScaler.fit(targets)
    order = rng.permutation(len(inputs))
    learnt = round(TRAINING_SHARE * len(inputs))
    learn, held = order[:learnt], order[learnt : learnt + round(VALIDATION_SHARE * len(inputs))]
    x, y = np.column_stack([into.transform(inputs), np.ones(len(inputs))]), onto.transform(targets)
    outputs, inner = y.shape[1], HIDDEN * x.shape[1]
    first = initial_weights(into.half > 0, HIDDEN, rng)
    weights = np.concatenate([first.ravel(), rng.uniform(-0.5, 0.5, outputs * (HIDDEN + 1))])

    def parts(weights: Array) -> tuple[Array, Array]:
        return weights[:inner].reshape(HIDDEN, -1), weights[inner:].reshape(outputs, HIDDEN + 1)

    def found(weights: Array, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        hidden, output = parts(weights)
        neurons = np.column_stack([np.tanh(x[rows] @ hidden.T), np.ones(len(rows))])
        return neurons, neurons @ output.T - y[rows]

    neurons, error = found(weights, learn)
    best, least, failures, damping = weights, (found(weights, held)[1] ** 2).sum(), 0, 1e-3
    steps = 0
    while steps < EPOCHS and failures < FAILURES:
        jacobian = _jacobian(x[learn], neurons, parts(weights)[1])
        curvature, slope = jacobian.T @ jacobian, jacobian.T @ error.ravel()
        while damping <= 1e10:
            candidate = weights - np.linalg.solve(curvature + damping * np.eye(len(weights)), slope)
            moved = found(candidate, learn)
            if (moved[1] ** 2).sum() < (error**2).sum():
                break
            damping *= 10
        else:
            break
        weights, (neurons, error), damping, steps = candidate, moved, damping / 10, steps + 1
        checked = (found(weights, held)[1] ** 2).sum()
        if checked < least:
            best, least, failures = weights, checked, 0
        else:
            failures += 1
    hidden, output = parts(best)
    return Network(hidden, output, into, onto, steps)


def _jacobian(x: Array, neurons: Array, output: Array) -> Array:
    """(Q O, P) derivatives of the outputs by all weights."""
    samples, outputs = len(x), len(output)
    bent = 1 - neurons[:, :-1] ** 2
    inner = [((bent * own[:-1])[:, :, None] * x[:, None, :]).reshape(samples, -1) for own in output]
    outer = [np.kron(np.eye(outputs)[k], neurons) for k in range(outputs)]
    return np.stack([np.hstack(pair) for pair in zip(inner, outer, strict=True)], axis=1).reshape(samples * outputs, -1)


BENCH = harness.Bench(
    "networks", trials, "mean error (grid units)", ("plain numpy", 0), ("batched", 0), plain=("plain numpy",)
)
