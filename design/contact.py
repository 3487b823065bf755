"""The contact model: what each fibre signals for a press (paper, section II-B).

A press deforms a regular polygon around its centre; a fibre signals the weighted length it has inside.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import kernels
from .errors import InputError
from .morphology import Morphology
from .settings import Contact

_WEIGHTS = {"uniform": kernels.UNIFORM, "inverse_square": kernels.INVERSE_SQUARE, "inverse": kernels.INVERSE}
_LENGTHS = {"manhattan": kernels.MANHATTAN, "euclidean": kernels.EUCLIDEAN}


def signals_quantized(
    pad: Morphology | NDArray[np.float64], presses: ArrayLike, contact: Contact | None = None, samples: int = 2000
) -> NDArray[np.float64]:
    """Signals by the published rule: segments of a sampled fibre count whole if they start inside the press.

    Args:
        pad: a morphology, or knots (..., 2M, N+2, 2) of a population.
        presses: (Q, 2) centres in grid units.
        contact: shape and weight; the published default if None.
        samples: points per fibre, uniform along the travel axis, at least 2 (published: 2000).

    Returns:
        (Q, 2M) signals, or (..., Q, 2M) for a population; with the default weight and length in grid units.

    Raises:
        InputError: presses of the wrong shape or not finite, or fewer than 2 samples.
    """
    contact = contact or Contact()
    if samples < 2:
        raise InputError(f"samples is {samples}, allowed is at least 2")
    knots = pad.knots if isinstance(pad, Morphology) else np.asarray(pad, dtype=np.float64)
    batch = np.ascontiguousarray(knots.reshape(-1, *knots.shape[-3:]))
    result = kernels.quantized_signals(
        batch,
        as_presses(presses),
        contact.radius,
        contact.sides or 0,
        _WEIGHTS[contact.weight],
        _LENGTHS[contact.length],
        samples,
    )
    return result.reshape(*knots.shape[:-3], *result.shape[1:])


def as_presses(presses: ArrayLike) -> NDArray[np.float64]:
    """`presses` as a contiguous, finite (Q, 2) array of grid units."""
    places = np.ascontiguousarray(presses, dtype=np.float64)
    if places.size == 0:
        return places.reshape(0, 2)
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"presses have shape {places.shape}, expected (Q, 2)")
    if not np.isfinite(places).all():
        raise InputError("presses hold NaN or infinity, expected finite grid units")
    return places


def boustrophedon(grid: int, side: int, jitter: float = 0.0, seed: int = 214) -> NDArray[np.float64]:
    """A serpentine of side x side presses over 1..M, each moved by U(0, jitter) along both axes.

    Args:
        grid: M. side: presses per row and rows, Q = side^2. jitter: grid units.
        seed: of numpy's legacy RandomState, by which the published values are stated.

    Returns:
        (Q, 2) presses; x runs forth on even rows and back on odd ones, so that neighbours in order are neighbours
        in place.
    """
    line = np.linspace(1, grid, side)
    x = np.where(np.arange(side)[:, None] % 2 == 0, line, line[::-1])
    places = np.column_stack([x.ravel(), np.repeat(line, side)])
    return places + np.random.RandomState(seed).random_sample((side * side, 2)) * jitter
