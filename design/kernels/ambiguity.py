"""The ambiguity of every place under every loss of fibres, exactly, without the pairs of presses that add nothing."""

import math
from typing import Any

import numpy as np
from numba import njit

MAX_NEG_LOG_LIKELIHOOD = 20.0
"""A press that far off in -log of the likelihood (2e-9 of that of the place itself) is not taken for another one."""
_IN_FACTORS = 300.0
"""Up to here exp(-sum) is the product of the terms' own, without any that is beyond what numbers hold."""


@njit(cache=True, error_model="numpy", nogil=True)
def ambiguity_by_place(signals: Any, presses: Any, lost: Any) -> Any:
    """(Q, L) sum_b w_ab |p_a - p_b| of `padforge.design.objectives.score` for every press a and every loss.

    Args:
        signals: (Q, F) divided by twice their noise. presses: (Q, 2).
        lost: (L, K) indices of the fibres lost, F where there are fewer than K.
    """
    count, fibres = signals.shape
    losses, most = lost.shape
    out, weight = np.zeros((count, losses)), np.ones((count, losses))
    apart, factor, largest = np.zeros(fibres + 1), np.ones(fibres + 1), np.empty(most)
    likelihood = np.empty(losses)
    for a in range(count):
        for b in range(a):
            total = 0.0
            largest[:] = 0.0
            for f in range(fibres):
                square = (signals[a, f] - signals[b, f]) ** 2
                apart[f] = square
                total += square
                for k in range(most):  # the largest stand first
                    if square > largest[k]:
                        square, largest[k] = largest[k], square
            if total - largest.sum() > MAX_NEG_LOG_LIKELIHOOD:  # whatever is lost
                continue
            if total < _IN_FACTORS:
                factor[:fibres] = np.exp(apart[:fibres])
                whole = math.exp(-total)
                for k in range(losses):
                    likelihood[k] = whole
                    for j in range(most):
                        likelihood[k] *= factor[lost[k, j]]
            else:
                for k in range(losses):
                    left = total
                    for j in range(most):
                        left -= apart[lost[k, j]]
                    likelihood[k] = math.exp(-left)
            distance = math.hypot(presses[a, 0] - presses[b, 0], presses[a, 1] - presses[b, 1])
            for at in (a, b):
                for k in range(losses):
                    weight[at, k] += likelihood[k]
                    out[at, k] += likelihood[k] * distance
    return out / weight
