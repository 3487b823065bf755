"""The contact model: what each fibre signals for a press (paper, section II-B).

A press deforms a regular polygon around its centre; a fibre signals the weighted length it has inside.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common import profiling
from padforge.design.common.parallel import map_chunks
from padforge.design.common.settings import or_default
from padforge.design.common.validation import MAX_VALUES, InputError, check_array, check_int, check_type
from padforge.design.kernels import geometry
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.pchip import population_slopes
from padforge.design.kernels.published import quantized_signals
from padforge.design.morphology import (
    MAX_COORDINATE,
    MIN_SPAN,
    Array,
    Ints,
    Morphology,
    check_layout,
    fibre_ends,
    split_axes,
)
from padforge.design.paths.curves import lengths
from padforge.design.settings import DEFAULT_PITCH_MM, PUBLISHED_CONTACT, Contact, Layout, Rectangle

if TYPE_CHECKING:
    from scipy.sparse import csr_array

MAX_SAMPLES = 2**20
"""Most points a fibre is sampled at."""
_WEIGHTS = {"uniform": geometry.UNIFORM, "inverse_square": geometry.INVERSE_SQUARE, "inverse": geometry.INVERSE}
_LENGTHS = {"manhattan": geometry.MANHATTAN, "euclidean": geometry.EUCLIDEAN}
PressShape = tuple[tuple[Array, Array], Array, geometry.WeightLaw]


def signals(pad: Morphology | Array, presses: ArrayLike, contact: Contact | None = None) -> Array:
    """Exact signals: the weighted length of each fibre's PCHIP curve inside the press, no sampling.

    The boundary belongs to the press: a straight fibre that runs along an edge counts with its whole length there.

    Args:
        pad: a morphology, or knots (..., F, N+2, 2) of a population of square pads, F = 2 M, whose grid unit is the
            default pitch, 11.25 mm.
        presses: (Q, 2) centres in grid units, or (Q, C, 2) for C presses at once, whose signals add; where their
            shapes overlap a fibre counts once for each.
        contact: what a press does to a fibre; the measured one, `Contact()`, if None.

    Returns:
        (Q, F) signals, or (..., Q, F) for a population; with the default weight and length in grid units. Uniform
        Manhattan signals are a closed form between roots found to rounding, others Gauss-Kronrod integrals to 1e-11.

    Raises:
        InputError: presses of the wrong shape or not finite.
    """
    return signals_and_spans(pad, presses, or_default("contact", contact, Contact))[0]


def relative_stretch(pad: Morphology, presses: ArrayLike, contact: Contact) -> Array:
    """Return what a voltage divider shows of a press: `signals` as shares of the length of each fibre.

    A fibre is a strain gauge: its resistance grows by its relative stretch, so that the same stretch shows less on a
    longer fibre.

    Args:
        pad: the fibres.
        presses: (Q, 2) centres in grid units.
        contact: what a press does to a fibre.

    Returns:
        (Q, F), without unit.
    """
    return signals(pad, presses, contact) / lengths(pad)


def signals_and_spans(pad: Morphology | Array, presses: ArrayLike, contact: Contact) -> tuple[Array, int]:
    """`signals`, and the number of spans that were looked at for them."""
    travel, cross, ends, batch = fibre_axes(pad)
    flat, places = check_presses(presses, several=True)
    fibres = travel.shape[1]
    check_memory(len(travel) * len(flat) * fibres)
    out = np.zeros(len(travel) * len(flat) * fibres)
    visited = _run_exact(travel, cross, ends, flat, press_shape(contact, grid_unit_mm(pad)), _NONE, _NONE, out)
    return _summed(out, (*batch, *places, fibres)), visited


def check_memory(values: int) -> None:
    """Refuse more signals than fit into memory."""
    if values > MAX_VALUES:
        raise InputError(f"these are {values} signals, allowed at once are {MAX_VALUES}; signals_sparse takes less")


def _summed(signals: Array, shape: tuple[int, ...]) -> Array:
    """Signals in the shape (..., Q, C, F), summed over the C presses that were made at once."""
    whole = signals.reshape(shape)
    return whole[..., 0, :] if shape[-2] == 1 else whole.sum(axis=-2)


def signals_sparse(pad: Morphology, presses: ArrayLike, contact: Contact | None = None) -> "csr_array":
    """`signals` of one pad as a sparse (Q, F) matrix: time and memory follow what is touched, not the pad's size.

    Args:
        pad, contact: as in `signals`. presses: (Q, 2) centres in grid units.
    """
    from scipy.sparse import csr_array

    contact = or_default("contact", contact, Contact)
    travel, cross, ends, _ = fibre_axes(check_type("pad", pad, Morphology))
    places, strays = check_presses(presses)[0], geometry.max_offsets(cross, ends)
    shape = press_shape(contact, pad.unit_mm)
    starts = geometry.count_touched(strays[0], places, shape[1], ends)
    check_memory(int(starts[-1]))
    fibre, signal = np.empty(starts[-1], np.int64), np.empty(starts[-1])
    _run_exact(travel, cross, ends, places, shape, starts, fibre, signal)
    found = csr_array((signal, fibre, starts), shape=(len(places), len(pad.knots)))
    found.eliminate_zeros()
    return found


_NONE = np.empty(0, np.int64)


def _run_exact(
    travel: Array,
    cross: Array,
    ends: geometry.Ends,
    places: Array,
    shape: PressShape,
    starts: Ints,
    fibre: Ints,
    out: Array,
) -> int:
    """`exact_signals` over the cores."""
    slope, strays = population_slopes(travel, cross), geometry.max_offsets(cross, ends)

    def work(begin: int, end: int) -> int:
        return exact_signals(travel, cross, slope, strays, ends, places, *shape, begin, end, starts, fibre, out)

    visited = sum(map_chunks(work, len(travel) * len(places), min_chunk=2000))
    if profiling.is_profiling():
        record_visits(travel, strays, ends, places, shape[1], visited)
    return visited


def record_visits(travel: Array, strays: Array, ends: geometry.Ends, places: Array, reach: Array, visited: int) -> None:
    """Tell the profile how many fibres and spans were looked at, press by press."""
    pads, fibres, knots = travel.shape
    within = sum(int(geometry.count_touched(each, places, reach, ends)[-1]) for each in strays)
    profiling.add_count("fibres, press by press", within, pads * len(places) * fibres)
    profiling.add_count("spans, press by press", visited, pads * len(places) * fibres * (knots - 1))


def fibre_axes(
    pad: Morphology | Array, layout: Layout | None = None
) -> tuple[Array, Array, geometry.Ends, tuple[int, ...]]:
    """Travel and cross coordinates (P, F, n) of a pad or a population, where fibres end, and the population's shape.

    Args:
        pad: a morphology; or knots (..., F, N+2, 2), and their layout: that of a square pad if None.

    Raises:
        InputError: knots that are no (..., F, N+2, 2) numbers up to FARTHEST that ascend along the travel axis.
    """
    knots = pad.knots if isinstance(pad, Morphology) else check_array("knots", pad, MAX_COORDINATE)
    layout = pad.layout if isinstance(pad, Morphology) else layout
    fibres = knots.shape[-3] if knots.ndim >= 3 else 0
    if not fibres or knots.shape[-1] != 2 or knots.shape[-2] < 2 or (layout is None and fibres % 2):
        raise InputError(f"knots have shape {knots.shape}, expected (..., 2 M, N + 2, 2)")
    ends = fibre_ends(check_layout(fibres, layout))
    # in C order, else the kernels would be compiled anew for the order of a caller's array, which takes many seconds
    travel, cross = split_axes(np.ascontiguousarray(knots).reshape(-1, *knots.shape[-3:]), ends.horizontals)
    if not isinstance(pad, Morphology) and not (np.diff(travel) >= MIN_SPAN).all():
        raise InputError(f"knots do not ascend by {MIN_SPAN:g} or more along the travel axis")
    return travel, cross, ends, knots.shape[:-3]


def grid_unit_mm(pad: Morphology | Array, layout: Layout | None = None) -> float:
    """Return the grid unit of a pad or of knots, mm: the default pitch where no layout says another."""
    layout = pad.layout if isinstance(pad, Morphology) else layout
    return layout.unit_mm if layout else DEFAULT_PITCH_MM


def press_shape(contact: Contact, unit_mm: float) -> PressShape:
    """Return a contact as the kernels take it, in grid units.

    Args:
        contact: what a press does to a fibre.
        unit_mm: the pad's grid unit, mm.

    Returns:
        Chains and extents in the frame of each family, and the law of its weight.
    """
    length = _LENGTHS[contact.length]
    if contact.sensitivity_profile:
        points = contact.profile_points(unit_mm)
        end, profile = points[-1][0], geometry.profile_coefficients(points)
        return *geometry.frames(end, None), geometry.WeightLaw(end, geometry.PROFILE, length, profile)
    return *geometry.frames(contact.radius, contact.sides), geometry.WeightLaw(
        contact.radius, _WEIGHTS[contact.weight], length
    )


def signals_quantized(
    pad: Morphology | Array, presses: ArrayLike, contact: Contact | None = None, samples: int = 2000
) -> Array:
    """Signals by the published rule: segments of a sampled fibre count whole if they start inside the press.

    Args:
        pad: a morphology, or knots (..., F, N+2, 2) of a population of square pads, F = 2 M, as in `signals`.
        presses: (Q, 2) centres in grid units, or (Q, C, 2) for C presses at once, as in `signals`.
        contact: shape and weight; PUBLISHED_CONTACT if None.
        samples: points per fibre, uniform along the travel axis, at least 2 (published: 2000).

    Returns:
        (Q, F) signals, or (..., Q, F) for a population; with the default weight and length in grid units.

    Raises:
        InputError: presses of the wrong shape or not finite, or fewer than 2 samples.
    """
    return quantized_signals_and_samples(
        pad, presses, or_default("contact", contact, Contact, PUBLISHED_CONTACT), samples
    )[0]


def quantized_signals_and_samples(
    pad: Morphology | Array, presses: ArrayLike, contact: Contact, samples: int
) -> tuple[Array, int]:
    """`signals_quantized`, and the number of samples that were looked at for them."""
    travel, cross, ends, batch = fibre_axes(pad)
    shape = press_shape(contact, grid_unit_mm(pad))
    samples = check_samples(samples, travel.shape[1])
    places, shape_of_presses = check_presses(presses, several=True)
    check_memory(len(travel) * len(places) * travel.shape[1])
    out = np.zeros((len(travel), len(places), travel.shape[1]))

    def work(begin: int, end: int) -> int:
        return quantized_signals(travel, cross, ends.horizontals, places, shape, samples, begin, end, out)

    looked_at = sum(map_chunks(work, travel.shape[0] * travel.shape[1], max(1, 200_000 // (samples + len(places)))))
    return _summed(out, (*batch, *shape_of_presses, travel.shape[1])), looked_at


def check_samples(samples: int, fibres: int) -> int:
    """Points a fibre is sampled at, as far as they may be so many."""
    return check_int("samples", samples, 2, min(MAX_SAMPLES, MAX_VALUES // max(fibres, 1)))


def check_presses(presses: ArrayLike, several: bool = False) -> tuple[Array, tuple[int, int]]:
    """`presses` as contiguous, finite (Q C, 2) grid units, and (Q, C): C is 1 for (Q, 2).

    Raises:
        InputError: presses that are no (Q, 2), or (Q, C, 2) where `several` are allowed at once, or not finite.
    """
    places = check_array("presses", presses, MAX_COORDINATE)
    if places.shape == (0,):
        places = places.reshape(0, 2)
    if places.ndim not in ((2, 3) if several else (2,)) or places.shape[-1] != 2:
        raise InputError(f"presses have shape {places.shape}, expected (Q, 2)" + (" or (Q, C, 2)" if several else ""))
    return np.ascontiguousarray(places.reshape(-1, 2)), (len(places), places.shape[1] if places.ndim == 3 else 1)


def serpentine_presses(rectangle: Rectangle, side: int, jitter: float = 0.0, seed: int = 214) -> Array:
    """A serpentine of side x side presses, each moved by U(0, jitter) along both axes.

    Args:
        rectangle: over which, as `sensed_rectangle` and `between_fibres` give it.
        side: presses per row and rows, Q = side^2. jitter: grid units.
        seed: of numpy's legacy RandomState, by which the published values are stated.

    Returns:
        (Q, 2) presses; x runs forth on even rows and back on odd ones, so that neighbours in order are neighbours
        in place.
    """
    rows = grid_positions(rectangle, side).reshape(side, side, 2)
    rows[1::2] = rows[1::2, ::-1]
    places = rows.reshape(-1, 2)
    return places + np.random.RandomState(seed).random_sample((side * side, 2)) * jitter


def grid_positions(rectangle: Rectangle, side: int) -> Array:
    """(side^2, 2) places, side x side of them evenly from corner to corner of a rectangle, row by row from below."""
    x, y = (np.linspace(low, high, side) for low, high in zip(*rectangle, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
