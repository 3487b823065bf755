"""Information measures of a pad's signals (paper, section II-C): quantisation, joint entropy, sharpness, disorder."""

import numpy as np
from numpy.typing import NDArray

from .kernels.pchip import sample_curves

LEVELS = 4096
"""Levels of the published 12-bit converter."""

Array = NDArray[np.float64]


def quantize(signals: Array, levels: int = LEVELS) -> Array:
    """Signals (Q, C) as converter levels 0..levels: each column scaled to its range, then rounded up.

    A column without range, such as a fibre no press touches, is 0 throughout.
    """
    if len(signals) == 0:
        return signals.copy()
    low = signals.min(axis=0)
    span = signals.max(axis=0) - low
    return np.ceil(np.divide(signals - low, span, out=np.zeros_like(signals), where=span > 0) * levels)


def joint_entropy(levels: Array) -> float:
    """Joint entropy in bits of the rows of (Q, C): at most log2 Q, reached where all rows differ."""
    if levels.size == 0:
        return 0.0
    _, counts = np.unique(levels, axis=0, return_counts=True)
    share = counts / counts.sum()
    return float(max(0.0, -(share * np.log2(share)).sum()))


def sharpness(levels: Array) -> float:
    """Z of formula (4): sum over columns of |second difference| along the press order."""
    return float(np.abs(np.diff(levels, 2, axis=0)).sum())


def disorder(knots: Array, samples: int = 2000) -> Array:
    """C: how much fibres of a family stand in the wrong order, as the published code counts it.

    For every pair i < j of a family the negative parts of curve_j - curve_i are summed over `samples` points, so C
    grows with `samples`.

    Args:
        knots: (..., 2M, N+2, 2).

    Returns:
        (...) sums in grid units.
    """
    grid = knots.shape[-3] // 2
    batch = np.ascontiguousarray(knots.reshape(-1, *knots.shape[-3:]))
    curves = sample_curves(batch, samples).reshape(len(batch), 2, grid, samples)
    total = np.zeros(len(batch))
    for i in range(grid):
        total -= np.minimum(curves[:, :, i + 1 :] - curves[:, :, i : i + 1], 0).sum(axis=(1, 2, 3))
    return total.reshape(knots.shape[:-3])
