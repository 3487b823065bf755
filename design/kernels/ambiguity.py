"""Ambiguity of every position under every set of failed fibres, exactly, skipping pairs of presses that add nothing."""

import math
from typing import Any

import numpy as np
from numba import njit

MAX_NEG_LOG_LIKELIHOOD = 20.0
"""Negative log-likelihood from which a press is not confused with another (likelihood 2e-9)."""
_MAX_EXPONENT = 300.0
"""Up to here exp(-sum) is computed as a product of the factors without overflow."""


@njit(cache=True, error_model="numpy", nogil=True)
def compute_ambiguity(signals: Any, presses: Any, failed: Any) -> Any:
    """Compute sum_b w_ab |p_a - p_b| (`padforge.design.objectives.score`) for every press a and every set of failures.

    Args:
        signals: signals divided by twice their noise; shape (Q, F).
        presses: x and y; shape (Q, 2).
        failed: indices of failed fibres, F where there are fewer than K; shape (L, K).

    Returns:
        Ambiguity; shape (Q, L), grid units.
    """
    count, fibres = signals.shape
    sets, max_failed = failed.shape
    out, weight = np.zeros((count, sets)), np.ones((count, sets))
    squares, factor, largest = np.zeros(fibres + 1), np.ones(fibres + 1), np.empty(max_failed)
    likelihood = np.empty(sets)
    for a in range(count):
        for b in range(a):
            total = 0.0
            largest[:] = 0.0
            for f in range(fibres):
                square = (signals[a, f] - signals[b, f]) ** 2
                squares[f] = square
                total += square
                for k in range(max_failed):  # keeps the largest ones, descending
                    if square > largest[k]:
                        square, largest[k] = largest[k], square
            if total - largest.sum() > MAX_NEG_LOG_LIKELIHOOD:  # whichever fibres fail
                continue
            if total < _MAX_EXPONENT:
                factor[:fibres] = np.exp(squares[:fibres])
                intact = math.exp(-total)
                for k in range(sets):
                    likelihood[k] = intact
                    for j in range(max_failed):
                        likelihood[k] *= factor[failed[k, j]]
            else:
                for k in range(sets):
                    remaining = total
                    for j in range(max_failed):
                        remaining -= squares[failed[k, j]]
                    likelihood[k] = math.exp(-remaining)
            distance = math.hypot(presses[a, 0] - presses[b, 0], presses[a, 1] - presses[b, 1])
            for at in (a, b):
                for k in range(sets):
                    weight[at, k] += likelihood[k]
                    out[at, k] += likelihood[k] * distance
    return out / weight
