"""What a search minimises: the published objective, for the genetic search and for comparison."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .contact import boustrophedon, signals_quantized
from .information import disorder, joint_entropy, quantize, sharpness
from .morphology import Morphology
from .settings import Contact


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


def published_presses(grid: int, side: int = 7) -> NDArray[np.float64]:
    """The (side^2, 2) presses the published search samples: a serpentine over 1..M, jittered by U(0, 2/49)."""
    return boustrophedon(grid, side, jitter=2 / 49)


def published_terms(
    knots: NDArray[np.float64],
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = (1.0, 1e-7, 5e-6),
) -> list[PublishedTerms]:
    """Terms of formula (5), as the published code computes them, for every pad of a population.

    Args:
        knots: (P, 2M, N+2, 2).
        presses: (Q, 2) in an order of neighbours; the 49 published ones if None.
        samples: points per fibre of the quantised signals and of C.
        weights: alpha, beta, gamma.
    """
    grid = knots.shape[1] // 2
    places = published_presses(grid) if presses is None else presses
    alpha, beta, gamma = weights
    found = []
    crossing = disorder(knots, samples)
    for signals, c in zip(signals_quantized(knots, places, contact, samples), crossing, strict=True):
        levels = quantize(signals)
        entropy = joint_entropy(levels[:, :grid]) + joint_entropy(levels[:, grid:])
        z = sharpness(levels)
        found.append(PublishedTerms(entropy, z, float(c), alpha / (1 + entropy) + beta * z + gamma * float(c)))
    return found


def published_objective(
    pad: Morphology,
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = (1.0, 1e-7, 5e-6),
) -> float:
    """Formula (5) for one pad: alpha / (1 + entropy) + beta Z + gamma C; arguments as in `published_terms`."""
    return published_terms(pad.knots[None], contact, presses, samples, weights)[0].objective
