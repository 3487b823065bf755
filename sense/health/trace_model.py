"""What each fibre should have answered to a press, by what the others answered: a masked network and its spread.

The trace of a press is the readings around it. A fibre's answer is its trace minus its rest, told by a few principal
components. A small ensemble of networks predicts the answer of every fibre, and the level of its rest, from the
other living fibres: a mean and a spread each, since what is hard to predict for healthy fibres must not count as a
fault. Any set of fibres may be left out, because training leaves out random ones.

Heteroscedastic regression: D. A. Nix, A. S. Weigend, "Estimating the mean and variance of the target probability
distribution", IEEE ICNN 1994; ensembles of it: B. Lakshminarayanan, A. Pritzel, C. Blundell, "Simple and scalable
predictive uncertainty estimation using deep ensembles", NeurIPS 2017."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from padforge.design.common.parallel import one_torch_thread
from padforge.sense.arrays import MIN_SCALE_V, Array, Floats, Indices, Mask

Weights = Mapping[str, Floats]
"""`first.w` (E, C, N, H), `first.alive` (E, C, H), `first.b` (E, H), `hidden.w` (E, H, H), `hidden.b` (E, H), `last.w`
(E, C, H, 2 T) and `last.b` (E, C, 2 T), for E members, N inputs a fibre, H hidden units and T targets a fibre."""

REST, SUNK, RELEASED = 10, 20, 20
"""Readings of a trace before the probe is sent down, after it, and after it is sent up."""
TRACE = REST + SUNK + RELEASED
COMPONENTS = 6
"""Principal components that tell an answer: 99.7 % of what the fibres of the published pad give."""
INPUTS, TARGETS = 2 * COMPONENTS + 1, COMPONENTS + 1
"""Of each fibre: answer, rest and memory enter the network; answer and rest are predicted."""
SLOW = 1 / 50
"""Share of a press in the running level of the rests: follows drift over hours, and an offset only after 50 presses."""
MEMORY = 0.7
"""Share of earlier answers that is left after a press: silicone creeps back, so a rest tells of the presses before."""
FREEDOM = 5.0
"""Degrees of freedom of Student's t, the law of the residuals: a few in a thousand lie far out."""
MAX_INPUT = 8.0
"""Greatest scaled input, in spreads: an open fibre must not drive the network where it never was."""

MEMBERS, HIDDEN, BATCH, RATE = 3, 128, 96, 3e-3
MOST_STEPS = 2500
"""Steps of training: one a press, up to so many. With more, predictions of presses held out get worse, the sooner the
fewer presses there are (seen on the published recording and on simulated ones of 400 to 4500 presses)."""
LEFT_OUT = (0.6, 0.25, 0.15)
"""How often training leaves out 1, 2 and 3 fibres."""
INPUT_NOISE = 0.02
WEIGHT_DECAY = 1e-2
LOG_SPREAD = (-4.0, 2.0)
"""Range of the logarithm of a predicted spread."""


def press_trace(readings: Array, down_command: int, up_command: int, low: int, high: int) -> Array:
    """The readings around one press.

    Args:
        readings: (R, C) volts. down_command, up_command: first reading after the probe was sent down, and up.
        low, high: the trace keeps to low <= index < high, the press's own readings; where it would reach further it
            is filled with the nearest.

    Returns:
        (C, TRACE) volts; NaN after the release if the press has no reading of its own from there.
    """
    before = np.arange(down_command - REST, down_command).clip(min(low, down_command - 1))
    down = np.minimum(np.arange(down_command, down_command + SUNK), up_command - 1)
    up = np.minimum(np.arange(up_command, up_command + RELEASED), high - 1)
    trace = readings[np.concatenate([before, down, up])].T
    if high <= up_command:
        # The nearest reading is of the pressed pad: the fibres would look as if they had stayed where they were.
        trace[:, -RELEASED:] = np.nan
    return trace


def press_ranges(readings: Array, down_command: Indices, up_command: Indices) -> tuple[Array, Indices, Indices]:
    """Bound the readings that belong to each press by its neighbours.

    Args:
        readings: (R, C) volts.
        down_command: (Q,) first reading after the probe was sent down.
        up_command: (Q,) first reading after it was sent up.

    Returns:
        Readings, with NaN where the recording ends before the last press has been released for RELEASED readings; and
        (Q,) the first reading of each press, and the first that is no longer its own.
    """
    # No press follows that cuts the last one off, so what lacks of it is missing, and is not filled.
    missing = max(int(up_command[-1]) + RELEASED - len(readings), 0)
    readings = np.pad(readings, ((0, missing), (0, 0)), constant_values=np.nan) if missing else readings
    return readings, np.concatenate([[0], up_command[:-1]]), np.append(down_command[1:], len(readings))


def traces_of(readings: Array, down_command: Indices, up_command: Indices) -> Array:
    """(Q, C, TRACE) traces of all presses of (R, C) readings."""
    readings, lows, highs = press_ranges(readings, down_command, up_command)
    return np.stack(
        [press_trace(readings, *press) for press in zip(down_command, up_command, lows, highs, strict=True)]
    )


@dataclass
class History:
    """What the presses before left behind.

    Attributes:
        level: (C,) running level of the rest, V; NaN before the first press. seen: (C,) presses in it.
        memory: (C, D) answers before, fading.
    """

    level: Array
    seen: Indices
    memory: Array

    @classmethod
    def none(cls, fibres: int) -> "History":
        return cls(np.full(fibres, np.nan), np.zeros(fibres, dtype=np.int64), np.zeros((fibres, COMPONENTS)))


@dataclass(frozen=True)
class Shapes:
    """How traces become the numbers of the network.

    Attributes:
        basis: (C, TRACE, D) principal directions of each fibre's answers.
        inputs: (C, N), targets: (C, T) what the numbers are divided by, V.
    """

    basis: Array
    inputs: Array
    targets: Array

    def advance(self, traces: Array, history: History) -> tuple[Array, Array]:
        """Inputs (C, N) and targets (C, T) of a press, in V, from its (C, TRACE) trace; `history` moves on by it.

        A fibre with NaN in its trace gives NaN, and its history stays.
        """
        rest = traces[:, :REST].mean(axis=1)
        answer = np.einsum("cw,cwd->cd", traces - rest[:, None], self.basis)
        there = np.isfinite(answer).all(axis=1)
        history.level = np.where(np.isnan(history.level), rest, history.level)
        above = rest - history.level
        inputs = np.concatenate([answer, above[:, None], history.memory], axis=1)
        targets = np.concatenate([answer, above[:, None]], axis=1)
        history.seen = history.seen + there
        share = np.maximum(SLOW, 1 / np.maximum(history.seen, 1))
        history.level = np.where(there, history.level + share * above, history.level)
        history.memory = np.where(there[:, None], MEMORY * (history.memory + answer), history.memory)
        return inputs, targets

    def scaled(self, inputs: Array, targets: Array) -> tuple[Floats, Array]:
        """(..., C, N) and (..., C, T) volts to numbers of about 1; inputs of absent fibres become 0."""
        scaled = np.nan_to_num(np.clip(inputs / self.inputs, -MAX_INPUT, MAX_INPUT))
        return scaled.astype(np.float32), targets / self.targets


def shapes_of(traces: Array) -> tuple[Shapes, Floats, Array]:
    """Shapes of (Q, C, TRACE) healthy traces, and their scaled inputs (Q, C, N) and targets (Q, C, T)."""
    answers = traces - traces[:, :, :REST].mean(axis=2, keepdims=True)
    moments = np.einsum("qcw,qcv->cwv", answers, answers) / len(answers)
    basis = np.linalg.eigh(moments)[1][:, :, : -COMPONENTS - 1 : -1]
    fibres = traces.shape[1]
    plain, history = Shapes(basis, np.ones((fibres, INPUTS)), np.ones((fibres, TARGETS))), History.none(fibres)
    rows = [plain.advance(press, history) for press in traces]
    inputs, targets = np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows])
    own, spread = np.sqrt((inputs**2).mean(axis=0)), np.sqrt((targets**2).mean(axis=0))
    # Small components keep a part of their smallness, and so of their noise.
    size = np.sqrt(own * own.max(axis=1, keepdims=True))
    shapes = Shapes(basis, *(np.where(each > MIN_SCALE_V, each, 1.0) for each in (size, spread)))
    return shapes, *shapes.scaled(inputs, targets)


def expected(weights: Weights, inputs: Floats, fibre_mask: Mask) -> tuple[Array, Array]:
    """What each fibre should give by the *other* living ones.

    Args:
        weights: of the network. inputs: (Q, C, N) scaled. fibre_mask: (Q, C) fibres to go by.

    Returns:
        Mean and spread, (Q, C, T) each, of the ensemble's mixture.
    """
    # A fibre's part in the first layer is taken out again to leave it out: C predictions for little more than one.
    parts = np.einsum("qcn,ecnh->eqch", inputs, weights["first.w"]) + weights["first.alive"][:, None]
    parts = np.where(fibre_mask[:, :, None], parts, np.float32(0))
    h = _silu(parts.sum(axis=2, keepdims=True) - parts + weights["first.b"][:, None, None])
    h = _silu(h @ weights["hidden.w"][:, None] + weights["hidden.b"][:, None, None])
    out = np.einsum("eqch,echt->eqct", h, weights["last.w"]) + weights["last.b"][:, None]
    mean, log_spread = np.split(out.astype(np.float64), 2, axis=-1)
    variance = np.exp(2 * np.clip(log_spread, *LOG_SPREAD))
    return mean.mean(axis=0), np.sqrt(variance.mean(axis=0) + mean.var(axis=0))


def member(weights: Weights, index: int) -> dict[str, Floats]:
    """The ensemble that has only one of the members."""
    return {name: weight[index : index + 1] for name, weight in weights.items()}


def _silu(x: Floats) -> Floats:
    return x * np.float32(0.5) * (1 + np.tanh(x * np.float32(0.5)))


def train_predictors(
    inputs: Floats, targets: Array, rows: list[Indices], rng: np.random.Generator
) -> dict[str, Floats]:
    """Fit one member to each set of presses.

    Args:
        inputs: (Q, C, N), targets: (Q, C, T), scaled. rows: presses that each member learns from, by index.
        rng: source of the seed of torch's own generator, which draws all that is random here.

    Returns:
        Weights of an ensemble of len(rows).
    """
    with one_torch_thread():
        return _train(inputs, targets, rows, int(rng.integers(2**63)))


def _train(inputs: Floats, targets: Array, rows: list[Indices], seed: int) -> dict[str, Floats]:
    import torch
    from torch.nn.functional import silu

    from padforge.sense.localizer.training import fit_network

    generator = torch.Generator().manual_seed(seed)
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets.astype(np.float32))
    members, (_, fibres, numbers), outputs = len(rows), x.shape, y.shape[2]

    def normal(*shape: int, fan_in: int, gain: float = 1.0) -> torch.Tensor:
        return (torch.randn(*shape, generator=generator) * gain / fan_in**0.5).requires_grad_()

    weights = {
        "first.w": normal(members, fibres, numbers, HIDDEN, fan_in=fibres * numbers),
        "first.alive": normal(members, fibres, HIDDEN, fan_in=fibres * numbers),
        "first.b": torch.zeros(members, HIDDEN, requires_grad=True),
        "hidden.w": normal(members, HIDDEN, HIDDEN, fan_in=HIDDEN),
        "hidden.b": torch.zeros(members, HIDDEN, requires_grad=True),
        "last.w": normal(members, fibres, HIDDEN, 2 * outputs, fan_in=HIDDEN, gain=0.1),
        "last.b": torch.zeros(members, fibres, 2 * outputs, requires_grad=True),
    }
    ranges = [torch.from_numpy(row) for row in rows]
    shares = torch.tensor(LEFT_OUT[: max(fibres - 1, 1)])

    def loss_of_batch() -> torch.Tensor:
        chosen = torch.stack([r[torch.randint(len(r), (BATCH,), generator=generator)] for r in ranges])
        count = 1 + torch.multinomial(shares, members * BATCH, replacement=True, generator=generator)
        order = torch.rand(members, BATCH, fibres, generator=generator).argsort(dim=2)
        out = (order < count.view(members, BATCH, 1)).to(x.dtype)[..., None]
        noisy = x[chosen] + INPUT_NOISE * torch.randn(members, BATCH, fibres, numbers, generator=generator)
        h = torch.einsum("ebcn,ecnh->ebh", noisy * (1 - out), weights["first.w"])
        h = h + torch.einsum("ebc,ech->ebh", 1 - out[..., 0], weights["first.alive"])
        h = silu(h + weights["first.b"][:, None])
        h = silu(torch.baddbmm(weights["hidden.b"][:, None], h, weights["hidden.w"]))
        found = torch.einsum("ebh,echt->ebct", h, weights["last.w"]) + weights["last.b"][:, None]
        mean, log_spread = found.split(outputs, dim=3)
        log_spread = log_spread.clamp(*LOG_SPREAD)
        error = (y[chosen] - mean) ** 2
        likelihood = (FREEDOM + 1) / 2 * torch.log1p(error * torch.exp(-2 * log_spread) / FREEDOM) + log_spread
        # The plain square keeps the mean learning where a wide spread has made the likelihood flat.
        loss = ((likelihood + error / 4) * out).sum(dim=(1, 2, 3)) / out.sum(dim=(1, 2, 3))
        return loss.sum()

    return fit_network(weights, loss_of_batch, min(MOST_STEPS, len(x)), RATE, weight_decay=WEIGHT_DECAY)
