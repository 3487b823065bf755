"""The published localizer: one hidden layer of tanh neurons, trained by Levenberg-Marquardt (paper, evaluation).

The protocol is the authors': damped Gauss-Newton steps (Hagan & Menhaj 1994, Training feedforward networks with the
Marquardt algorithm) from spread-out neurons (Nguyen & Widrow 1990, Improving the learning speed of 2-layer neural
networks), ended by presses held back for validation. Networks of one shape are trained as one batch, each on its own
inputs, split and weights, and each ending when it has learnt; how steps are found, and how long a training waits for
validation to gain, is our own (`variable_projection`).

Torch does the algebra on as many threads as it is set to. Set it to one: the matrices are too small to gain from more,
and where another program has a core, threads that wait for each other take many times as long.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from padforge.design.common.errors import InputError
from padforge.design.pad.knots import Array

if TYPE_CHECKING:
    from torch import Tensor

EPOCHS = 1000
LEARN, VALIDATE = 0.7, 0.15  # shares of the samples; the rest is the test set of the published split


@dataclass(frozen=True)
class ColumnScale:
    """Columns to [-1, 1] and back; a column that never varied becomes 0, which no weight can act on.

    Attributes:
        middle, half: (D,) middle and half width of each column's range.
    """

    middle: Array
    half: Array

    @classmethod
    def of(cls, values: Array) -> "ColumnScale":
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
    inputs: ColumnScale
    targets: ColumnScale
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
    """Train one network on (Q, D) inputs and (Q, O) targets: `fit_many` with a batch of one.

    Args:
        check: inputs (C, D) and targets (C, O) of validation; where given, all samples are learnt from.
    """
    checks = None if check is None else (check[0][None], check[1])
    return fit_many(inputs[None], targets, [rng], hidden, epochs, checks)[0]


def fit_many(
    inputs: Array,
    targets: Array,
    rngs: Sequence[np.random.Generator],
    hidden: int = 50,
    epochs: int = EPOCHS,
    check: tuple[Array, Array] | None = None,
    also: Array | None = None,
    device: str | None = None,
) -> list[Network]:
    """Train networks of one shape at once: 70 % of the samples to learn from, 15 % for validation, 15 % left aside.

    Args:
        inputs: (S, Q, D) samples of S networks, or (Q, D) that all of them learn from; finite.
        targets: (Q, O) that all of them learn.
        rngs: S sources of the splits and of the first weights.
        hidden: neurons of the hidden layer. epochs: at most so many steps.
        check: inputs (S, C, D) and targets (C, O) of validation; where given, all samples are learnt from.
        also: (A, Q, O) targets that are as right as those of `targets`: a sample counts by the one it comes nearest to.
        device: where torch computes; the GPU if None and there is one.

    Returns:
        S networks, each of the epoch that did best on validation. What a network becomes depends on its `rng` and its
        samples, beyond rounding on no other one of the batch.

    Raises:
        InputError: fewer than 3 samples, not as many targets as inputs, nothing to learn from or with, or numbers that
            are not finite.
    """
    from .variable_projection import train_batch

    inputs = _require_samples(inputs, targets, len(rngs), hidden)
    right = targets[None] if also is None else np.concatenate([targets[None], also])
    into, onto = [ColumnScale.of(own) for own in inputs], ColumnScale.of(right.reshape(-1, targets.shape[1]))
    samples = inputs.shape[1]
    learnt = round(LEARN * samples) if check is None else samples
    held = max(1, round(VALIDATE * samples))
    learn, validate, starts = [], [], []
    for own, scale, rng in zip(inputs, into, rngs, strict=True):
        order = rng.permutation(samples)
        learn.append((scale.there(own[order[:learnt]]), onto.there(right[:, order[:learnt]])))
        if check is None:
            rows = order[learnt : learnt + held]
            validate.append((scale.there(own[rows]), onto.there(right[:, rows])))
        starts.append(first_weights(scale.half > 0, hidden, rng).T)
    if check is not None:
        places = onto.there(check[1][None])
        validate = [(scale.there(own), places) for own, scale in zip(check[0], into, strict=True)]
    at = device or best_device()
    samples_of = partial(_stacked, device=at)
    trained = train_batch(_tensor(starts, at), samples_of(learn), samples_of(validate), epochs)
    return [
        Network(into_neurons.T, onto_outputs.T, scale, onto, int(taken))
        for scale, into_neurons, onto_outputs, taken in zip(
            into, *(part.cpu().numpy() for part in trained), strict=True
        )
    ]


def _require_samples(inputs: Array, targets: Array, networks: int, hidden: int) -> Array:
    """The inputs (S, Q, D) of so many networks, if they and the targets (Q, O) can be learnt."""
    if min(networks, hidden, inputs.shape[-1]) < 1:
        raise InputError(
            f"{networks} networks of {hidden} neurons for {inputs.shape[-1]} inputs, allowed is at least 1 of each"
        )
    if not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise InputError("inputs or targets hold NaN or infinity, expected finite numbers")
    inputs = np.broadcast_to(inputs, (networks, *inputs.shape[-2:]))
    samples = inputs.shape[1]
    if samples != len(targets) or samples < 3:
        raise InputError(f"{samples} inputs and {len(targets)} targets, allowed is as many of both, at least 3")
    return inputs


def best_device() -> str:
    """The name torch has for the GPU, if there is one, else for the processor."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _stacked(pairs: Sequence[tuple[Array, Array]], device: str) -> "tuple[Tensor, Tensor]":
    return _tensor([first for first, _ in pairs], device), _tensor([second for _, second in pairs], device)


def _tensor(parts: Sequence[Array], device: str) -> "Tensor":
    import torch

    return torch.from_numpy(np.stack(parts)).to(device)


def first_weights(varies: NDArray[np.bool_], hidden: int, rng: np.random.Generator) -> Array:
    """Hidden weights (H, D+1) whose slopes are spread over [-1, 1]^D after Nguyen and Widrow.

    Args:
        varies: (D,) which inputs do; the others get weight 0, as if they were not there.
    """
    weights = rng.uniform(-1, 1, (hidden, len(varies))) * varies
    length = 0.7 * hidden ** (1 / max(1, varies.sum()))
    norm = np.linalg.norm(weights, axis=1, keepdims=True)
    weights *= np.divide(length, norm, out=np.zeros_like(norm), where=norm > 0)
    bias = length * np.linspace(-1, 1, hidden) * rng.choice([-1, 1], hidden)
    return np.column_stack([weights, bias])
