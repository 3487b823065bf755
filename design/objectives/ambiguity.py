"""Localisation ambiguity: how far away the presses lie that noise makes a press be taken for.

With signals s_a of presses a at positions p_a, and the set K of fibres that work, press a is read as b with the
posterior

    w_ab = exp(-|s_a - s_b|^2_K / 4 sigma^2) / sum_c exp(-|s_a - s_c|^2_K / 4 sigma^2),
    A_K = mean_a sum_b w_ab |p_a - p_b|.

4 sigma^2, and not 2 sigma^2, since both readings are noisy.
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

SIDE, MAX_SUBSETS = 20, 64
"""Presses along a side of the grid, and sets of failed fibres of a size."""
AMBIGUITY_NOISE = 0.05
"""Of a signal, share of full scale, under which pads are compared: under less, no good pad confuses anything."""
MAX_NEG_LOG_LIKELIHOOD = 20.0
"""Beyond it (2e-9 of the likelihood of the press itself) a press is not taken for another one."""
MAX_EXPONENT = 300.0
"""Up to here exp(-sum) is the product of the exponentials, without overflow."""


def free_presses(size: PadSettings) -> Array:
    """Return (Q, 2) up to SIDE x SIDE positions over what is pressed, grid units, in no keep-out; refuse if none is."""
    presses = grid_positions(size.sensed, SIDE)
    presses = presses[is_outside(presses, size)]
    if not len(presses):
        raise InputError("[pad] keep_out_mm covers all that is pressed ([pad] sensed_mm), allowed is a part of it")
    return presses


def ambiguities(
    pad: Morphology, contact: Contact, max_failures: int | tuple[float, ...], noise: float, size: PadSettings
) -> list[float]:
    """Compute the ambiguity, grid units, with 0, 1, ... fibres failed on a grid of presses; noise in full scales."""
    presses = free_presses(size)
    return _by_press(relative_stretch(pad, presses, contact), presses, max_failures, noise).mean(axis=1).tolist()


def ambiguity_map(
    pad: Morphology, presses: Array, contact: Contact, max_failures: int | tuple[float, ...], noise: float
) -> Array:
    """Compute the ambiguity (K, Q), grid units, of every press with 0, 1, ... K - 1 fibres failed, fast enough to edit.

    Each of the `presses` (Q, 2) may be taken for any other. Signals have the precision of a search; `noise` is a share
    of full scale.
    """
    stretch = signals(pad, presses, contact, precision=search_precision(contact)) / lengths(pad)
    return _by_press(stretch, presses, max_failures, noise)


def _by_press(stretch: Array, presses: Array, max_failures: int | tuple[float, ...], noise: float) -> Array:
    """Return the ambiguity (K, Q), of relative stretches (Q, F), with noise in means of the fibres' largest ones."""
    largest = stretch.max(axis=0)
    scale = largest[largest > 0].mean() if largest.any() else 1.0
    fibres = stretch.shape[1]
    most = min(len(failure_shares(max_failures)), fibres) - 1
    subsets = [failure_subsets(fibres, n_failed, MAX_SUBSETS) for n_failed in range(most + 1)]
    # rows of equal length, filled up with F
    failed = np.array([(*row, *(fibres,) * (most - len(row))) for level in subsets for row in level], dtype=np.int64)
    values = press_ambiguities(np.ascontiguousarray(stretch / (2 * noise * scale)), presses, failed)
    ends = np.cumsum([len(level) for level in subsets])
    return np.stack([level.mean(axis=1) for level in np.split(values, ends[:-1], axis=1)])


@kernel
def press_ambiguities(signals: Any, presses: Any, failed: Any) -> Any:
    """Compute sum_b w_ab |p_a - p_b| (Q, L) exactly, without the pairs of presses that add nothing.

    `signals` (Q, F) are divided by twice their noise; `failed` (L, K) are indices of failed fibres, F where fewer fail.
    """
    count, fibres = signals.shape
    sets, most = failed.shape
    out, weight = np.zeros((count, sets)), np.ones((count, sets))
    square, factor, largest = np.zeros(fibres + 1), np.ones(fibres + 1), np.empty(most)
    likelihood = np.empty(sets)
    for a in range(count):
        for b in range(a):
            # 1. squared distance of the signals, and its `most` largest terms in descending order
            total = 0.0
            largest[:] = 0.0
            for f in range(fibres):
                term = (signals[a, f] - signals[b, f]) ** 2
                square[f] = term
                total += term
                for k in range(most):
                    if term > largest[k]:
                        term, largest[k] = largest[k], term
            least = total
            for k in range(most):
                least -= largest[k]
            if least > MAX_NEG_LOG_LIKELIHOOD:  # whichever fibres fail
                continue
            # 2. likelihood without the terms of the failed fibres
            if total < MAX_EXPONENT:
                for f in range(fibres):
                    factor[f] = math.exp(square[f])
                product = math.exp(-total)
                for k in range(sets):
                    likelihood[k] = product
                    for j in range(most):
                        likelihood[k] *= factor[failed[k, j]]
            else:
                for k in range(sets):
                    remaining = total
                    for j in range(most):
                        remaining -= square[failed[k, j]]
                    likelihood[k] = math.exp(-remaining)
            # 3. both presses of the pair
            distance = math.hypot(presses[a, 0] - presses[b, 0], presses[a, 1] - presses[b, 1])
            for press in (a, b):
                for k in range(sets):
                    weight[press, k] += likelihood[k]
                    out[press, k] += likelihood[k] * distance
    return out / weight
