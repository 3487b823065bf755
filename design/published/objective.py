"""The published objective, formula (5), for the genetic search and for comparison; and the information of a pad."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.common.parallel import map_chunks
from padforge.common.settings import or_default
from padforge.common.validation import check_int, check_type
from padforge.design.contact import (
    check_presses,
    check_samples,
    fibre_axes,
    press_shape,
    serpentine_presses,
    signals,
)
from padforge.design.morphology import Array, Morphology
from padforge.design.published import kernels
from padforge.design.settings import (
    LEVELS,
    MAX_LEVELS,
    PUBLISHED_CONTACT,
    SIDE,
    WEIGHTS,
    Contact,
    Counts,
    Entropy,
    Layout,
    between_fibres,
)


def quantize(signals: Array, levels: int = LEVELS) -> Array:
    """Return signals (Q, C) as converter levels: each column scaled to its range and rounded up; 0 if constant."""
    out = np.zeros(signals.shape)
    if len(signals):
        kernels.quantize(np.asarray(signals, dtype=np.float64), levels, out)
    return out


def joint_entropy(levels: Array) -> float:
    """Return the joint entropy, bits, of the rows of levels (Q, C): at most log2 Q, if all rows differ."""
    return float(kernels.compute_row_entropy(np.asarray(levels, dtype=np.float64), 0, levels.shape[1]))


def idle_share(signals: Array) -> float:
    """Return the fraction of signals (Q, C) that are 0, which means that a fibre is idle in a press."""
    return float((signals == 0).mean()) if signals.size else 0.0


def information(pad: Morphology, contact: Contact | None = None, noise: float = 1.0, side: int = 20) -> float:
    """Compute a lower bound of the mutual information of the position of a press and the noisy signals, in bits.

    The position is uniform between the outermost fibres. Each signal has Gaussian noise of `noise` counts of a
    converter whose LEVELS span the largest signal. The rectangle is cut into side x side cells, in which signals are
    approximated as Gaussian with the covariance C = sigma^2 I + J S J^T, where J is the derivative of the signals and S
    the covariance of a position in its cell. The signals of the pad are a mixture of these. With the Bhattacharyya
    distance D, by the pairwise bound on the entropy of a mixture (Kolchinsky and Tracey, Entropy 2017, equation (10)),

        I >= mean_a [ln det(C_a / sigma^2) / 2] - mean_a ln mean_b exp(-D_ab)    (in nats).
    """
    low, high = np.array(between_fibres(pad.layout))
    x, y = ((np.arange(side) + 0.5) / side * (high - low)[axis] + low[axis] for axis in (0, 1))
    positions = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    contact = or_default("contact", contact, Contact)
    step = 1e-2 if contact.model == "layer" else 1e-4  # a layer's signals are less precise
    around = (positions[:, None] + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])).reshape(-1, 2)
    values = signals(pad, around, contact).reshape(len(positions), 5, -1)
    values = values[..., values.any(axis=(0, 1))]  # untouched fibres, most of them on a large pad, add nothing
    if not values.size:
        return 0.0
    sigma = noise * np.abs(values).max() / LEVELS
    mean = values[:, 0] / sigma
    cell = np.array([x[1] - x[0], y[1] - y[0]]) / np.sqrt(12)
    slope = (values[:, 1::2] - values[:, 2::2]).transpose(0, 2, 1)
    jacobian = cell / (2 * step * sigma) * slope  # (Q, F, 2)
    log_det = np.linalg.slogdet(np.eye(2) + np.einsum("aki,akj->aij", jacobian, jacobian))[1]
    sums = np.zeros(len(mean))
    for part in np.array_split(np.arange(len(mean)), side):  # each pair of cells once
        overlaps = _overlaps(mean[part[0] :], jacobian[part[0] :], log_det[part[0] :], len(part))
        sums[part] += overlaps.sum(axis=1)
        sums[part[-1] + 1 :] += overlaps[:, len(part) :].sum(axis=0)
    return float((log_det.mean() / 2 - np.log(sums / len(mean)).mean()) / np.log(2))


def _overlaps(mean: Array, jacobian: Array, log_det: Array, count: int) -> Array:
    """Return exp(-D_ab) of the first `count` cells a with all b: means (Q, C), covariances I + J J^T, in noise units.

    The mean covariance of two cells is I + W W^T, where W = [J_a, J_b] / sqrt 2 has four columns, so its determinant
    and inverse follow from those of a 4 x 4 matrix.
    """
    half = jacobian / np.sqrt(2)
    offset = mean[:count, None] - mean[None]
    inner = np.empty((*offset.shape[:2], 4, 4))  # I + W^T W, by blocks of the two cells
    diagonal = np.eye(2) + half.transpose(0, 2, 1) @ half
    inner[..., :2, :2], inner[..., 2:, 2:] = diagonal[:count, None], diagonal
    inner[..., :2, 2:] = np.tensordot(half[:count], half, axes=(1, 1)).transpose(0, 2, 1, 3)
    inner[..., 2:, :2] = inner[..., :2, 2:].swapaxes(-1, -2)
    by_cell = [offset @ half[:count], (offset.swapaxes(0, 1) @ half).swapaxes(0, 1)]
    along = np.concatenate(by_cell, axis=-1)  # W^T offset
    square = (offset**2).sum(axis=-1) - (along * np.linalg.solve(inner, along[..., None])[..., 0]).sum(axis=-1)
    distance = square / 8 + (np.linalg.slogdet(inner)[1] - (log_det[:count, None] + log_det[None]) / 2) / 2
    return np.exp(-distance)


@dataclass(frozen=True)
class PublishedTerms:
    """The published objective and its terms."""

    entropy: float  # joint entropy of the horizontals' signals plus that of the verticals', bits
    sharpness: float  # Z, sum of |second difference| of the converter levels along the press order
    disorder: float  # C, sum over samples and over pairs i < j of a family of the negative parts of curve_j - curve_i
    objective: float  # alpha / (1 + entropy) + beta Z + gamma C, or alpha / joint_entropy + ..., to be minimised
    joint_entropy: float  # of the signals of all fibres, bits


@lru_cache(maxsize=16)
def published_presses(fibres: Counts | Layout, side: int = SIDE) -> NDArray[np.float64]:
    """Return the (side^2, 2) presses of the published search: a serpentine over 1..M, jittered by U(0, 2/49)."""
    positions = serpentine_presses(between_fibres(Layout.create(fibres)), side, jitter=2 / 49)
    positions.setflags(write=False)
    return positions


def published_terms(
    pads: Morphology | NDArray[np.float64],
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = WEIGHTS,
    layout: Layout | None = None,
    levels: int = LEVELS,
    entropy: Entropy = "families",
) -> list[PublishedTerms]:
    """Compute the terms of formula (5) for every pad of a population.

    Args:
        pads: a morphology, or the knots of P pads; shape (P, F, N + 2, 2).
        contact: contact model; PUBLISHED_CONTACT if None.
        presses: each a neighbour of the one before; the 49 published ones if None; shape (Q, 2).
        samples: points per fibre from which signals and C are computed.
        weights: alpha, beta, gamma.
        layout: layout of knots; by default as many horizontals as verticals, the default pitch apart.
        levels: levels to which signals are rounded up.
        entropy: "families": sum over both families, as in the published code; "joint": of all fibres, as in the paper.
    """
    alpha, beta, gamma = weights
    along, across, layout, _ = fibre_axes(pads, layout)
    samples, levels = check_samples(samples, along.shape[1]), check_int("levels", levels, 1, MAX_LEVELS)
    # a copy, since kernels would be compiled anew for a read-only array
    positions = published_presses(layout).copy() if presses is None else check_presses(presses)[0]
    shape = press_shape(or_default("contact", contact, Contact, PUBLISHED_CONTACT), layout.unit_mm)
    terms = np.zeros((len(along), 4))

    def work(begin: int, end: int) -> None:
        kernels.published_terms(along, across, layout.horizontals, positions, shape, samples, levels, begin, end, terms)

    map_chunks(work, len(along), min_chunk=8)

    def objective(families: float, z: float, c: float, joint: float) -> float:
        information = 1 + families if entropy == "families" else max(joint, 1e-9)  # 0 bits if no press touches a fibre
        return alpha / information + beta * z + gamma * c

    return [PublishedTerms(h, z, c, objective(h, z, c, j), j) for h, z, c, j in terms.tolist()]


def published_objective(
    pad: Morphology,
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = WEIGHTS,
) -> float:
    """Compute formula (5) for one pad: alpha / (1 + entropy) + beta Z + gamma C.

    Args:
        pad: the fibres.
        contact: contact model; PUBLISHED_CONTACT if None.
        presses: in an order of neighbours; the 49 published ones if None; shape (Q, 2).
        samples: points per fibre of the quantised signals and of C.
        weights: alpha, beta, gamma.
    """
    return published_terms(check_type("pad", pad, Morphology), contact, presses, samples, weights)[0].objective
