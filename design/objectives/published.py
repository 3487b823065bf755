"""What a search minimises: the published objective, for the genetic search and for comparison."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.design.common.parallel import map_chunks
from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_array, check_int, check_type
from padforge.design.contact import (
    check_presses,
    check_samples,
    fibre_axes,
    grid_unit_mm,
    press_shape,
    serpentine_presses,
    signals,
)
from padforge.design.kernels import published as kernels
from padforge.design.kernels.pchip import population_slopes, sample_curves
from padforge.design.kernels.published import published_terms as terms_kernel
from padforge.design.morphology import Array, Morphology
from padforge.design.settings import (
    LEVELS,
    MAX_LEVELS,
    PUBLISHED_CONTACT,
    SIDE,
    WEIGHTS,
    Contact,
    Counts,
    Layout,
    between_fibres,
)


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


@dataclass(frozen=True)
class PublishedTerms:
    """The published objective and what it is made of.

    Attributes:
        entropy: joint entropy of the horizontals' signals plus that of the verticals', bits.
        sharpness: Z, sum of |second difference| of the converter levels along the press order.
        disorder: C, how much fibres of a family stand in the wrong order.
        objective: alpha / (1 + entropy) + beta Z + gamma C, to be minimised.
    """

    entropy: float
    sharpness: float
    disorder: float
    objective: float


@lru_cache(maxsize=16)
def published_presses(fibres: Counts | Layout, side: int = SIDE) -> NDArray[np.float64]:
    """The (side^2, 2) presses the published search samples: a serpentine over 1..M, jittered by U(0, 2/49)."""
    places = serpentine_presses(between_fibres(Layout.create(fibres)), side, jitter=2 / 49)
    places.setflags(write=False)
    return places


def published_terms(
    pads: Morphology | NDArray[np.float64],
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = WEIGHTS,
    layout: Layout | None = None,
    levels: int = LEVELS,
) -> list[PublishedTerms]:
    """Terms of formula (5), as the published code computes them, for every pad of a population.

    Args:
        pads: a morphology, or knots (P, F, N+2, 2) of a population.
        presses: (Q, 2) in an order of neighbours; the 49 published ones if None.
        samples: points per fibre of the quantised signals and of C.
        weights: alpha, beta, gamma.
        layout: of a population's fibres; as many horizontals as verticals, the default pitch apart, if None.
        levels: what signals are rounded up to whole ones of, 1 to 2^24.
    """
    alpha, beta, gamma = _weights(weights)
    travel, cross, ends, _ = fibre_axes(pads, layout)
    samples, levels = check_samples(samples, travel.shape[1]), check_int("levels", levels, 1, MAX_LEVELS)
    if presses is None:
        layout = pads.layout if isinstance(pads, Morphology) else layout
        places = published_presses(layout or ends.horizontals).copy()  # not read-only: kernels would be compiled anew
    else:
        places = check_presses(presses)[0]
    contact = or_default("contact", contact, Contact, PUBLISHED_CONTACT)
    shape = press_shape(contact, grid_unit_mm(pads, layout))
    found = np.zeros((len(travel), 3))

    def work(begin: int, end: int) -> None:
        terms_kernel(travel, cross, ends.horizontals, places, shape, samples, levels, begin, end, found)

    map_chunks(work, len(travel), min_chunk=8)
    return [PublishedTerms(h, z, c, alpha / (1 + h) + beta * z + gamma * c) for h, z, c in found.tolist()]


def published_objective(
    pad: Morphology,
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = WEIGHTS,
) -> float:
    """Formula (5) for one pad: alpha / (1 + entropy) + beta Z + gamma C; arguments as in `published_terms`."""
    return published_terms(check_type("pad", pad, Morphology), contact, presses, samples, weights)[0].objective


def _weights(weights: tuple[float, float, float]) -> list[float]:
    if weights is WEIGHTS:
        return [*weights]
    found = check_array("weights", weights, 1e12)
    if found.shape != (3,):
        raise InputError(f"weights have shape {found.shape}, expected three numbers: alpha, beta, gamma")
    return found.tolist()
