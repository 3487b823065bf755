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
    terms = np.einsum("qcn,ecnh->eqch", inputs, weights["first.w"]) + weights["first.mask"][:, None]
    terms = np.where(fibre_mask[:, :, None], terms, np.float32(0))
    h = _silu(terms.sum(axis=2, keepdims=True) - terms + weights["first.b"][:, None, None])
    h = _silu(h @ weights["hidden.w"][:, None] + weights["hidden.b"][:, None, None])
    out = np.einsum("eqch,echt->eqct", h, weights["last.w"]) + weights["last.b"][:, None]
    mean, log_std = np.split(out.astype(np.float64), 2, axis=-1)
    variance = np.exp(2 * np.clip(log_std, *LOG_STD))
    return mean.mean(axis=0), np.sqrt(variance.mean(axis=0) + mean.var(axis=0))


def _silu(x: Floats) -> Floats:
    return x * np.float32(0.5) * (1 + np.tanh(x * np.float32(0.5)))


def train_networks(inputs: Floats, targets: Array, rows: list[Indices], rng: np.random.Generator) -> dict[str, Floats]:
    """Train one member on each set of presses (`rows`), of scaled inputs (Q, L, N) and targets (Q, L, T)."""
    import torch
    from torch.nn.functional import silu

    from padforge.sense.localizer.optimizer import fit_network

    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets.astype(np.float32))
    n_members, (_, fibres, n_inputs), n_targets = len(rows), x.shape, y.shape[2]

    def normal(*shape: int, fan_in: int, gain: float = 1.0) -> torch.Tensor:
        return (torch.randn(*shape, generator=generator) * gain / fan_in**0.5).requires_grad_()

    weights = {
        "first.w": normal(n_members, fibres, n_inputs, HIDDEN, fan_in=fibres * n_inputs),
        "first.mask": normal(n_members, fibres, HIDDEN, fan_in=fibres * n_inputs),
        "first.b": torch.zeros(n_members, HIDDEN, requires_grad=True),
        "hidden.w": normal(n_members, HIDDEN, HIDDEN, fan_in=HIDDEN),
        "hidden.b": torch.zeros(n_members, HIDDEN, requires_grad=True),
        "last.w": normal(n_members, fibres, HIDDEN, 2 * n_targets, fan_in=HIDDEN, gain=0.1),
        "last.b": torch.zeros(n_members, fibres, 2 * n_targets, requires_grad=True),
    }
    member_rows = [torch.from_numpy(row) for row in rows]
    probabilities = torch.tensor(DROPOUT[: max(fibres - 1, 1)])

    def loss_of_batch() -> torch.Tensor:
        # 1. A batch of presses for each member, with 1 to 3 fibres masked, whose targets are predicted
        batch = torch.stack([part[torch.randint(len(part), (BATCH,), generator=generator)] for part in member_rows])
        n_dropped = 1 + torch.multinomial(probabilities, n_members * BATCH, replacement=True, generator=generator)
        rank = torch.rand(n_members, BATCH, fibres, generator=generator).argsort(dim=2)
        dropped = (rank < n_dropped.view(n_members, BATCH, 1)).to(x.dtype)[..., None]
        noisy = x[batch] + INPUT_NOISE * torch.randn(n_members, BATCH, fibres, n_inputs, generator=generator)
        # 2. Forward pass
        h = torch.einsum("ebcn,ecnh->ebh", noisy * (1 - dropped), weights["first.w"])
        h = h + torch.einsum("ebc,ech->ebh", 1 - dropped[..., 0], weights["first.mask"])
        h = silu(h + weights["first.b"][:, None])
        h = silu(torch.baddbmm(weights["hidden.b"][:, None], h, weights["hidden.w"]))
        out = torch.einsum("ebh,echt->ebct", h, weights["last.w"]) + weights["last.b"][:, None]
        mean, log_std = out.split(n_targets, dim=3)
        # 3. Negative log-likelihood of Student's t
        log_std = log_std.clamp(*LOG_STD)
        square = (y[batch] - mean) ** 2
        nll = (T_DEGREES + 1) / 2 * torch.log1p(square * torch.exp(-2 * log_std) / T_DEGREES) + log_std
        # The square error adds a gradient of the mean where a large standard deviation flattens the likelihood.
        loss = ((nll + square / 4) * dropped).sum(dim=(1, 2, 3)) / dropped.sum(dim=(1, 2, 3))
        return loss.sum()

    with one_thread():
        return fit_network(weights, loss_of_batch, min(MAX_STEPS, len(x)), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
