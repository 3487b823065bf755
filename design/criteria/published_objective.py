"""What a search minimises: the published objective, for the genetic search and for comparison."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from padforge.design.common.computing import in_chunks
from padforge.design.common.errors import InputError, instance, reals, whole
from padforge.design.common.settings import or_default
from padforge.design.pad.contact import as_presses, as_samples, boustrophedon, fibre_axes, grid_unit_mm, press_shape
from padforge.design.pad.kernels.published.information import published_terms as terms_kernel
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import PUBLISHED_CONTACT, Contact, Counts, Layout, between_fibres
from padforge.design.settings.search import LEVELS, MOST_LEVELS, SIDE, WEIGHTS


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
    places = boustrophedon(between_fibres(Layout.of(fibres)), side, jitter=2 / 49)
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
    samples, levels = as_samples(samples, travel.shape[1]), whole("levels", levels, 1, MOST_LEVELS)
    if presses is None:
        layout = pads.layout if isinstance(pads, Morphology) else layout
        places = published_presses(layout or ends.horizontals).copy()  # not read-only: kernels would be compiled anew
    else:
        places = as_presses(presses)[0]
    contact = or_default("contact", contact, Contact, PUBLISHED_CONTACT)
    shape = press_shape(contact, grid_unit_mm(pads, layout))
    found = np.zeros((len(travel), 3))

    def work(begin: int, end: int) -> None:
        terms_kernel(travel, cross, ends.horizontals, places, shape, samples, levels, begin, end, found)

    in_chunks(work, len(travel), grain=8)
    return [PublishedTerms(h, z, c, alpha / (1 + h) + beta * z + gamma * c) for h, z, c in found.tolist()]


def published_objective(
    pad: Morphology,
    contact: Contact | None = None,
    presses: ArrayLike | None = None,
    samples: int = 2000,
    weights: tuple[float, float, float] = WEIGHTS,
) -> float:
    """Formula (5) for one pad: alpha / (1 + entropy) + beta Z + gamma C; arguments as in `published_terms`."""
    return published_terms(instance("pad", pad, Morphology), contact, presses, samples, weights)[0].objective


def _weights(weights: tuple[float, float, float]) -> list[float]:
    if weights is WEIGHTS:
        return [*weights]
    found = reals("weights", weights, 1e12)
    if found.shape != (3,):
        raise InputError(f"weights have shape {found.shape}, expected three numbers: alpha, beta, gamma")
    return found.tolist()
