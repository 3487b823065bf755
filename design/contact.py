"""The contact model: what each fibre signals for a press (paper, section II-B).

A press deforms a regular polygon around its centre; a fibre signals the weighted length it has inside.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .kernels.exact import exact_signals, family_strays
from .kernels.pchip import population_slopes
from .kernels.press import EUCLIDEAN, INVERSE, INVERSE_SQUARE, MANHATTAN, UNIFORM
from .kernels.quantized import quantized_signals
from .morphology import Morphology
from .settings import Contact
from .threads import in_chunks

Array = NDArray[np.float64]

_WEIGHTS = {"uniform": UNIFORM, "inverse_square": INVERSE_SQUARE, "inverse": INVERSE}
_LENGTHS = {"manhattan": MANHATTAN, "euclidean": EUCLIDEAN}


def signals(pad: Morphology | Array, presses: ArrayLike, contact: Contact | None = None) -> Array:
    """Exact signals: the weighted length of each fibre's PCHIP curve inside the press, no sampling.

    The boundary belongs to the press: a straight fibre that runs along an edge counts with its whole length there.

    Args:
        pad: a morphology, or knots (..., 2M, N+2, 2) of a population.
        presses: (Q, 2) centres in grid units, or (Q, C, 2) for C presses at once, whose signals add; where their
            shapes overlap a fibre counts once for each.
        contact: shape, weight and length; the published default if None.

    Returns:
        (Q, 2M) signals, or (..., Q, 2M) for a population; with the default weight and length in grid units. Uniform
        Manhattan signals are a closed form between roots found to rounding, others Gauss-Kronrod integrals to 1e-11.

    Raises:
        InputError: presses of the wrong shape or not finite.
    """
    return exact(pad, presses, contact or Contact())[0]


def exact(pad: Morphology | Array, presses: ArrayLike, contact: Contact) -> tuple[Array, int]:
    """`signals`, and the number of spans that were looked at for them."""
    knots = pad.knots if isinstance(pad, Morphology) else np.asarray(pad, dtype=np.float64)
    batch = knots.reshape(-1, *knots.shape[-3:])
    grid = batch.shape[1] // 2
    travel, cross = (
        np.ascontiguousarray(np.concatenate([batch[:, :grid, :, axis], batch[:, grid:, :, 1 - axis]], axis=1))
        for axis in (0, 1)
    )
    slope, strays = population_slopes(travel, cross), family_strays(cross)
    places = np.asarray(presses, dtype=np.float64)
    contacts = places.shape[1] if places.ndim == 3 else 1
    flat = as_presses(places.reshape(-1, places.shape[-1]) if places.ndim == 3 else places)
    chains, reach = _frames(contact.radius, contact.sides)
    weight, length = _WEIGHTS[contact.weight], _LENGTHS[contact.length]
    out = np.zeros((len(batch), len(flat), 2 * grid))

    def work(begin: int, end: int) -> int:
        return exact_signals(
            travel, cross, slope, strays, flat, chains, reach, contact.radius, weight, length, begin, end, out
        )

    visited = sum(in_chunks(work, len(batch) * len(flat), grain=2000))
    result = out.reshape(len(batch), -1, contacts, 2 * grid).sum(axis=2) if contacts > 1 else out
    return result.reshape(*knots.shape[:-3], *result.shape[1:]), visited


@lru_cache(maxsize=64)
def _frames(radius: float, sides: int | None) -> tuple[tuple[Array, Array], Array]:
    """The press's shape in the frame of each family: chains (3, B) of breakpoints t, upper v, lower v; extents (2, 4).

    A circle has no breakpoints. At t a polygon reaches up to the lowest of its upper edges' lines and down to the
    highest of its lower ones.
    """
    if sides is None:
        empty = np.empty((3, 0))
        return (empty, empty), radius * np.tile([-1.0, 1.0, -1.0, 1.0], (2, 1))
    corner = 2 * np.pi * np.arange(sides) / sides
    normal = corner + np.pi / sides
    apothem = np.cos(np.pi / sides)
    chains, reach = [], []
    for to_frame in ((np.cos, np.sin), (np.sin, np.cos)):
        t = np.sort(to_frame[0](corner))
        t = t[np.append(True, np.diff(t) > 1e-12)]
        along, across = to_frame[0](normal), to_frame[1](normal)
        edge = (apothem - np.outer(t, along)) / np.where(np.abs(across) < 1e-12, 1, across)
        upper = np.where(across > 1e-12, edge, np.inf).min(axis=1)
        lower = np.where(across < -1e-12, edge, -np.inf).max(axis=1)
        chains.append(radius * np.stack([t, upper, lower]))
        reach.append([t[0], t[-1], lower.min(), upper.max()])
    return (chains[0], chains[1]), radius * np.array(reach)


def signals_quantized(
    pad: Morphology | Array, presses: ArrayLike, contact: Contact | None = None, samples: int = 2000
) -> Array:
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
    places = as_presses(presses)
    weight, length = _WEIGHTS[contact.weight], _LENGTHS[contact.length]
    out = np.zeros((len(batch), len(places), batch.shape[1]))

    def work(begin: int, end: int) -> None:
        quantized_signals(batch, places, contact.radius, contact.sides or 0, weight, length, samples, begin, end, out)

    in_chunks(work, len(batch) * batch.shape[1], grain=max(1, 100_000 // (samples + 50 * len(places))))
    return out.reshape(*knots.shape[:-3], *out.shape[1:])


def as_presses(presses: ArrayLike) -> Array:
    """`presses` as a contiguous, finite (Q, 2) array of grid units."""
    places = np.ascontiguousarray(presses, dtype=np.float64)
    if places.size == 0:
        return places.reshape(0, 2)
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"presses have shape {places.shape}, expected (Q, 2)")
    if not np.isfinite(places).all():
        raise InputError("presses hold NaN or infinity, expected finite grid units")
    return places


def boustrophedon(grid: int, side: int, jitter: float = 0.0, seed: int = 214) -> Array:
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
