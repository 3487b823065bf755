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
JITTER = 5 / 49  # greatest shift of a press off its serpentine, grid units, as published
BATCH = 14  # networks trained at once by a core, which gains nothing from more; a GPU trains all of a level at once
_FIRST_CALL = Lock()
"""Torch loads the linear algebra of a GPU at its first call, which fails where two threads make it at once."""

FailureSet = tuple[int, ...]  # indices of failed fibres


@dataclass(frozen=True)
class RangeScaler:
    """Scale columns to [-1, 1] and back; a column that never varied becomes 0, which no weight can act on."""

    middle: Array  # middle of each column's range; shape (D,)
    half: Array  # half width of each column's range; shape (D,)

    @classmethod
    def fit(cls, values: Array) -> "RangeScaler":
        """Return the scaler by which `values` (Q, D) fill [-1, 1]."""
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
    that did best on validation. Except for rounding, a network depends on its samples and its generator alone, and on
    no other network of the batch.

    The inputs are samples of S networks (S, Q, D), or (Q, D) that all of them share; the targets (Q, O) are shared.
    `rngs` are S generators of the splits and of the first weights. If inputs (S, C, D) and targets (C, O) for the
    validation are given, all samples are for training. Alternative targets (A, Q, O) are as valid as `targets`: a
    sample counts by the nearest one.
    """
    inputs = np.broadcast_to(inputs, (len(rngs), *inputs.shape[-2:]))
    options = targets[None] if alternatives is None else np.concatenate([targets[None], alternatives])
    scalers = [RangeScaler.fit(samples) for samples in inputs]
    target_scaler = RangeScaler.fit(options.reshape(-1, targets.shape[1]))
    goals, count = target_scaler.transform(options), inputs.shape[1]
    n_training = round(TRAINING_SHARE * count) if validation is None else count
    n_validation = max(1, round(VALIDATION_SHARE * count))
    parts = []
    for i, (scaler, rng) in enumerate(zip(scalers, rngs, strict=True)):
        rows, held_out, _ = np.split(rng.permutation(count), [n_training, n_training + n_validation])
        x = scaler.transform(inputs[i])
        checked = x[held_out], goals[:, held_out]
        if validation is not None:
            checked = scaler.transform(validation[0][i]), target_scaler.transform(validation[1][None])
        parts.append((initial_weights(scaler.half > 0, hidden, rng).T, x[rows], goals[:, rows], *checked))
    weights, *samples = (torch.from_numpy(np.stack(part)).to(best_device()) for part in zip(*parts, strict=True))
    trained = train_batch(weights, (samples[0], samples[1]), (samples[2], samples[3]), epochs)
    trained = (part.cpu().numpy() for part in trained)
    return [
        Network(hidden_weights.T, output_weights.T, scaler, target_scaler, int(steps))
        for scaler, hidden_weights, output_weights, steps in zip(scalers, *trained, strict=True)
    ]


def best_device() -> str:
    """Return torch's name of the GPU, if there is one, else of the processor."""
    if not torch.cuda.is_available():
        return "cpu"
    with _FIRST_CALL:
        torch.linalg.cholesky_ex(torch.eye(1, device="cuda"))
    return "cuda"


def initial_weights(varies: NDArray[np.bool_], hidden: int, rng: np.random.Generator) -> Array:
    """Draw hidden weights (H, D + 1), biases last, by Nguyen and Widrow (IJCNN 1990): regions spread over [-1, 1]^D.

    Inputs that do not vary, by `varies` (D,), get weight 0, as if they were absent.
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
    """Presses to train on and others to test on, with the signals of a pad."""

    train_positions: Array  # shape (Q, 2), grid units
    train_signals: Array  # shape (Q, F)
    test_positions: Array  # shape (T, 2), grid units
    test_signals: Array  # shape (T, F)
    seed: int  # of the networks, beside the failed fibres

    @classmethod
    def simulate(
        cls, pad: Morphology, side: int, test: int, seed: int, respond: Callable[[Array], Array]
    ) -> "SimulatedPresses":
        """Simulate a serpentine of `side`^2 training presses, and `test` uniformly drawn test presses.

        They lie between the outermost fibres. `respond` gives the signals (Q, F) for positions (Q, 2), grid units.
        """
        rectangle = between_fibres(pad.layout)
        training, fresh = training_presses(rectangle, side, seed), fresh_presses(rectangle, test, seed)
        return cls(training, respond(training), fresh, respond(fresh), seed)

    def fit(self, failures: Sequence[FailureSet], hidden: int, repeat: int = 0) -> list[Network]:
        """Train a network on the working fibres for each set of failed fibres of one size.

        Another `repeat` gives other first weights and another split of the presses.
        """
        rngs = [np.random.default_rng([2, self.seed, len(failed), *failed, repeat]) for failed in failures]
        inputs = np.stack([self.train_signals[:, self._working(failed)] for failed in failures])
        return fit_batch(inputs, self.train_positions, rngs, hidden)

    def test_errors(self, network: Network, failed: FailureSet) -> Array:
        """Return (T,) distances from estimated to true test positions, grid units, without the failed fibres."""
        return self.position_errors(network, failed, self.test_signals, self.test_positions)

    def position_errors(self, network: Network, failed: FailureSet, signals: Array, positions: Array) -> Array:
        """Return (Q,) distances from positions estimated by signals (Q, F) to `positions` (Q, 2)."""
        return np.linalg.norm(network(signals[:, self._working(failed)]) - positions, axis=1)

    def _working(self, failed: FailureSet) -> NDArray[np.int64]:
        return np.setdiff1d(np.arange(self.train_signals.shape[1]), failed)


def training_presses(rectangle: Rectangle, side: int, seed: int) -> Array:
    """Return (side^2, 2) presses of a jittered serpentine over a rectangle, grid units."""
    jitter_seed = int(np.random.default_rng([0, seed]).integers(2**32))
    return serpentine_presses(rectangle, side, JITTER, jitter_seed)


def fresh_presses(rectangle: Rectangle, count: int, seed: int) -> Array:
    """Return (count, 2) presses drawn uniformly over a rectangle, grid units."""
    return np.random.default_rng([1, seed]).uniform(*rectangle, (count, 2))
