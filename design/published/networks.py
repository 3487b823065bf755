"""The published localizer in simulation: networks of one hidden layer, and their errors with fibres failed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from padforge.design.contact import serpentine_presses
from padforge.design.morphology import Array, Morphology
from padforge.design.published.levenberg_marquardt import train_batch
from padforge.design.settings import Rectangle, between_fibres

EPOCHS = 1000
TRAINING_SHARE, VALIDATION_SHARE = 0.7, 0.15
"""Shares of the samples; the rest is the test set of the published split."""
JITTER = 5 / 49  # maximum shift of a press from its serpentine, grid units, as published
BATCH = 14  # networks that a core trains at once, which gains nothing from more; a GPU trains all of one size at once
_FIRST_CALL = Lock()
"""Torch loads the linear algebra of a GPU at its first call, which fails if two threads make it at once."""

FailureSet = tuple[int, ...]  # indices of failed fibres


@dataclass(frozen=True)
class RangeScaler:
    """Scales columns to [-1, 1] and back; a constant column becomes 0, so that its weights have no effect."""

    middle: Array  # middle of each column's range; shape (D,)
    half: Array  # half width of each column's range; shape (D,)

    @classmethod
    def fit(cls, values: Array) -> "RangeScaler":
        """Return the scaler that maps the range of each column of `values` (Q, D) to [-1, 1]."""
        low, high = values.min(axis=0), values.max(axis=0)
        return cls((low + high) / 2, (high - low) / 2)

    def transform(self, values: Array) -> Array:
        """Return values (Q, D) scaled."""
        return np.divide(values - self.middle, self.half, out=np.zeros(values.shape), where=self.half > 0)

    def inverse_transform(self, scaled: Array) -> Array:
        """Return scaled values (Q, D) in the units before scaling."""
        return self.middle + self.half * scaled


@dataclass(frozen=True)
class Network:
    """A trained network of one hidden layer of tanh neurons: `network(inputs)` (Q, D) gives outputs (Q, O)."""

    hidden: Array  # weights of the neurons on scaled inputs, the last column their biases; shape (H, D + 1)
    output: Array  # weights of the scaled outputs on the neurons, the last column their biases; shape (O, H + 1)
    inputs: RangeScaler  # scaler of the inputs
    targets: RangeScaler  # scaler of the outputs
    epochs: int  # steps of its training

    def __call__(self, inputs: ArrayLike) -> Array:
        scaled = self.inputs.transform(np.asarray(inputs, dtype=np.float64))
        neurons = np.tanh(scaled @ self.hidden[:, :-1].T + self.hidden[:, -1])
        return self.targets.inverse_transform(neurons @ self.output[:, :-1].T + self.output[:, -1])


def fit_batch(
    inputs: Array,
    targets: Array,
    rngs: Sequence[np.random.Generator],
    hidden: int = 50,
    epochs: int = EPOCHS,
    validation: tuple[Array, Array] | None = None,
    alternatives: Array | None = None,
) -> list[Network]:
    """Train S networks of one shape at once by Levenberg-Marquardt with early stopping.

    70 % of the samples are for training, 15 % for validation, and 15 % are left out. The weights are those of the step
    with the least validation loss. Except for rounding, a network depends only on its samples and its generator.

    Args:
        inputs: samples of S networks, shape (S, Q, D), or samples that all of them share, shape (Q, D).
        targets: targets, which all networks share; shape (Q, O).
        rngs: S generators of the splits and of the initial weights.
        hidden: neurons.
        epochs: maximum number of steps.
        validation: inputs (S, C, D) and targets (C, O) for validation; all other samples are then for training.
        alternatives: targets that are as valid as `targets`; the nearest one to the output counts; shape (A, Q, O).
    """
    inputs = np.broadcast_to(inputs, (len(rngs), *inputs.shape[-2:]))
    valid_targets = targets[None] if alternatives is None else np.concatenate([targets[None], alternatives])
    scalers = [RangeScaler.fit(samples) for samples in inputs]
    target_scaler = RangeScaler.fit(valid_targets.reshape(-1, targets.shape[1]))
    y, count = target_scaler.transform(valid_targets), inputs.shape[1]
    n_training = round(TRAINING_SHARE * count) if validation is None else count
    n_validation = max(1, round(VALIDATION_SHARE * count))
    parts = []
    for i, (scaler, rng) in enumerate(zip(scalers, rngs, strict=True)):
        rows, held_out, _ = np.split(rng.permutation(count), [n_training, n_training + n_validation])
        x = scaler.transform(inputs[i])
        validation_samples = x[held_out], y[:, held_out]
        if validation is not None:
            validation_samples = scaler.transform(validation[0][i]), target_scaler.transform(validation[1][None])
        parts.append((initial_weights(scaler.half > 0, hidden, rng).T, x[rows], y[:, rows], *validation_samples))
    weights, *samples = (torch.from_numpy(np.stack(part)).to(best_device()) for part in zip(*parts, strict=True))
    trained = train_batch(weights, (samples[0], samples[1]), (samples[2], samples[3]), epochs)
    trained = (part.cpu().numpy() for part in trained)
    return [
        Network(hidden_weights.T, output_weights.T, scaler, target_scaler, int(steps))
        for scaler, hidden_weights, output_weights, steps in zip(scalers, *trained, strict=True)
    ]


def best_device() -> str:
    """Return torch's name of the device for training: the GPU if there is one, otherwise the processor."""
    if not torch.cuda.is_available():
        return "cpu"
    with _FIRST_CALL:
        torch.linalg.cholesky_ex(torch.eye(1, device="cuda"))
    return "cuda"


def initial_weights(varies: NDArray[np.bool_], hidden: int, rng: np.random.Generator) -> Array:
    """Draw hidden weights (H, D + 1), biases last, whose regions cover [-1, 1]^D (Nguyen and Widrow, IJCNN 1990).

    Inputs that are constant, according to `varies` (D,), get weight 0, as if they were absent.
    """
    weights = rng.uniform(-1, 1, (hidden, len(varies))) * varies
    length = 0.7 * hidden ** (1 / max(1, varies.sum()))
    norm = np.linalg.norm(weights, axis=1, keepdims=True)
    weights *= np.divide(length, norm, out=np.zeros_like(norm), where=norm > 0)
    bias = length * np.linspace(-1, 1, hidden) * rng.choice([-1, 1], hidden)
    return np.column_stack([weights, bias])


def split_batches(failures: Sequence[FailureSet]) -> list[list[FailureSet]]:
    """Split sets of failed fibres into batches whose networks are trained at once."""
    size = BATCH if best_device() == "cpu" else len(failures)
    return [list(failures[begin : begin + size]) for begin in range(0, len(failures), size)]


@dataclass(frozen=True)
class SimulatedPresses:
    """Training presses and test presses, with the signals of a pad."""

    train_positions: Array  # shape (Q, 2), grid units
    train_signals: Array  # shape (Q, F)
    test_positions: Array  # shape (T, 2), grid units
    test_signals: Array  # shape (T, F)
    seed: int  # seed of the networks, together with their failed fibres

    @classmethod
    def simulate(
        cls, pad: Morphology, side: int, test: int, seed: int, respond: Callable[[Array], Array]
    ) -> "SimulatedPresses":
        """Simulate a serpentine of `side`^2 training presses, and `test` uniformly drawn test presses.

        They lie between the outermost fibres. `respond` returns the signals (Q, F) at positions (Q, 2), grid units.
        """
        rectangle = between_fibres(pad.layout)
        training, fresh = training_presses(rectangle, side, seed), fresh_presses(rectangle, test, seed)
        return cls(training, respond(training), fresh, respond(fresh), seed)

    def fit(self, failures: Sequence[FailureSet], hidden: int, repeat: int = 0) -> list[Network]:
        """Train a network on the working fibres for each set of failed fibres, all sets of one size.

        Initial weights and the split of the presses also depend on `repeat`.
        """
        rngs = [np.random.default_rng([2, self.seed, len(failed), *failed, repeat]) for failed in failures]
        inputs = np.stack([self.train_signals[:, self._working(failed)] for failed in failures])
        return fit_batch(inputs, self.train_positions, rngs, hidden)

    def test_errors(self, network: Network, failed: FailureSet) -> Array:
        """Return the errors (T,) of a network on the test presses, grid units, without the failed fibres."""
        return self.position_errors(network, failed, self.test_signals, self.test_positions)

    def position_errors(self, network: Network, failed: FailureSet, signals: Array, positions: Array) -> Array:
        """Return the distances (Q,) between positions estimated from signals (Q, F) and `positions` (Q, 2)."""
        return np.linalg.norm(network(signals[:, self._working(failed)]) - positions, axis=1)

    def _working(self, failed: FailureSet) -> NDArray[np.int64]:
        return np.setdiff1d(np.arange(self.train_signals.shape[1]), failed)


def training_presses(rectangle: Rectangle, side: int, seed: int) -> Array:
    """Return the presses (side^2, 2) of a jittered serpentine over a rectangle, grid units."""
    jitter_seed = int(np.random.default_rng([0, seed]).integers(2**32))
    return serpentine_presses(rectangle, side, JITTER, jitter_seed)


def fresh_presses(rectangle: Rectangle, count: int, seed: int) -> Array:
    """Sample presses (count, 2) uniformly over a rectangle, grid units."""
    return np.random.default_rng([1, seed]).uniform(*rectangle, (count, 2))
