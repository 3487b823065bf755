"""Networks of the localizer: their outputs; `backpropagation` computes the gradient for their training.

Method "ensemble" is a heteroscedastic ensemble of residual MLPs. Their inputs are masked features and the masks, so
that one network serves every set of failed fibres. Residual layers are h + relu(layer_norm(h)) W + b. Outputs are the
scaled position (and depth, force) and the logarithms of their expected absolute errors. Method "published" is a network
of one tanh layer.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from padforge.common.validation import InputError
from padforge.sense.arrays import Floats, Mask
from padforge.sense.localizer.bayes import BayesianLocalizer
from padforge.sense.localizer.moments import (
    EARLY_WINDOWS,
    LATEST_WINDOWS,
    N_PRESS_WINDOWS,
    RESIDUAL,
    SLIDE_THRESHOLD,
    active_networks,
    bayes_stage,
)
from padforge.sense.localizer.scaler import ScaledFeatures

Weights = Mapping[str, Floats]
"""`first.w` (E, I, H), `first.b` (E, 1, H), `hidden.w` (layers, E, H, H), `hidden.b` (layers, E, 1, H), `last.w`
(E, H, 2 N) and `last.b` (E, 1, 2 N), for E members, I inputs, H hidden units and N targets; of the published network,
E = 1, no `hidden`, and 2 in place of 2 N."""

N_OUTPUTS = 4
"""Outputs without measures: scaled x, y, and their log errors. With T measures, T values follow y, and T log errors
those of x and y."""
EPSILON = 1e-5  # added to the variance in layer normalization
MIN_LOG_ERROR = -9.0  # a ten-thousandth of the pad
MAX_LOG_ERROR = 2.0  # more than the pad
MAX_WEIGHT = 1e4  # far above the weights of any training; sums of smaller ones do not overflow


def check_weights(weights: Weights) -> None:
    """Raise InputError if a weight is NaN, or beyond those of any training."""
    for name, array in weights.items():
        largest = np.abs(array).max()
        if not largest <= MAX_WEIGHT:
            raise InputError(f"{name} is up to {largest:g}, allowed is up to {MAX_WEIGHT:g}")


def network_inputs(features: Any, fibre_mask: Any, complete: Any, xp: Any = np) -> Any:
    """Return (Q, C F + C + K) inputs of a network from (Q, C, F) features and the (Q, C) and (Q, K) masks.

    All arrays are of the module `xp`, numpy or torch.
    """
    untimed = xp.ones_like(features[:, 0, complete.shape[1] :], dtype=xp.bool)
    mask = fibre_mask[:, :, None] & xp.concat([complete, untimed], axis=1)[:, None]
    # Masked features are replaced, not multiplied, by 0, since they may be NaN.
    masked = xp.where(mask, features, 0.0).reshape(-1, features.shape[1] * features.shape[2])
    return xp.concat([masked, fibre_mask, complete], axis=1)


def forward(weights: Mapping[str, Any], x: Any, xp: Any = np) -> Any:
    """Return (E, Q, 2 N) targets and log errors for (Q, I) inputs; log errors of the published network are 0.

    All arrays are of the module `xp`, numpy or torch.
    """
    h = x @ weights["first.w"] + weights["first.b"]
    if "hidden.w" not in weights:
        targets = xp.tanh(h) @ weights["last.w"] + weights["last.b"]
        return xp.concat([targets, xp.zeros_like(targets)], axis=2)
    for layer in range(len(weights["hidden.w"])):
        h = h + _activate(h, xp) @ weights["hidden.w"][layer] + weights["hidden.b"][layer]
    return _activate(h, xp) @ weights["last.w"] + weights["last.b"]


Networks = Mapping[str, Weights]  # networks by phase, see `moments.PHASES`


def predict_members(
    networks: Networks,
    presses: ScaledFeatures,
    bayes: Sequence[BayesianLocalizer] = (),
    residual_network: Weights = MappingProxyType({}),
) -> Floats:
    """Return the outputs (E, Q, 2 N) of the members that answer for presses with equally many complete windows.

    With `bayes`, the last member is the Bayesian localizer of the stage, corrected by the residual network.
    """
    n_complete, n_timed = int(presses.complete[:1].sum()), presses.n_timed
    is_published = "hidden.w" not in next(iter(networks.values()))
    x = (
        presses.inputs.reshape(len(presses), -1)
        if is_published
        else network_inputs(presses.inputs, presses.fibre_mask, presses.complete)
    )
    names = active_networks(networks, n_complete, n_timed, bool(bayes))
    outputs = [forward(networks[name], x) for name in names if name != RESIDUAL]
    if RESIDUAL in names:
        localizer = bayes[bayes_stage(n_complete, n_timed) or 0]
        position, summary = localizer.predict(presses.inputs.astype(np.float64), presses.fibre_mask)
        outputs.append(forward(residual_network, np.concatenate([x, summary.astype(np.float32)], axis=1)))
        outputs[-1][:, :, :2] += position
    return np.concatenate(outputs)


def predict(
    networks: Networks,
    presses: ScaledFeatures,
    bayes: Sequence[BayesianLocalizer] = (),
    residual_network: Weights = MappingProxyType({}),
    sliding: "Sliding | None" = None,
) -> tuple[Floats, Floats, Mask]:
    """Predict presses at any moments, those of sliding fingers by `SLIDE_NETWORK`.

    Returns:
        Scaled targets (Q, N) and their standard deviations, 0 where no window is complete; and whether a finger has
        slid (Q,).
    """
    n_complete = presses.n_complete
    first = next(iter(networks.values()))
    n_targets = first["last.w"].shape[2] // (2 if "hidden.w" in first else 1)
    targets, std = np.zeros((2, len(presses), n_targets), np.float32)
    for count in np.unique(n_complete).tolist():
        if count or not presses.n_timed:
            rows = np.flatnonzero(n_complete == count)
            outputs = predict_members(networks, presses[rows], bayes, residual_network)
            targets[rows], std[rows] = combine_members(outputs)
    slid = np.zeros(len(presses), bool)
    rows = np.flatnonzero(n_complete >= N_PRESS_WINDOWS)
    if sliding is not None and len(rows):
        tracked = sliding.follow(presses[rows])
        slid[rows] = tracked.distance > SLIDE_THRESHOLD
        targets[slid], std[slid] = tracked.targets[slid[rows]], tracked.std[slid[rows]]
    return targets, std, slid


class TrackedFinger(NamedTuple):
    """Latest position of a finger by `SLIDE_NETWORK`, and how far it has slid."""

    targets: Floats  # (Q, N), scaled
    std: Floats  # (Q, N)
    distance: Floats  # (Q,) from the position at `EARLY_WINDOWS`, in standard deviations of that one


@dataclass(frozen=True)
class Sliding:
    """Tracking of sliding fingers."""

    weights: Weights  # of `SLIDE_NETWORK`
    # (C, len(LATEST_WINDOWS), len(PRESS_WINDOWS)), see `FeatureScaler.latest_window_map`
    latest_factor: Floats
    latest_offset: Floats

    def follow(self, presses: ScaledFeatures) -> TrackedFinger:
        """Track the finger of presses whose touch is complete."""
        n_timed = presses.n_timed

        def predict_from(features: Floats, n_complete: int) -> tuple[Floats, Floats]:
            complete = presses.complete & (np.arange(n_timed) < n_complete)
            return combine_members(forward(self.weights, network_inputs(features, presses.fibre_mask, complete)))

        targets, std = predict_from(presses.inputs, N_PRESS_WINDOWS)
        # At `EARLY_WINDOWS`, the latest windows were the last of these, which are single readings.
        early = presses.inputs.copy()
        for k in range(len(LATEST_WINDOWS)):
            window = EARLY_WINDOWS - 1 - k
            factor, offset = self.latest_factor[:, k, window], self.latest_offset[:, k, window]
            early[:, :, n_timed + k] = early[:, :, window] * factor + offset
        early_targets, early_std = predict_from(early, EARLY_WINDOWS)
        distance = np.hypot(*(targets - early_targets)[:, :2].T)
        distance = distance / np.maximum(np.hypot(*early_std[:, :2].T), np.float32(1e-9))
        return TrackedFinger(targets, std, distance)


def combine_members(outputs: Any, xp: Any = np) -> tuple[Any, Any]:
    """Combine (E, Q, 2 N) outputs by inverse variances; return (Q, N) targets and standard deviations, scaled.

    The error of a member is taken as Laplace distributed, with the variance 2 b^2 for the mean absolute error b.
    Members are weighted press by press, equally in x and y. Their disagreement adds to the variance (Lakshminarayanan
    et al. 2017, Simple and scalable predictive uncertainty estimation using deep ensembles). All arrays are of the
    module `xp`, numpy or torch.
    """
    n_targets = outputs.shape[2] // 2
    targets, log_errors = outputs[:, :, :n_targets], outputs[:, :, n_targets:]
    variance = 2 * xp.exp(2 * xp.clip(log_errors, MIN_LOG_ERROR, MAX_LOG_ERROR))
    xy_variance = variance[:, :, :2].mean(axis=2, keepdims=True)
    precision = 1 / xp.concat([xy_variance, xy_variance, variance[:, :, 2:]], axis=2)
    weight = precision / precision.sum(axis=0)
    mean = (weight * targets).sum(axis=0)
    return mean, xp.sqrt((weight * (variance + (targets - mean) ** 2)).sum(axis=0))


def stack_members(members: list[Weights]) -> Weights:
    """Stack the weights of networks of one size into an ensemble."""
    return {name: np.concatenate([member[name] for member in members], axis=_axis(name)) for name in members[0]}


def unstack_members(weights: Weights) -> list[Weights]:
    """Return the weights of each member of an ensemble, as ensembles of one."""
    members = range(len(weights["last.b"]))
    return [{name: np.take(array, [k], axis=_axis(name)) for name, array in weights.items()} for k in members]


def _axis(name: str) -> int:
    """Axis of the members in an array of `Weights`."""
    return 1 if name.startswith("hidden") else 0


def _activate(h: Any, xp: Any) -> Any:
    h = h - h.mean(axis=-1, keepdims=True)
    return xp.clip(h / xp.sqrt((h * h).mean(axis=-1, keepdims=True) + EPSILON), 0.0, None)
