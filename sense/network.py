"""The network of the localizer, in NumPy: what it computes, apart from how it is trained.

Masked inputs enter together with the mask, so one network serves every set of lost fibres. A first layer leads to
residual layers h + gelu(normalised h) W + b, and a normalised last one to two coordinates. Members of an ensemble
are stacked along the first axis of every array.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from design.errors import InputError

Floats = NDArray[np.float32]
Weights = Mapping[str, Floats]
"""`first.w` (E, D, H), `first.b` (E, 1, H), `hidden.w` (L, E, H, H), `hidden.b` (L, E, 1, H), `last.w` (E, H, 2) and
`last.b` (E, 1, 2), for E members, D inputs, H hidden units and L residual layers."""

EPSILON = 1e-5
"""Added to the variance that a layer is normalised by."""
MAX_WEIGHT = 1e4
"""Greatest weight of a sound network, far above any that training ends with; no sum of a pass overflows below it."""


def refuse_unsound(weights: Weights, entries: int) -> None:
    """Raise InputError unless `weights` are those of a network that takes `entries` numbers, and all of them sane."""
    found = {name: weight.shape for name, weight in weights.items()}
    first, layers = found.get("first.w", ()), found.get("hidden.w", ())[:1]
    if len(first) != 3 or len(layers) != 1 or 0 in first:
        raise InputError(f"weights have shapes {found}, expected first.w (E, D, H), hidden.w (L, E, H, H) and others")
    members, _, hidden = first
    expected = {
        "first.w": (members, entries, hidden),
        "first.b": (members, 1, hidden),
        "hidden.w": (*layers, members, hidden, hidden),
        "hidden.b": (*layers, members, 1, hidden),
        "last.w": (members, hidden, 2),
        "last.b": (members, 1, 2),
    }
    if found != expected:
        raise InputError(f"weights have shapes {found}, expected {expected}")
    for name, weight in weights.items():
        greatest = np.abs(weight).max(initial=0)
        if weight.dtype != np.float32 or not greatest <= MAX_WEIGHT:
            raise InputError(
                f"weights {name} are {weight.dtype} up to {greatest:g}, allowed is float32 up to {MAX_WEIGHT:g}"
            )


def masked(inputs: Floats, alive: NDArray[np.bool_]) -> Floats:
    """What enters the network: the inputs of the living fibres, zeros for the lost, then the mask.

    Args:
        inputs: (Q, C, F) scaled inputs. alive: (C,) or (Q, C).

    Returns:
        (Q, C F + C). A lost fibre's inputs are replaced, not multiplied: not even NaN gets through.
    """
    alive = np.broadcast_to(alive, inputs.shape[:2])
    kept = np.where(alive[:, :, None], inputs, np.float32(0))
    return np.concatenate([kept.reshape(len(inputs), -1), alive.astype(np.float32)], axis=1)


def forward(weights: Weights, x: Floats) -> Floats:
    """(Q, D) entries to (E, Q, 2) places in units of the localizer's span."""
    h = x @ weights["first.w"] + weights["first.b"]
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + _gelu(_normalised(h)) @ w + b
    return _gelu(_normalised(h)) @ weights["last.w"] + weights["last.b"]


def _gelu(x: Floats) -> Floats:
    return x * np.float32(0.5) * (1 + erf(x * np.float32(np.sqrt(0.5))))


def _normalised(x: Floats) -> Floats:
    x = x - x.mean(axis=-1, keepdims=True)
    return x / np.sqrt((x * x).mean(axis=-1, keepdims=True) + np.float32(EPSILON))
