"""Localisation ambiguity: the mean distance between a press and those that it is confused with because of noise.

For presses a with the signals s_a and the positions p_a, and the set K of working fibres, the posterior probability of
b given a, and the ambiguity, are

    w_ab = exp(-|s_a - s_b|^2_K / 4 sigma^2) / sum_c exp(-|s_a - s_c|^2_K / 4 sigma^2),
    A_K = mean_a sum_b w_ab |p_a - p_b|.

The exponents have 4 sigma^2 instead of 2 sigma^2 since both readings are noisy.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.common.validation import InputError
from padforge.design.contact import grid_positions, relative_stretch, search_precision, signals
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.fibre_loss import failure_shares, failure_subsets
from padforge.design.paths.curves import lengths
from padforge.design.paths.keep_outs import is_outside
from padforge.design.settings import Contact, PadSettings

AMBIGUITY_NOISE = 0.05
"""Noise of signals, relative to full scale, for comparing pads: with less, no good pad confuses any presses."""
MAX_NEG_LOG_LIKELIHOOD = 20.0  # presses are not confused if their likelihood ratio is below exp(-20) = 2e-9
MAX_EXPONENT = 300.0
"""Up to this sum of squares, a likelihood may be computed as a product of exponentials without overflow."""


def free_presses(pad_settings: PadSettings) -> Array:
    """Return the positions (Q, 2), grid units, of a 20 x 20 grid over the pressed rectangle that no keep-out covers."""
    presses = grid_positions(pad_settings.sensed, side=20)
    presses = presses[is_outside(presses, pad_settings)]
    if not len(presses):
        raise InputError("[pad] keep_out_mm covers all that is pressed ([pad] sensed_mm), allowed is a part of it")
    return presses


def ambiguities(
    pad: Morphology, contact: Contact, max_failures: int | tuple[float, ...], noise: float, pad_settings: PadSettings
) -> list[float]:
    """Compute the ambiguity, grid units, with 0, 1, ... fibres failed, on a grid of presses."""
    presses = free_presses(pad_settings)
    return _by_press(relative_stretch(pad, presses, contact), presses, max_failures, noise).mean(axis=1).tolist()


def ambiguity_map(
    pad: Morphology, presses: Array, contact: Contact, max_failures: int | tuple[float, ...], noise: float
) -> Array:
    """Compute the ambiguity (K, Q), grid units, of every press with 0, 1, ... K - 1 fibres failed.

    Each of the `presses` (Q, 2) may be confused with any other. Signals have the precision of a search, so that the map
    can follow an editor. `noise` is relative to full scale.
    """
    stretch = signals(pad, presses, contact, precision=search_precision(contact)) / lengths(pad)
    return _by_press(stretch, presses, max_failures, noise)


def _by_press(stretch: Array, presses: Array, max_failures: int | tuple[float, ...], noise: float) -> Array:
    """Return the ambiguity (K, Q) for relative stretches (Q, F), whose full scale is the mean maximum of the fibres."""
    maxima = stretch.max(axis=0)
    full_scale = maxima[maxima > 0].mean() if maxima.any() else 1.0
    fibres = stretch.shape[1]
    n_most = min(len(failure_shares(max_failures)), fibres) - 1
    subsets = [failure_subsets(fibres, n_failed, max_subsets=64) for n_failed in range(n_most + 1)]
    padded = [(*row, *(fibres,) * (n_most - len(row))) for level in subsets for row in level]  # to rows of equal length
    values = press_ambiguities(
        np.ascontiguousarray(stretch / (2 * noise * full_scale)), presses, np.array(padded, dtype=np.int64)
    )
    ends = np.cumsum([len(level) for level in subsets])
    return np.stack([level.mean(axis=1) for level in np.split(values, ends[:-1], axis=1)])


@kernel
def press_ambiguities(signals: Any, presses: Any, failed: Any) -> Any:
    """Compute sum_b w_ab |p_a - p_b| (Q, L) for each press a and each set of failed fibres, grid units.

    Signals (Q, F) are divided by twice their noise, presses (Q, 2) in grid units; `failed` (L, K) are the indices of
    the failed fibres of each set, filled up with F. Pairs of negligible likelihood are skipped.
    """
    count, fibres = signals.shape
    sets, max_failures = failed.shape
    out, weight = np.zeros((count, sets)), np.ones((count, sets))
    square, factor, largest = np.zeros(fibres + 1), np.ones(fibres + 1), np.empty(max_failures)
    likelihood = np.empty(sets)
    for a in range(count):
        for b in range(a):
            # 1. squared distance of the signals, and its `max_failures` largest terms in descending order
            total = 0.0
            largest[:] = 0.0
            for f in range(fibres):
                term = (signals[a, f] - signals[b, f]) ** 2
                square[f] = term
                total += term
                for k in range(max_failures):
                    if term > largest[k]:
                        term, largest[k] = largest[k], term
            min_remaining = total
            for k in range(max_failures):
                min_remaining -= largest[k]
            if min_remaining > MAX_NEG_LOG_LIKELIHOOD:  # whichever fibres fail
                continue
            # 2. likelihood without the terms of the failed fibres
            if total < MAX_EXPONENT:
                for f in range(fibres):
                    factor[f] = math.exp(square[f])
                product = math.exp(-total)
                for k in range(sets):
                    likelihood[k] = product
                    for j in range(max_failures):
                        likelihood[k] *= factor[failed[k, j]]
            else:
                for k in range(sets):
                    remaining = total
                    for j in range(max_failures):
                        remaining -= square[failed[k, j]]
                    likelihood[k] = math.exp(-remaining)
            # 3. both presses of the pair
            distance = math.hypot(presses[a, 0] - presses[b, 0], presses[a, 1] - presses[b, 1])
            for press in (a, b):
                for k in range(sets):
                    weight[press, k] += likelihood[k]
                    out[press, k] += likelihood[k] * distance
    return out / weight
