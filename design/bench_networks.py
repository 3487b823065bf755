"""The networks of a robustness study: trained as batches, beside one after another by plain Levenberg-Marquardt."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bench_table import Row, write_bench
from .evaluation import Loss, Trial, evaluate
from .levenberg_marquardt import LEARN, VALIDATE, Network, Scale, first_weights
from .losses import lost_subsets
from .morphology import Morphology

Array = NDArray[np.float64]

HIDDEN = 50
EPOCHS = 1000
FAILURES = 6
LEVELS = (0, 1, 2, 3)
PLAIN, BATCHED = "plain numpy", "batched"


def bench_networks(out: Path, report: Callable[[str], None]) -> dict[str, Any]:
    """All 93 networks of a 4 x 4 pad that may lose up to three fibres, both ways; files in `out`.

    The pads are the square grid and a random one. The plain way makes the whole Jacobian and solves for all weights, as
    textbooks have it, on as many threads as NumPy takes; both ways learn from the same samples, and are tested on the
    same fresh presses.
    """
    rows = []
    report("networks, before the clock")
    evaluate(Morphology.straight(4), lost=(0,), presses=64, test=10, hidden=5)
    for case, pad in (("square", Morphology.straight(4)), ("random N=5", Morphology.random(4, 5, seed=1))):
        report(f"networks, {case}, {BATCHED}")
        begin = time.perf_counter()
        levels = evaluate(pad, lost=LEVELS, hidden=HIDDEN)
        seconds = time.perf_counter() - begin
        networks = sum(level.subsets for level in levels)
        error = sum(level.mean * level.subsets for level in levels) / networks
        rows.append(Row(case, BATCHED, networks, error, seconds, None))
        rows.append(_plain(case, pad, report))
    return write_bench("networks", rows, out, "mean error (grid units)", reference=(PLAIN, rows[0].size))


def _plain(case: str, pad: Morphology, report: Callable[[str], None]) -> Row:
    from .contact import signals

    losses: list[Loss] = [loss for level in LEVELS for loss in lost_subsets(2 * pad.grid, level)]
    begin = time.perf_counter()
    trial = Trial.of(pad, 32, 2000, 0, lambda places: signals(pad, places))
    errors = []
    for number, loss in enumerate(losses):
        report(f"networks, {case}, {PLAIN} {number + 1} of {len(losses)}")
        kept = np.setdiff1d(np.arange(2 * pad.grid), loss)
        network = fit_plain(trial.recorded[:, kept], trial.learned, np.random.default_rng([2, 0, len(loss), *loss]))
        errors.append(trial.errors(network, loss).mean())
    return Row(case, PLAIN, len(losses), float(np.mean(errors)), time.perf_counter() - begin, None)


def fit_plain(inputs: Array, targets: Array, rng: np.random.Generator) -> Network:
    """`levenberg_marquardt.fit` as textbooks have it: whole Jacobian, all weights at once, damping in tens."""
    into, onto = Scale.of(inputs), Scale.of(targets)
    order = rng.permutation(len(inputs))
    learnt = round(LEARN * len(inputs))
    learn, held = order[:learnt], order[learnt : learnt + round(VALIDATE * len(inputs))]
    x, y = np.column_stack([into.there(inputs), np.ones(len(inputs))]), onto.there(targets)
    outputs, inner = y.shape[1], HIDDEN * x.shape[1]
    first = first_weights(into.half > 0, HIDDEN, rng)
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
