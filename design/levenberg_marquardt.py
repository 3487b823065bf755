"""The published localizer: one hidden layer of tanh neurons, trained by Levenberg-Marquardt (paper, evaluation).

The training follows what the authors ran: damped Gauss-Newton steps (Hagan & Menhaj 1994, Training feedforward networks
with the Marquardt algorithm) from spread-out neurons (Nguyen & Widrow 1990, Improving the learning speed of 2-layer
neural networks), ended by presses held back for validation.

Torch does the algebra on as many threads as it is set to. Set it to one: the matrices are too small to gain from more,
and where another program has a core, threads that wait for each other take many times as long.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from .errors import InputError

Array = NDArray[np.float64]

EPOCHS = 1000
FAILURES = 6  # epochs in a row without a new best on validation that end the training
LEARN, VALIDATE = 0.7, 0.15  # shares of the samples; the rest is the test set of the published split
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-20, 1e10
LEAST_SLOPE = 1e-7
BLOCK = 64  # columns of a symmetric product made at once


@dataclass(frozen=True)
class Scale:
    """Columns to [-1, 1] and back; a column that never varied becomes 0, which no weight can act on.

    Attributes:
        middle, half: (D,) middle and half width of each column's range.
    """

    middle: Array
    half: Array

    @classmethod
    def of(cls, values: Array) -> "Scale":
        """The scale on which `values` (Q, D) fill [-1, 1]."""
        low, high = values.min(axis=0), values.max(axis=0)
        return cls((low + high) / 2, (high - low) / 2)

    def there(self, values: Array) -> Array:
        """(Q, D) scaled."""
        return np.divide(values - self.middle, self.half, out=np.zeros(values.shape), where=self.half > 0)

    def back(self, scaled: Array) -> Array:
        """(Q, D) in the units they came in."""
        return self.middle + self.half * scaled


@dataclass(frozen=True)
class Network:
    """A trained network: `network(inputs)` (Q, D) gives outputs (Q, O).

    Attributes:
        hidden: (H, D+1) weights of the neurons on scaled inputs, the last column their biases.
        output: (O, H+1) weights of the scaled outputs on the neurons, the last column their biases.
        inputs, targets: scales of the two sides.
        epochs: how long it was trained.
    """

    hidden: Array
    output: Array
    inputs: Scale
    targets: Scale
    epochs: int

    def __call__(self, inputs: ArrayLike) -> Array:
        scaled = self.inputs.there(np.asarray(inputs, dtype=np.float64))
        neurons = np.tanh(scaled @ self.hidden[:, :-1].T + self.hidden[:, -1])
        return self.targets.back(neurons @ self.output[:, :-1].T + self.output[:, -1])


def fit(
    inputs: Array,
    targets: Array,
    rng: np.random.Generator,
    hidden: int = 50,
    epochs: int = EPOCHS,
    check: tuple[Array, Array] | None = None,
) -> Network:
    """Train a network on samples: 70 % to learn from, 15 % for validation, 15 % left aside, drawn at random.

    Args:
        inputs: (Q, D), targets: (Q, O), finite.
        rng: source of the split and of the first weights.
        hidden: neurons of the hidden layer. epochs: at most so many steps.
        check: inputs and targets of validation; where given, all samples are learnt from.

    Returns:
        The network of the epoch that did best on validation; the same for the same `rng` and number of threads.

    Raises:
        InputError: fewer than 3 samples, or not as many targets as inputs.
    """
    if len(inputs) != len(targets) or len(inputs) < 3:
        raise InputError(f"{len(inputs)} inputs and {len(targets)} targets, allowed is as many of both, at least 3")
    into, onto = Scale.of(inputs), Scale.of(targets)

    def scaled(x: Array, y: Array) -> Samples:
        return torch.from_numpy(np.column_stack([into.there(x), np.ones(len(x))])), torch.from_numpy(onto.there(y))

    order = rng.permutation(len(inputs))
    learned = round(LEARN * len(inputs)) if check is None else len(inputs)
    learn = order[:learned]
    if check is None:
        held = order[learned : learned + max(1, round(VALIDATE * len(inputs)))]
        check = inputs[held], targets[held]
    start = first_weights(into.half > 0, hidden, targets.shape[1], rng)
    (neurons, output), done = _train(start, scaled(inputs[learn], targets[learn]), scaled(*check), epochs)
    return Network(neurons.numpy(), output.numpy(), into, onto, done)


Weights = tuple[Tensor, Tensor]
Samples = tuple[Tensor, Tensor]


def first_weights(varies: NDArray[np.bool_], hidden: int, outputs: int, rng: np.random.Generator) -> Weights:
    """Hidden weights (H, D+1) whose slopes are spread over [-1, 1]^D after Nguyen and Widrow, and small random output
    weights (O, H+1).

    Args:
        varies: (D,) which inputs do; the others get weight 0, as if they were not there.
    """
    weights = rng.uniform(-1, 1, (hidden, len(varies))) * varies
    length = 0.7 * hidden ** (1 / max(1, varies.sum()))
    weights *= length / np.maximum(np.linalg.norm(weights, axis=1, keepdims=True), np.finfo(float).tiny)
    bias = length * np.linspace(-1, 1, hidden) * rng.choice([-1, 1], hidden)
    output = rng.uniform(-0.5, 0.5, (outputs, hidden + 1))
    return torch.from_numpy(np.column_stack([weights, bias])), torch.from_numpy(output)


def _train(weights: Weights, learn: Samples, check: Samples, epochs: int) -> tuple[Weights, int]:
    """The weights that did best on `check`, and the epochs it took: the steps until `check` no longer gains."""
    x, _ = learn
    neurons, error = forward(weights, *learn)
    best, least, failures = weights, _squares(forward(weights, *check)[1]), 0
    damping = FIRST_DAMPING
    for epoch in range(epochs):
        curvature, slope = normal_equations(x, neurons, weights[1], error)
        if slope.norm() < LEAST_SLOPE:
            return best, epoch
        squares = _squares(error)
        while True:
            candidate = _step(weights, curvature, slope, damping)
            if candidate:
                neurons, error = forward(candidate, *learn)
                if _squares(error) < squares:
                    weights, damping = candidate, max(damping / 10, LEAST_DAMPING)
                    break
            damping *= 10
            if damping > MOST_DAMPING:
                return best, epoch
        checked = _squares(forward(weights, *check)[1])
        if checked < least:
            best, least, failures = weights, checked, 0
        else:
            failures += 1
            if failures == FAILURES:
                return best, epoch + 1
    return best, epochs


def forward(weights: Weights, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Neurons (Q, H+1), the last column 1 for the biases, and errors (Q, O), for x (Q, D+1) with a last column of 1."""
    hidden, output = weights
    neurons = torch.ones(len(x), len(hidden) + 1, dtype=x.dtype)
    torch.tanh(x @ hidden.T, out=neurons[:, :-1])
    return neurons, neurons @ output.T - y


def normal_equations(x: Tensor, neurons: Tensor, output: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
    """J^T J, its upper triangle only, and J^T e for the Jacobian J of all errors; weights in the order hidden, output.

    Output k responds to the weight of neuron i on input a by V_ki (1 - h_i^2) x_a: all but V_ki is common to the
    outputs, so that one symmetric product of [(1 - h^2) x, h, 1] serves all of them.

    Args:
        x: (Q, D+1) scaled inputs and 1. neurons: (Q, H+1) h and 1. output: (O, H+1) weights V. error: (Q, O).
    """
    wide, many = neurons.shape[1], output.shape[0]
    hidden, inputs = wide - 1, x.shape[1]
    count = hidden * inputs
    bend = 1 - neurons[:, :-1] ** 2
    joint = torch.cat([(bend[:, :, None] * x[:, None, :]).reshape(len(x), count), neurons], dim=1)
    product = _gram(joint)
    weights = output[:, :-1]

    curvature = torch.zeros(count + many * wide, count + many * wide, dtype=x.dtype)
    by_neuron = (hidden, inputs, hidden, inputs)
    shared = (weights.T @ weights)[:, None, :, None]
    curvature[:count, :count].view(by_neuron).copy_(product[:count, :count].view(by_neuron) * shared)
    for k, begin in enumerate(range(count, len(curvature), wide)):
        own = slice(begin, begin + wide)
        curvature[:count, own] = weights[k].repeat_interleave(inputs)[:, None] * product[:count, count:]
        curvature[own, own] = product[count:, count:]
    slope = torch.cat([(((error @ weights) * bend).T @ x).ravel(), (error.T @ neurons).ravel()])
    return curvature, slope


def _gram(a: Tensor) -> Tensor:
    """The upper triangle of A^T A, block by block, which spares almost half of the full product; below it, zeros."""
    out = torch.zeros(a.shape[1], a.shape[1], dtype=a.dtype)
    for begin in range(0, a.shape[1], BLOCK):
        end = begin + BLOCK
        out[begin:end, begin:] = a[:, begin:end].T @ a[:, begin:]
    return out


def _step(weights: Weights, curvature: Tensor, slope: Tensor, damping: float) -> Weights | None:
    """The weights after a step of (J^T J + damping) d = -J^T e; None where the matrix is singular to rounding."""
    damped = curvature.clone()
    damped.diagonal().add_(damping)
    factor, failed = torch.linalg.cholesky_ex(damped, upper=True)
    if failed:
        return None
    change = torch.cholesky_solve(slope[:, None], factor, upper=True).ravel()
    hidden, output = weights
    return hidden - change[: hidden.numel()].view_as(hidden), output - change[hidden.numel() :].view_as(output)


def _squares(error: Tensor) -> float:
    return (error**2).sum().item()
