"""The networks of the localizer, in NumPy: what they compute, apart from how they are trained.

Of the method "ensemble": masked inputs enter together with the mask, so one network serves every set of lost fibres. A
first layer leads to residual layers h + gelu(normalised h) W + b, and a normalised last one to two coordinates, to what
else is learnt of a press, and to the logarithms of the expected errors of all these. Members of an ensemble are stacked
along the first axis of every array. Of the method "published": one layer of tanh neurons leads to two coordinates."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array, Floats, Mask

Weights = Mapping[str, Floats]
"""`first.w` (E, D, H), `first.b` (E, 1, H), `hidden.w` (L, E, H, H), `hidden.b` (L, E, 1, H), `last.w` (E, H, 2 N) and
`last.b` (E, 1, 2 N), for E members, D inputs, H hidden units, L residual layers and N numbers learnt, the first of them
x and y; of the published network, E = 1, no `hidden`, and 2 in place of 2 N."""

Observing = Callable[[Array, Mask], tuple[Array, Array]]
"""From (Q, C, F) inputs and (Q, C) which count to (Q, 2) places, and (Q, T) what their corrector is told."""

OUTPUTS = 4
"""x, y, and the logarithms of the mean absolute errors expected of them, all in units of the localizer's span. What
else is learnt follows y, in units of its own span, and its logarithms follow theirs."""
EPSILON = 1e-5
"""Added to the variance that a layer is normalised by."""
LEAST_LOG, MOST_LOG = -9.0, 2.0
"""Range of the logarithms of expected errors: from a ten-thousandth of the span to the whole pad and more."""
MAX_WEIGHT = 1e4
"""Greatest weight of a sound network, far above any that training ends with; no sum of a pass overflows below it."""


def refuse_unsound(weights: Weights, entries: int, method: str, measures: int = 0) -> None:
    """Raise InputError unless `weights` are those of a network that takes `entries` numbers, and all of them sane.

    Args:
        measures: how many numbers it gives beside the place, each with an expected error.
    """
    found = {name: weight.shape for name, weight in weights.items()}
    first, layers = found.get("first.w", ()), found.get("hidden.w", (0,))[:1]
    if len(first) != 3 or len(layers) != 1 or 0 in first:
        raise InputError(f"weights have shapes {found}, expected first.w (E, D, H) and others")
    members, _, hidden = first
    outputs = OUTPUTS + 2 * measures if method == "ensemble" else 2
    expected = {
        "first.w": (members, entries, hidden),
        "first.b": (members, 1, hidden),
        "last.w": (members, hidden, outputs),
        "last.b": (members, 1, outputs),
    }
    if method == "ensemble":
        expected |= {"hidden.w": (*layers, members, hidden, hidden), "hidden.b": (*layers, members, 1, hidden)}
    if found != expected:
        raise InputError(f"weights have shapes {found}, expected {expected}")
    for name, weight in weights.items():
        greatest = np.abs(weight).max(initial=0)
        if weight.dtype != np.float32 or not greatest <= MAX_WEIGHT:
            raise InputError(
                f"weights {name} are {weight.dtype} up to {greatest:g}, allowed is float32 up to {MAX_WEIGHT:g}"
            )


def masked(inputs: Floats, fibre_mask: Mask) -> Floats:
    """What enters the network: the inputs of the living fibres, zeros for the lost, then the mask.

    Args:
        inputs: (Q, C, F) scaled inputs. fibre_mask: (C,) or (Q, C).

    Returns:
        (Q, C F + C). A lost fibre's inputs are replaced, not multiplied: not even NaN gets through.
    """
    fibre_mask = np.broadcast_to(fibre_mask, inputs.shape[:2])
    kept = np.where(fibre_mask[:, :, None], inputs, np.float32(0))
    return np.concatenate([kept.reshape(len(inputs), -1), fibre_mask.astype(np.float32)], axis=1)


def forward(weights: Weights, x: Floats) -> Floats:
    """(Q, D) entries to (E, Q, 2 N): what is learnt and logarithms of expected errors, see `OUTPUTS`.

    The published network expects the same error of every press, which is called 1.
    """
    h = x @ weights["first.w"] + weights["first.b"]
    if "hidden.w" not in weights:
        places = np.tanh(h) @ weights["last.w"] + weights["last.b"]
        return np.concatenate([places, np.zeros_like(places)], axis=2)
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + _gelu(_normalised(h)) @ w + b
    return _gelu(_normalised(h)) @ weights["last.w"] + weights["last.b"]


def learnt(
    weights: Weights,
    inputs: Floats,
    fibre_mask: Mask,
    method: str = "ensemble",
    bayes: Observing | None = None,
    residual_network: Weights = MappingProxyType({}),
) -> Floats:
    """(E, Q, 2 N) what the members give of Q presses, see `network.forward`, the corrected observer as the last.

    Args:
        inputs: (Q, C, F + G) scaled. fibre_mask: (Q, C).
    """
    entries = inputs.reshape(len(inputs), -1) if method == "published" else masked(inputs, fibre_mask)
    outputs = forward(weights, entries)
    if bayes is None:
        return outputs
    place, told = bayes(inputs.astype(np.float64), fibre_mask)
    corrected = forward(residual_network, np.concatenate([entries, told.astype(np.float32)], axis=1))
    corrected[:, :, :2] += place
    return np.concatenate([outputs, corrected])


def pooled(outputs: Floats) -> tuple[Floats, Floats]:
    """(E, Q, 2 N) outputs of all members to (Q, N) numbers learnt and their standard deviations, in units of spans.

    A member's error is taken as Laplace distributed, of variance 2 b^2 for the mean absolute error b. A member counts
    by the inverse of that, press by press, as much in x as in y; the spread of the members adds to it (Lakshminarayanan
    et al. 2017, Simple and scalable predictive uncertainty).
    """
    learnt, logs = np.split(outputs, 2, axis=2)
    variance = 2 * np.exp(2 * np.clip(logs, LEAST_LOG, MOST_LOG))
    doubt = variance.copy()
    doubt[:, :, :2] = variance[:, :, :2].mean(axis=2, keepdims=True)
    share = 1 / doubt / (1 / doubt).sum(axis=0)
    mean = (share * learnt).sum(axis=0)
    return mean, np.sqrt((share * (variance + (learnt - mean) ** 2)).sum(axis=0))


_ERF = (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429)
_ERF_WIDTH = 0.3275911


def _gelu(x: Floats) -> Floats:
    """x Phi(x), with the error function to 1.5e-7 (M. Abramowitz and I. A. Stegun, 1964, 7.1.26), a few roundings."""
    half = np.abs(x) * np.float32(np.sqrt(0.5))
    t = 1 / (1 + np.float32(_ERF_WIDTH) * half)
    tail = np.float32(_ERF[4]) * t
    for term in _ERF[3::-1]:
        tail = (tail + np.float32(term)) * t
    tail *= np.exp(-half * half)
    return (np.float32(0.5) * (x + np.abs(x) * (1 - tail))).astype(np.float32, copy=False)


def _normalised(x: Floats) -> Floats:
    x = x - x.mean(axis=-1, keepdims=True)
    return x / np.sqrt((x * x).mean(axis=-1, keepdims=True) + np.float32(EPSILON))
