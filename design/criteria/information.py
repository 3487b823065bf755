"""Information measures of a pad's signals (paper, section II-C): quantisation, joint entropy, sharpness, disorder."""

import numpy as np
from numpy.typing import NDArray
from padforge.design.pad.contact import fibre_axes, signals
from padforge.design.pad.kernels.pchip import population_slopes, sample_curves
from padforge.design.pad.kernels.published import information as kernels
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Contact, between_fibres
from padforge.design.settings.search import LEVELS


def quantize(signals: Array, levels: int = LEVELS) -> Array:
    """Signals (Q, C) as converter levels 0..levels: each column scaled to its range, then rounded up.

    A column without range, such as a fibre no press touches, is 0 throughout.
    """
    out = np.zeros(signals.shape)
    if len(signals):
        kernels.to_levels(np.asarray(signals, dtype=np.float64), levels, out)
    return out


def joint_entropy(levels: Array) -> float:
    """Joint entropy in bits of the rows of (Q, C), whole numbers: at most log2 Q, reached where all rows differ."""
    return float(kernels.row_entropy(np.asarray(levels, dtype=np.float64), 0, levels.shape[1]))


def published_sharpness(levels: Array) -> float:
    """Z of formula (4): sum over columns of |second difference| along the press order."""
    return float(kernels.second_differences(np.asarray(levels, dtype=np.float64)))


def disorder(knots: Array, samples: int = 2000) -> float:
    """C: how much fibres of a family stand in the wrong order, as the published code counts it.

    For every pair i < j of a family the negative parts of curve_j - curve_i are summed over `samples` points, so C
    grows with `samples`; `disorder_area` is what it samples.

    Args:
        knots: (2M, N+2, 2) of a square pad.

    Returns:
        The sum, in grid units.
    """
    grid = len(knots) // 2
    return float(kernels.disorder(sample_curves(knots[None], grid, samples)[0], grid))


def disorder_area(pad: Morphology) -> float:
    """Area, in squared grid units, by which fibres of a family stand in the wrong order: C without its sampling.

    The sum over pairs i < j of a family of the integral of max(curve_i - curve_j, 0), exact on the PCHIP curves;
    `disorder` approaches it times (samples - 1) / (M + 1).
    """
    travel, cross, ends, _ = fibre_axes(pad)
    slopes = population_slopes(travel, cross)[0]
    return max(0.0, float(kernels.disorder_area(travel[0], cross[0], slopes, ends.horizontals)))


def idle_share(signals: Array, threshold: float = 0.0) -> float:
    """Share of presses in which a fibre is idle, over fibres and presses (paper, table III).

    Args:
        signals: (Q, C) changes from rest. threshold: share of a fibre's range over all presses that its change must
            exceed to count as active: 0 in simulation, 0.02 in the paper's experiment.
    """
    if signals.size == 0:
        return 0.0
    return float((np.abs(signals) <= threshold * np.ptp(signals, axis=0)).mean())


def information(pad: Morphology, contact: Contact | None = None, noise: float = 1.0, side: int = 20) -> float:
    """Mutual information, in bits, between the place of a press and the pad's noisy signals: a lower bound.

    The place is uniform between the outermost fibres, each signal carries Gaussian noise of `noise` counts of a
    converter whose LEVELS span the largest signal. What is pressed is cut into side x side cells; within a cell signals
    are linear in the place, so the signals of a cell are Gaussian with covariance C = sigma^2 I + J S J^T (J the
    signals' derivative, S the spread of a place in its cell) and those of the pad a mixture. With D the
    Bhattacharyya distance,

        I >= mean_a [ln det(C_a / sigma^2) / 2] - mean_a ln mean_b exp(-D_ab)    (in nats)

    (pairwise bound on the entropy of a mixture: Kolchinsky and Tracey, Entropy 2017, equation (10)).

    How it relates to the published measure: without the spread in a cell and without noise the second term alone is
    the joint entropy of the presses' signals, at most log2 of their number; the first term goes on where that ends.
    Two cells the pad cannot tell apart cost the same in both.

    Args:
        contact: what a press does to a fibre; the measured one if None. noise: converter counts, > 0.
        side: cells a side, at least 2.
    """
    low, high = (np.array(corner) for corner in between_fibres(pad.layout))
    x, y = ((np.arange(side) + 0.5) / side * (high - low)[axis] + low[axis] for axis in (0, 1))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    step = 1e-4
    around = (places[:, None] + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])).reshape(-1, 2)
    found = signals(pad, around, contact).reshape(len(places), 5, -1)
    found = found[..., found.any(axis=(0, 1))]  # fibres between the places, most of a large pad's, tell nothing
    if not found.size:
        return 0.0
    sigma = noise * found.max() / LEVELS
    mean = found[:, 0] / sigma
    cell = np.array([x[1] - x[0], y[1] - y[0]]) / np.sqrt(12)
    slope = (found[:, 1::2] - found[:, 2::2]).transpose(0, 2, 1)
    spread = cell / (2 * step * sigma) * slope  # (Q, F, 2)
    own = np.linalg.slogdet(np.eye(2) + np.einsum("aki,akj->aij", spread, spread))[1]
    blocks = [_mean_exponential(mean, spread, own, part) for part in np.array_split(np.arange(len(mean)), side)]
    return float((own.mean() / 2 - np.log(np.concatenate(blocks)).mean()) / np.log(2))


def _mean_exponential(mean: Array, spread: Array, own: Array, rows: NDArray[np.int64]) -> Array:
    """mean_b exp(-D_ab) for the cells a in `rows`: means (Q, C) and covariances I + spread spread^T, noise units.

    The mean covariance of two cells is I + W W^T with W = [spread_a, spread_b] / sqrt 2, four columns, so its
    determinant and inverse are those of a 4 x 4 matrix.
    """
    half = spread / np.sqrt(2)
    gap = mean[rows, None] - mean[None]
    inner = np.empty((*gap.shape[:2], 4, 4))  # I + W^T W, by blocks of the two cells
    alone = np.eye(2) + half.transpose(0, 2, 1) @ half
    inner[..., :2, :2], inner[..., 2:, 2:] = alone[rows, None], alone
    inner[..., :2, 2:] = np.tensordot(half[rows], half, axes=(1, 1)).transpose(0, 2, 1, 3)
    inner[..., 2:, :2] = inner[..., :2, 2:].swapaxes(-1, -2)
    along = np.concatenate([gap @ half[rows], (gap.swapaxes(0, 1) @ half).swapaxes(0, 1)], axis=-1)  # W^T gap
    square = (gap**2).sum(axis=-1) - (along * np.linalg.solve(inner, along[..., None])[..., 0]).sum(axis=-1)
    distance = square / 8 + (np.linalg.slogdet(inner)[1] - (own[rows, None] + own[None]) / 2) / 2
    return np.exp(-distance).mean(axis=1)
