"""Prediction of every fibre's response to a press from the responses of the others: mean and standard deviation.

The trace of a fibre, its readings around a press, is its baseline, the mean at rest, plus its response, of which the
principal components are used. An ensemble of networks with dropout of fibres predicts both from the other valid fibres,
with standard deviations, so that what is hard to predict does not count as a fault. Heteroscedastic regression: D. A.
Nix, A. S. Weigend, IEEE ICNN 1994; ensembles: B. Lakshminarayanan, A. Pritzel, C. Blundell, NeurIPS 2017.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from padforge.common.parallel import one_thread
from padforge.sense.arrays import MIN_SCALE_V, Array, Floats, Indices, Mask, press_bounds
from padforge.sense.localizer import moments
from padforge.sense.localizer.optimizer import Parameters, fit_network

Weights = Mapping[str, Floats]
"""`first.w` (E, L, N, H), `first.mask` (E, L, H), `first.b` (E, H), `hidden.w` (E, H, H), `hidden.b` (E, H), `last.w`
(E, L, H, 2 T) and `last.b` (E, L, 2 T), for E members, N inputs a fibre, H hidden units and T targets a fibre."""

REST = -moments.REST[0]  # readings of a trace before the probe is sent down: those of the windows of a localizer
HELD = moments.PRESS_WINDOWS[-1][1]  # readings of a trace after it was sent down
RELEASED = moments.RELEASE_WINDOWS[-1][1]  # readings of a trace after it was sent up
TRACE = REST + HELD + RELEASED
COMPONENTS = 6  # principal components of a response: 99.7 % of the variance on the published pad
INPUTS = 2 * COMPONENTS + 1  # inputs of a fibre: response, baseline and history
TARGETS = COMPONENTS + 1  # targets of a fibre: response and baseline
LEVEL_RATE = 1 / 50  # weight of a press in the running mean of the baseline, which follows drift but not offsets
HISTORY_COEF = 0.7  # decay of earlier responses per press, as silicone creeps back
T_DEGREES = 5.0  # of freedom of Student's t, the distribution of the residuals: a few in a thousand are outliers
MAX_INPUT = 8.0  # largest scaled input: an open fibre must not drive the network where it was never trained

MEMBERS = 3
HIDDEN = 128
BATCH = 96
LEARNING_RATE = 3e-3
MAX_STEPS = 2500  # of a training, one per press; with more, predictions of presses held out get worse
DROPOUT = (0.6, 0.25, 0.15)  # probabilities that training masks 1, 2 and 3 fibres
INPUT_NOISE = 0.02  # standard deviation of noise on scaled inputs
WEIGHT_DECAY = 1e-2
LOG_STD = (-4.0, 2.0)  # range of the logarithm of a predicted standard deviation


def extract_trace(readings: Array, down_command: int, up_command: int, first: int, end: int) -> Array:
    """Extract the trace (L, TRACE) of a press from the readings (R, L) from `first` to before `end`.

    Before `first` and from `end` on, the nearest reading is repeated; after the release all are NaN if the press ends
    before it.
    """
    before = np.arange(down_command - REST, down_command).clip(min(first, down_command - 1))
    held = np.minimum(np.arange(down_command, down_command + HELD), up_command - 1)
    released = np.minimum(np.arange(up_command, up_command + RELEASED), end - 1)
    trace = readings[np.concatenate([before, held, released])].T
    if end <= up_command:
        # Repeating the last reading, of the pressed pad, would look like fibres that do not recover.
        trace[:, -RELEASED:] = np.nan
    return trace


def bound_presses(readings: Array, down_command: Indices, up_command: Indices) -> tuple[Array, Indices, Indices]:
    """Find the first readings (Q,) of presses and their ends (Q,), between the neighbours.

    Readings (R, C) are returned too, padded with NaN if they end before RELEASED readings of the last release.
    """
    # The last press is not cut short by another one: its remaining readings are missing, and not repeated.
    missing = max(int(up_command[-1]) + RELEASED - len(readings), 0)
    readings = np.pad(readings, ((0, missing), (0, 0)), constant_values=np.nan) if missing else readings
    return readings, *press_bounds(down_command, up_command, len(readings))


def extract_traces(readings: Array, down_command: Indices, up_command: Indices) -> Array:
    """Extract the traces (Q, L, TRACE) of all presses of (R, L) readings."""
    readings, first, end = bound_presses(readings, down_command, up_command)
    presses = zip(down_command, up_command, first, end, strict=True)
    return np.stack([extract_trace(readings, *press) for press in presses])


@dataclass
class TraceHistory:
    """State of the fibres after earlier presses."""

    level: Array  # running mean of the baseline; shape (L,), V; NaN before the first press
    n_presses: Indices  # presses in that mean; shape (L,)
    residue: Array  # decaying sum of earlier responses; shape (L, D)

    @classmethod
    def initial(cls, fibres: int) -> "TraceHistory":
        """Return the state before the first press."""
        return cls(np.full(fibres, np.nan), np.zeros(fibres, dtype=np.int64), np.zeros((fibres, COMPONENTS)))


@dataclass(frozen=True)
class TracePCA:
    """Principal components of the responses, and the scales of inputs and targets of the network."""

    components: Array  # principal directions of each fibre's responses; shape (L, TRACE, D)
    input_scale_v: Array  # shape (L, N)
    target_scale_v: Array  # shape (L, T)

    @classmethod
    def fit_transform(cls, traces: Array) -> tuple["TracePCA", Floats, Array]:
        """Fit to healthy traces (Q, L, TRACE); return also their inputs (Q, L, N) and targets (Q, L, T)."""
        responses = traces - traces[:, :, :REST].mean(axis=2, keepdims=True)
        second_moments = np.einsum("qcw,qcv->cwv", responses, responses) / len(responses)
        components = np.linalg.eigh(second_moments)[1][:, :, : -COMPONENTS - 1 : -1]
        fibres = traces.shape[1]
        pca = cls(components, np.ones((fibres, INPUTS)), np.ones((fibres, TARGETS)))
        history = TraceHistory.initial(fibres)
        inputs, targets = map(np.stack, zip(*[pca.project(trace, history) for trace in traces], strict=True))
        input_rms, target_rms = np.sqrt((inputs**2).mean(axis=0)), np.sqrt((targets**2).mean(axis=0))
        # Geometric means of each rms and the fibre's largest: small inputs stay smaller, and their noise with them.
        input_scale = np.sqrt(input_rms * input_rms.max(axis=1, keepdims=True))
        pca = cls(components, *(np.where(scale > MIN_SCALE_V, scale, 1.0) for scale in (input_scale, target_rms)))
        return pca, *pca.scale(inputs, targets)

    def project(self, trace: Array, history: TraceHistory) -> tuple[Array, Array]:
        """Compute the unscaled inputs (L, N) and targets (L, T) of a trace (L, TRACE), and update the history.

        A fibre with NaN in its trace has NaN, and its history stays.
        """
        baseline = trace[:, :REST].mean(axis=1)
        response = np.einsum("cw,cwd->cd", trace - baseline[:, None], self.components)
        valid = np.isfinite(response).all(axis=1)
        history.level = np.where(np.isnan(history.level), baseline, history.level)
        offset = baseline - history.level
        inputs = np.concatenate([response, offset[:, None], history.residue], axis=1)
        targets = np.concatenate([response, offset[:, None]], axis=1)
        history.n_presses = history.n_presses + valid
        rate = np.maximum(LEVEL_RATE, 1 / np.maximum(history.n_presses, 1))
        history.level = np.where(valid, history.level + rate * offset, history.level)
        history.residue = np.where(valid[:, None], HISTORY_COEF * (history.residue + response), history.residue)
        return inputs, targets

    def scale(self, inputs: Array, targets: Array) -> tuple[Floats, Array]:
        """Scale inputs (..., L, N) and targets (..., L, T); inputs of missing fibres become 0."""
        scaled = np.nan_to_num(np.clip(inputs / self.input_scale_v, -MAX_INPUT, MAX_INPUT))
        return scaled.astype(np.float32), targets / self.target_scale_v


def predict_fibres(weights: Weights, inputs: Floats, fibre_mask: Mask) -> tuple[Array, Array]:
    """Predict the targets (Q, L, T) of each fibre from scaled inputs (Q, L, N) of the *other* valid ones.

    Returns the mean and the standard deviation of the mixture of the members.
    """
    # The first layer without a fibre is the sum over all minus the term of this fibre, computed once for all L.
    terms = inputs.swapaxes(0, 1) @ weights["first.w"] + weights["first.mask"][:, :, None]  # (E, L, Q, H)
    terms = np.where(fibre_mask.T[:, :, None], terms, np.float32(0))
    h = _silu(terms.sum(axis=1, keepdims=True) - terms + weights["first.b"][:, None, None])
    h = _silu(h @ weights["hidden.w"][:, None] + weights["hidden.b"][:, None, None])
    out = (h @ weights["last.w"] + weights["last.b"][:, :, None]).swapaxes(1, 2)
    mean, log_std = np.split(out.astype(np.float64), 2, axis=-1)
    variance = np.exp(2 * np.clip(log_std, *LOG_STD))
    return mean.mean(axis=0), np.sqrt(variance.mean(axis=0) + mean.var(axis=0))


def _silu(x: Floats) -> Floats:
    return x * _sigmoid(x)


def _sigmoid(x: Floats) -> Floats:
    """Return (1 + tanh(x / 2)) / 2, in one array for all steps, since allocating costs as much as computing."""
    result = x * np.float32(0.5)
    np.tanh(result, out=result)
    result += np.float32(1)
    result *= np.float32(0.5)
    return result


def train_networks(inputs: Floats, targets: Array, rows: list[Indices], rng: np.random.Generator) -> dict[str, Floats]:
    """Train one member on each set of presses (`rows`), of scaled inputs (Q, L, N) and targets (Q, L, T)."""
    members, (_, fibres, size), n_outputs = len(rows), inputs.shape, 2 * targets.shape[2]
    y = targets.astype(np.float32)

    def normal(*shape: int, fan_in: int, gain: float = 1.0) -> Floats:
        return rng.standard_normal(shape, np.float32) * np.float32(gain / fan_in**0.5)

    parameters = Parameters(
        {
            "first.w": normal(members, fibres * size, HIDDEN, fan_in=fibres * size),
            "first.mask": normal(members, fibres, HIDDEN, fan_in=fibres * size),
            "first.b": np.zeros((members, 1, HIDDEN), np.float32),
            "hidden.w": normal(members, HIDDEN, HIDDEN, fan_in=HIDDEN),
            "hidden.b": np.zeros((members, 1, HIDDEN), np.float32),
            "last.w": normal(members, HIDDEN, fibres * n_outputs, fan_in=HIDDEN, gain=0.1),
            "last.b": np.zeros((members, 1, fibres * n_outputs), np.float32),
        }
    )
    max_dropped = len(DROPOUT[: max(fibres - 1, 1)])
    probabilities = np.divide(DROPOUT[:max_dropped], sum(DROPOUT[:max_dropped]))

    def train_batch() -> None:
        """Draw a batch for each member; some fibres of each press are dropped, and predicted from the others."""
        batch = np.stack([row[rng.integers(len(row), size=BATCH)] for row in rows])
        count = 1 + rng.choice(max_dropped, (members, BATCH, 1), p=probabilities)
        dropped = (rng.random((members, BATCH, fibres)).argsort(axis=2) < count).astype(np.float32)
        noise = np.float32(INPUT_NOISE) * rng.standard_normal((members, BATCH, fibres, size), np.float32)
        backpropagate(parameters, inputs[batch] + noise, y[batch], dropped)

    with one_thread():
        steps = min(MAX_STEPS, len(inputs))
        fitted = fit_network(parameters, train_batch, steps, LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    last_w = fitted["last.w"].reshape(members, HIDDEN, fibres, n_outputs).swapaxes(1, 2)
    return {
        "first.w": fitted["first.w"].reshape(members, fibres, size, HIDDEN),
        "first.mask": fitted["first.mask"],
        "first.b": fitted["first.b"][:, 0],
        "hidden.w": fitted["hidden.w"],
        "hidden.b": fitted["hidden.b"][:, 0],
        "last.w": np.ascontiguousarray(last_w),
        "last.b": fitted["last.b"].reshape(members, fibres, n_outputs),
    }


def backpropagate(parameters: Parameters, inputs: Floats, targets: Floats, dropped: Floats) -> None:
    """Write the gradient of the loss of scaled inputs (E, B, L, N) and targets (E, B, L, T); dropped (E, B, L) is 1."""
    weights, gradient, (members, batch, fibres, _) = parameters.weights, parameters.gradient, inputs.shape
    # 1. Forward
    valid = 1 - dropped
    x = (inputs * valid[..., None]).reshape(members, batch, -1)
    first = x @ weights["first.w"] + valid @ weights["first.mask"] + weights["first.b"]
    first_active, first_slope = _silu_and_slope(first)
    hidden_active, hidden_slope = _silu_and_slope(first_active @ weights["hidden.w"] + weights["hidden.b"])
    outputs = hidden_active @ weights["last.w"] + weights["last.b"]
    # 2. Backward
    grad_outputs = _loss_gradient(outputs.reshape(members, batch, fibres, -1), targets, dropped).reshape(outputs.shape)
    grad_hidden = grad_outputs @ weights["last.w"].mT * hidden_slope
    grad_first = grad_hidden @ weights["hidden.w"].mT * first_slope
    np.matmul(x.mT, grad_first, out=gradient["first.w"])
    np.matmul(valid.mT, grad_first, out=gradient["first.mask"])
    np.matmul(first_active.mT, grad_hidden, out=gradient["hidden.w"])
    np.matmul(hidden_active.mT, grad_outputs, out=gradient["last.w"])
    for name, each in ("first.b", grad_first), ("hidden.b", grad_hidden), ("last.b", grad_outputs):
        np.sum(each, axis=1, keepdims=True, out=gradient[name])


def _silu_and_slope(x: Floats) -> tuple[Floats, Floats]:
    sigmoid = _sigmoid(x)
    active, slope = x * sigmoid, 1 - sigmoid
    slope *= x
    slope += np.float32(1)
    slope *= sigmoid
    return active, slope


def _loss_gradient(outputs: Floats, targets: Floats, dropped: Floats) -> Floats:
    """Return the gradient of the loss by the outputs (E, B, L, 2 T), given targets (E, B, L, T) and dropped (E, B, L).

    With the error e, the standard deviation s and n degrees of freedom, the loss of a dropped fibre is the sum of
    (n + 1) / 2 log(1 + e^2 / (n s^2)) + log s + e^2 / 4, and that of a member the mean over its dropped fibres. The
    last term adds a gradient of the mean where a large standard deviation flattens the likelihood of Student's t.
    """
    mean, log_std = np.split(outputs, 2, axis=3)
    clipped, error = log_std.clip(*LOG_STD), mean - targets
    weight = (dropped / dropped.sum(axis=(1, 2), keepdims=True))[..., None]
    precision = np.exp(-2 * clipped) / T_DEGREES
    slope = (T_DEGREES + 1) * precision / (1 + precision * error**2)
    grad_log_std = (1 - slope * error**2) * (log_std == clipped)
    return np.concatenate([(slope + 0.5) * error, grad_log_std], axis=3) * weight
