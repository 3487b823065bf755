"""Networks of the localizer in NumPy, for inference; `torch_network` is the same ensemble in torch, for training.

Method "ensemble": a heteroscedastic ensemble of residual MLPs whose inputs are masked features and the mask, so that
one network serves every set of failed fibres. Residual layers are h + relu(layer_norm(h)) W + b; the outputs are scaled
position (and depth, force) and the logarithms of their expected absolute errors. Method "published": one tanh layer.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from padforge.common.validation import InputError
from padforge.sense.arrays import Floats, Mask
from padforge.sense.localizer.bayes import BayesianLocalizer
from padforge.sense.localizer.model_files import check_arrays
from padforge.sense.localizer.moments import (
    FOLLOWING,
    LEAST_SLIDE,
    N_DOWN,
    NOW,
    RESIDUAL,
    SOON,
    answering,
    count_complete,
    stage_of,
)

Weights = Mapping[str, Floats]
"""`first.w` (E, D, H), `first.b` (E, 1, H), `hidden.w` (L, E, H, H), `hidden.b` (L, E, 1, H), `last.w` (E, H, 2 N) and
`last.b` (E, 1, 2 N), for E members, D inputs, H hidden units, L residual layers and N targets; of the published
network, E = 1, no `hidden`, and 2 in place of 2 N."""

N_OUTPUTS = 4
"""x, y and their log errors, in scaled units; with T measures, 2 T more: values follow y, and their logs the logs."""
EPSILON = 1e-5  # added to the variance in layer normalization
MIN_LOG_ERROR, MAX_LOG_ERROR = -9.0, 2.0
"""Range of log errors: from a ten-thousandth of the pad to the whole pad and more."""
MAX_WEIGHT = 1e4  # largest weight of a network, far above any that training ends with; no sum overflows below it


def check_weights(weights: Weights, n_inputs: int, method: str, n_measures: int = 0) -> None:
    """Raise InputError unless weights have the shapes and values of a network of D inputs and T measures."""
    shapes = {name: weight.shape for name, weight in weights.items()}
    first, layers = shapes.get("first.w", ()), shapes.get("hidden.w", (0,))[:1]
    if len(first) != 3 or len(layers) != 1 or 0 in first:
        raise InputError(f"weights have shapes {shapes}, expected first.w (E, D, H) and others")
    members, _, hidden = first
    outputs = N_OUTPUTS + 2 * n_measures if method == "ensemble" else 2
    expected = {
        "first.w": (members, n_inputs, hidden),
        "first.b": (members, 1, hidden),
        "last.w": (members, hidden, outputs),
        "last.b": (members, 1, outputs),
    }
    if method == "ensemble":
        expected |= {"hidden.w": (*layers, members, hidden, hidden), "hidden.b": (*layers, members, 1, hidden)}
    check_arrays(weights, {name: (shape, np.float32) for name, shape in expected.items()}, MAX_WEIGHT)


def network_inputs(features: Floats, fibre_mask: Mask, complete: Mask) -> Floats:
    """Return (Q, C F + C + K) inputs of a network from (Q, C, F) features and the (Q, C) and (Q, K) masks."""
    untimed = np.ones((len(complete), features.shape[2] - complete.shape[1]), bool)
    mask = fibre_mask[:, :, None] & np.hstack([complete, untimed])[:, None]
    # What is masked is replaced, not multiplied, by 0: not even NaN gets through.
    masked = np.where(mask, features, np.float32(0)).reshape(len(features), np.prod(features.shape[1:]))
    return np.concatenate([masked, fibre_mask.astype(np.float32), complete.astype(np.float32)], axis=1)


def forward(weights: Weights, x: Floats) -> Floats:
    """Return (E, Q, 2 N) targets and log errors for (Q, D) inputs; log errors of the published network are 0."""
    h = x @ weights["first.w"] + weights["first.b"]
    if "hidden.w" not in weights:
        targets = np.tanh(h) @ weights["last.w"] + weights["last.b"]
        return np.concatenate([targets, np.zeros_like(targets)], axis=2)
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + _activate(h) @ w + b
    return _activate(h) @ weights["last.w"] + weights["last.b"]


Networks = Mapping[str, Weights]
"""Networks by phase, see `moments.PHASES`."""


def predict_members(
    networks: Networks,
    features: Floats,
    fibre_mask: Mask,
    complete: Mask,
    bayes: Sequence[BayesianLocalizer] = (),
    residual_network: Weights = MappingProxyType({}),
) -> Floats:
    """Return the (E, Q, 2 N) outputs of all members that answer for Q presses with as many complete windows.

    Features are (Q, C, F + G), scaled, with (Q, C) and (Q, K) masks. The last member is the Bayesian localizer of the
    phase, if any, corrected by its residual network.
    """
    n_complete, n_timed = int(complete[:1].sum()), complete.shape[1]
    is_published = "hidden.w" not in next(iter(networks.values()))
    x = features.reshape(len(features), -1) if is_published else network_inputs(features, fibre_mask, complete)
    names = answering(networks, n_complete, n_timed, bool(bayes))
    outputs = [forward(networks[name], x) for name in names if name != RESIDUAL]
    if RESIDUAL in names:
        localizer = bayes[stage_of(n_complete, n_timed) or 0]
        position, summary = localizer.predict(features.astype(np.float64), fibre_mask)
        outputs.append(forward(residual_network, np.concatenate([x, summary.astype(np.float32)], axis=1)))
        outputs[-1][:, :, :2] += position
    return np.concatenate(outputs)


def predict(
    networks: Networks,
    features: Floats,
    fibre_mask: Mask,
    complete: Mask,
    bayes: Sequence[BayesianLocalizer] = (),
    residual_network: Weights = MappingProxyType({}),
    sliding: "Sliding | None" = None,
) -> tuple[Floats, Floats, Mask]:
    """Predict presses at any moments; those of a finger that has slid by the network that follows it.

    Arguments are as in `predict_members`.

    Returns:
        (Q, N) scaled targets and their standard deviations, 0 before the first moment, and (Q,) whether it has slid.
    """
    n_complete = count_complete(complete)
    first = next(iter(networks.values()))
    n_targets = first["last.w"].shape[2] // (2 if "hidden.w" in first else 1)
    targets, std = np.zeros((2, len(complete), n_targets), np.float32)
    for count in np.unique(n_complete).tolist():
        if count or not complete.shape[1]:
            rows = n_complete == count
            inputs = features[rows], fibre_mask[rows], complete[rows]
            targets[rows], std[rows] = combine_members(predict_members(networks, *inputs, bayes, residual_network))
    slid = np.zeros(len(complete), bool)
    rows = np.flatnonzero(n_complete >= N_DOWN)
    if sliding is not None and len(rows):
        following = sliding.follow(networks[FOLLOWING], features[rows], fibre_mask[rows], complete[rows])
        slid[rows] = following.moved > LEAST_SLIDE
        targets[slid], std[slid] = (part[slid[rows]] for part in following[:2])
    return targets, std, slid


class Followed(NamedTuple):
    """Where a finger was last, by the network that follows it."""

    targets: Floats  # (Q, N), scaled
    std: Floats  # (Q, N)
    moved: Floats  # (Q,) distance from where it was soon after the touch, in standard deviations then


@dataclass(frozen=True)
class Sliding:
    """How a finger that slides is followed."""

    # (C, len(NOW), len(DOWN)), see `FeatureScaler.to_now`
    now_factor: Floats
    now_offset: Floats

    def follow(self, weights: Weights, features: Floats, fibre_mask: Mask, complete: Mask) -> Followed:
        """Follow the finger of presses (Q, C, F + G) that are read to their end."""
        n_timed = complete.shape[1]

        def predict_from(features: Floats, n_complete: int) -> tuple[Floats, Floats]:
            inputs = network_inputs(features, fibre_mask, complete & (np.arange(n_timed) < n_complete))
            return combine_members(forward(weights, inputs))

        targets, std = predict_from(features, N_DOWN)
        soon = features.copy()
        for k in range(len(NOW)):
            window = SOON - 1 - k
            now = features[:, :, window] * self.now_factor[:, k, window] + self.now_offset[:, k, window]
            soon[:, :, n_timed + k] = now
        before, before_std = predict_from(soon, SOON)
        moved = np.hypot(*(targets - before)[:, :2].T) / np.maximum(np.hypot(*before_std[:, :2].T), np.float32(1e-9))
        return Followed(targets, std, moved)


def combine_members(outputs: Floats) -> tuple[Floats, Floats]:
    """Combine (E, Q, 2 N) outputs by inverse variances: (Q, N) targets and their standard deviations, scaled.

    The error of a member is taken as Laplace distributed, of variance 2 b^2 for the mean absolute error b. Members are
    weighted press by press, alike in x and y; their disagreement adds to the variance (Lakshminarayanan et al. 2017,
    Simple and scalable predictive uncertainty estimation using deep ensembles).
    """
    targets, log_errors = np.split(outputs, 2, axis=2)
    variance = 2 * np.exp(2 * np.clip(log_errors, MIN_LOG_ERROR, MAX_LOG_ERROR))
    pooled = variance.copy()
    pooled[:, :, :2] = variance[:, :, :2].mean(axis=2, keepdims=True)
    weight = 1 / pooled / (1 / pooled).sum(axis=0)
    mean = (weight * targets).sum(axis=0)
    return mean, np.sqrt((weight * (variance + (targets - mean) ** 2)).sum(axis=0))


def stack_members(members: list[Weights]) -> Weights:
    """Stack the weights of networks of one size into an ensemble."""
    return {name: np.concatenate([each[name] for each in members], axis=_axis(name)) for name in members[0]}


def unstack_members(weights: Weights) -> list[Weights]:
    """Return the weights of each member of an ensemble, as ensembles of one."""
    members = range(len(weights["last.b"]))
    return [{name: np.take(part, [each], axis=_axis(name)) for name, part in weights.items()} for each in members]


def _axis(name: str) -> int:
    """Axis of the members in a part of `Weights`."""
    return 1 if name.startswith("hidden") else 0


def _activate(h: Floats) -> Floats:
    h = h - h.mean(axis=-1, keepdims=True)
    return np.maximum(h / np.sqrt((h * h).mean(axis=-1, keepdims=True) + np.float32(EPSILON)), np.float32(0))
