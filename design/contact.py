"""The contact model: the signal of each fibre for a press (paper, section II-B).

The signal of a fibre is the line integral of a weight along it. The weight follows from the strains of the silicone
under a tool, is a measured function of the distance to the press centre, or is the published weight inside a polygon.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.parallel import map_chunks
from padforge.common.settings import or_default
from padforge.common.validation import MAX_VALUES, InputError, check_array, check_float, check_int, check_type
from padforge.design.kernels import element_signals, geometry
from padforge.design.kernels.element_signals import FINE_PRECISION, LAYER_PRECISION
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.pchip import population_slopes
from padforge.design.layer import REDUCED_MODULUS_KPA, LayerPress, solve_press
from padforge.design.morphology import (
    MAX_COORDINATE,
    MAX_SAMPLES,
    MIN_SPAN,
    Array,
    Ints,
    Morphology,
    check_layout,
    fibre_ends,
    split_axes,
)
from padforge.design.paths.curves import lengths
from padforge.design.published.kernels import quantized_signals
from padforge.design.settings import PUBLISHED_CONTACT, Contact, Layout, Rectangle

_WEIGHTS = {"uniform": geometry.UNIFORM, "inverse_square": geometry.INVERSE_SQUARE, "inverse": geometry.INVERSE}
_LENGTHS = {"manhattan": geometry.MANHATTAN, "euclidean": geometry.EUCLIDEAN}
LAYER_REACH = {"bonded": 8.0, "slipping": 16.0}
"""Distance outside the contact at which strains of a layer are cut off, thicknesses. The neglected part is less than
1 % of the largest signal of a straight fibre. Strains of a slipping layer decay only with the distance squared."""
MAX_REACH_RADII = 4.0
"""Maximum thickness for that distance, contact radii: strains of a thicker layer decay with the distance cubed."""
FIBRE_BLUR_MM = 0.1
"""Standard deviation of the Gaussian by which strains are averaged, about that of the width of a fibre of 0.3 mm. It
smooths the step of strains at the edge of the contact, which hardly changes signals, the integrals of strains."""
PANEL_SHARE = 0.4
"""Length of an interval of distances in which strains are one polynomial, relative to its distance from the edge of the
contact or, if more, to the depth of the fibres. Polynomials of degree 7 then err by 1e-8 of the largest strain."""
DEPTH_STEPS = 16
"""Number of depths for which the contact is solved, to interpolate signals and forces. Fewer would err by more than
0.5 % of full scale, since signals bend when the edge of the contact passes a fibre."""
PressShape = tuple[tuple[Array, Array], Array, geometry.WeightLaw]  # chains, extents and weight law of a press


def signals(
    pad: Morphology | Array,
    presses: ArrayLike,
    contact: Contact | None = None,
    *,
    precision: float = FINE_PRECISION,
    sensitivity: Array | None = None,
) -> Array:
    """Compute signals: the weighted length of each fibre's PCHIP curve in the press.

    Signals of a shape are exact, without sampling. The boundary belongs to the press, so that a straight fibre along an
    edge counts with its full length there. Signals of a layer or a profile are sums over short elements.

    Args:
        pad: a morphology; or knots of a population of square pads of the default pitch, 11.25 mm; shape
            (..., 2 M, N + 2, 2), grid units.
        presses: centres; shape (Q, 2), grid units. Or C simultaneous presses, shape (Q, C, 2), whose signals add, also
            in the overlap of their shapes.
        contact: contact model; the default layer, `Contact()`, if None.
        precision: error of signals near a press, relative to the largest signal, 1e-6 to 1: the RMS error for a layer,
            the maximum error for a profile. A shape ignores it: its uniform Manhattan signals have a closed form, all
            others are Gauss-Kronrod integrals with a relative error of 1e-11.
        sensitivity: factors on the response of each fibre to a layer or a profile, at K >= 2 even steps along its axis;
            shape (F, K). 1 if None; a shape ignores it.

    Returns:
        Signals; shape (Q, F), or (..., Q, F) of a population; grid units for weights without unit.

    Raises:
        InputError: presses of the wrong shape or not finite, or a precision out of range.
    """
    contact = or_default("contact", contact, Contact)
    along, across, layout, batch = fibre_axes(pad)
    centres, press_counts = check_presses(presses, several=True)
    fibres, unit_mm = layout.fibres, layout.unit_mm
    check_memory(len(along) * len(centres) * fibres)
    out = np.zeros((len(along), len(centres), fibres))
    if contact.model == "shape":
        curves, max_offsets = (along, across, population_slopes(along, across)), geometry.max_offsets(across, layout)
        where = curves, max_offsets, fibre_ends(layout), centres, press_shape(contact, unit_mm)
        map_chunks(lambda begin, end: exact_signals(*where, begin, end, out), len(along) * len(centres), 2000)
    elif len(centres):
        precision = check_float("precision", precision, 1e-6, 1.0)
        law = contact_law(contact, unit_mm)
        table, spacings = weight_table(contact, unit_mm, precision), element_spacings(contact, unit_mm, precision)
        for t, v, pad_signals in zip(along, across, out, strict=True):
            slope = population_slopes(t[None], v[None])[0]
            elements = element_signals.fibre_elements(t, v, slope, layout.horizontals, centres, law, spacings)
            if sensitivity is not None:
                element_signals.weigh_elements(elements, t, sensitivity)
            element_signals.element_signals(t, v, elements, centres, law, table, pad_signals)
    return _sum_simultaneous(out, (*batch, *press_counts, fibres))


def relative_stretch(pad: Morphology, presses: ArrayLike, contact: Contact) -> Array:
    """Compute the relative stretch (Q, F) of each fibre, its signal divided by its length.

    A fibre is a strain gauge: its relative change of resistance, which a voltage divider measures, grows with it.
    """
    return signals(pad, presses, contact) / lengths(pad)


def widened(contact: Contact, factor: float) -> Contact:
    """Return a contact whose press is wider by a factor > 0, of the same weight at its centre."""
    if factor == 1:
        return contact
    if contact.model == "layer":
        return contact.model_copy(update={"scale": factor * contact.scale})
    if contact.model == "shape":
        return contact.model_copy(update={"radius": factor * contact.radius})
    points = tuple((factor * distance_mm, weight) for distance_mm, weight in contact.sensitivity_profile)
    return contact.model_copy(update={"sensitivity_profile": points})


def indented_signals(
    pad: Morphology, presses: ArrayLike, depths_mm: ArrayLike, contact: Contact | None = None
) -> Array:
    """Compute signals of presses of known depths into an elastic layer.

    The contact is solved at DEPTH_STEPS depths of evenly spaced square roots, of which signals and the contact radius
    are smooth functions. A press is interpolated by the cubic through the four nearest.

    Args:
        pad: the fibres.
        presses: centres; shape (Q, 2), grid units.
        depths_mm: depth of each press, shape (Q,), or one for all; 0 to the depth of the contact, mm.
        contact: a layer, whose depth is the maximum; `Contact()` if None.

    Returns:
        Signals; shape (Q, F), grid units; they differ from those of `signals` by less than 1 % of the largest.

    Raises:
        InputError: presses or depths of the wrong shape, not finite or out of range, or a contact that is no layer.
    """
    contact, depths_mm = _check_depths(contact, depths_mm)
    centres, _ = check_presses(presses)
    if depths_mm.shape not in ((), (len(centres),)):
        raise InputError(f"depths_mm have shape {depths_mm.shape}, expected ({len(centres)},), one for every press")
    fibres = len(check_type("pad", pad, Morphology).knots)
    check_memory(len(centres) * fibres)
    out = np.zeros((len(centres), fibres))
    for rows, weight, solved in depth_terms(np.broadcast_to(depths_mm, len(centres)), contact):
        out[rows] += weight[:, None] * signals(pad, centres[rows], solved)
    return out


def depth_terms(depths_mm: Array, contact: Contact) -> Iterator[tuple[Ints, Array, Contact]]:
    """Yield the terms of an interpolation over depth of a quantity that is 0 at depth 0, for presses into a layer.

    The depths (Q,), mm, are from 0 to that of the contact. A term is the indices (n,) of presses, the weights (n,) of a
    solved contact for them, and that contact. If there are few depths, each is solved, and the weights are 1.
    """
    depths = np.unique(depths_mm)
    if len(depths) <= DEPTH_STEPS:
        for depth_mm in depths[depths > 0].tolist():
            rows = np.flatnonzero(depths_mm == depth_mm)
            yield rows, np.ones(len(rows)), Contact(**contact.model_dump() | {"depth_mm": depth_mm})
        return
    weights = _depth_weights(depths_mm, contact)
    for solved, weight in zip(_depth_steps(contact), weights.T, strict=True):
        rows = np.flatnonzero(weight)
        if rows.size:
            yield rows, weight[rows], solved


def press_forces_n(
    depths_mm: ArrayLike, contact: Contact | None = None, reduced_modulus_kpa: float = REDUCED_MODULUS_KPA
) -> Array:
    """Compute the force of presses of known depths into an elastic layer, interpolated as `indented_signals`.

    Args:
        depths_mm: depths of any shape; 0 to the depth of the contact, mm.
        contact: a layer, whose depth is the maximum; `Contact()` if None.
        reduced_modulus_kpa: E* = E / (1 - nu^2) of the silicone, kPa.

    Returns:
        Forces of the shape of the depths, N; they err by less than 0.05 % of the largest.

    Raises:
        InputError: depths or a modulus that are out of range, or a contact that is no layer.
    """
    contact, depths_mm = _check_depths(contact, depths_mm)
    modulus_kpa = check_float("reduced_modulus_kpa", reduced_modulus_kpa, 0, 1e12)
    forces = [contact_press(solved).force_n(modulus_kpa) for solved in _depth_steps(contact)]
    return _depth_weights(depths_mm, contact) @ np.array(forces)


def _check_depths(contact: Contact | None, depths_mm: ArrayLike) -> tuple[Contact, Array]:
    """Check that a contact is a layer and that depths are within its depth, and return both."""
    contact = or_default("contact", contact, Contact)
    if contact.model != "layer":
        raise InputError(f"contact is a {contact.model}, allowed is a layer: nothing else is pressed to a depth")
    depths_mm = check_array("depths_mm", depths_mm)
    refused = depths_mm[(depths_mm < 0) | (depths_mm > contact.depth_mm)]
    if refused.size:
        raise InputError(
            f"depths_mm has {refused.flat[0]:g}, allowed is 0 to {contact.depth_mm:g}, the contact's depth"
        )
    return contact, depths_mm


def _depth_steps(contact: Contact) -> list[Contact]:
    """Return the contact at DEPTH_STEPS depths up to its own."""
    shares = (np.arange(1, DEPTH_STEPS + 1) / DEPTH_STEPS) ** 2
    return [contact.model_copy(update={"depth_mm": share * contact.depth_mm}) for share in shares.tolist()]


def _depth_weights(depths_mm: Array, contact: Contact) -> Array:
    """Return the weights (..., DEPTH_STEPS) of the solved depths for interpolating a quantity that is 0 at depth 0."""
    step = DEPTH_STEPS * np.sqrt(depths_mm / contact.depth_mm)
    first = np.clip(np.floor(step) - 1, 0, DEPTH_STEPS - 3)
    x = step - first  # the cubic Lagrange polynomials on 0, 1, 2, 3 follow
    weights = np.zeros((*depths_mm.shape, DEPTH_STEPS + 1))
    cubic = (
        (1 - x) * (2 - x) * (3 - x) / 6,
        x * (2 - x) * (3 - x) / 2,
        x * (x - 1) * (3 - x) / 2,
        x * (x - 1) * (x - 2) / 6,
    )
    for node, weight in enumerate(cubic):
        np.put_along_axis(weights, (first + node).astype(np.int64)[..., None], weight[..., None], axis=-1)
    return weights[..., 1:]


def _sum_simultaneous(signals: Array, shape: tuple[int, ...]) -> Array:
    """Reshape signals to (..., Q, C, F) and sum them over the C simultaneous presses."""
    signals = signals.reshape(shape)
    return signals[..., 0, :] if shape[-2] == 1 else signals.sum(axis=-2)


def fibre_axes(pad: Morphology | Array, layout: Layout | None = None) -> tuple[Array, Array, Layout, tuple[int, ...]]:
    """Split a pad, or knots (..., F, N + 2, 2) of a population, into coordinates along and across each fibre's axis.

    Knots are in grid units; without a layout they are of a square pad of the default pitch. Returned are the
    coordinates along and across, both (P, F, N + 2), the layout, and the population's shape.

    Raises:
        InputError: knots of another shape, beyond MAX_COORDINATE, or not ascending along the axis.
    """
    is_pad = isinstance(pad, Morphology)
    knots = pad.knots if is_pad else check_array("knots", pad, MAX_COORDINATE)
    layout = pad.layout if is_pad else layout
    fibres = knots.shape[-3] if knots.ndim >= 3 else 0
    if not fibres or knots.shape[-1] != 2 or knots.shape[-2] < 2 or (layout is None and fibres % 2):
        raise InputError(f"knots have shape {knots.shape}, expected (..., 2 M, N + 2, 2)")
    layout = check_layout(fibres, layout)
    # in C order, since kernels would take seconds to compile for another memory order
    along, across = split_axes(np.ascontiguousarray(knots).reshape(-1, *knots.shape[-3:]), layout.horizontals)
    if not is_pad and not (np.diff(along) >= MIN_SPAN).all():
        raise InputError(f"knots do not ascend by {MIN_SPAN:g} or more along the fibre's axis")
    return along, across, layout, knots.shape[:-3]


def press_shape(contact: Contact, unit_mm: float) -> PressShape:
    """Convert a contact to grid units of `unit_mm`: chains and extents in the frame of each family, and weight law."""
    if contact.model == "shape":
        law = geometry.WeightLaw(contact.radius, _WEIGHTS[contact.weight], _LENGTHS[contact.length])
        return *geometry.frame_shape(contact.radius, contact.sides), law
    law = contact_law(contact, unit_mm)
    return *geometry.frame_shape(law.radius, None), law


def search_precision(contact: Contact) -> float:
    """Return the precision of `signals` in a search; it is coarser for a layer, whose strains have a step."""
    return LAYER_PRECISION if contact.model == "layer" else FINE_PRECISION


@lru_cache(maxsize=128)
def element_spacings(contact: Contact, unit_mm: float, precision: float) -> tuple[float, float]:
    """Return the spacings of elements of `element_signals` for a layer or a profile, grid units of `unit_mm`."""
    return element_signals.element_spacings(contact_law(contact, unit_mm), precision)


@lru_cache(maxsize=32)
def weight_table(contact: Contact, unit_mm: float, precision: float) -> Array:
    """Return the table of `element_signals` for a layer or a profile, in grid units of `unit_mm`."""
    return element_signals.weight_table(contact_law(contact, unit_mm), precision)


@lru_cache(maxsize=128)  # DEPTH_STEPS of several tools
def contact_law(contact: Contact, unit_mm: float) -> geometry.WeightLaw:
    """Convert a contact that is no shape to a weight law, in grid units of `unit_mm`."""
    families = tuple((distance / unit_mm, *weights) for distance, *weights in profile_weights(contact))
    near, edge = math.inf, 0.0
    if contact.model == "layer":
        edge = contact.scale * contact_press(contact).contact_radius_mm / unit_mm
        near = edge + contact.scale * contact.thickness_mm / 2 / unit_mm
    return geometry.profile_law(_LENGTHS[contact.length], families, near, edge)


def contact_press(contact: Contact) -> LayerPress:
    """Return the press of the tool of a contact into its layer, without its `scale`."""
    return solve_press(contact.tool, contact.tool_radius_mm, contact.depth_mm, contact.thickness_mm, contact.base)


def fibre_strains(contact: Contact) -> list[tuple[float, float]]:
    """Compute by family the maximum compressive strain across fibres and tensile strain along them, in a layer."""
    press = contact_press(contact)
    distances_mm = np.linspace(0, 2 * press.contact_radius_mm, 100)
    heights_mm = [contact.thickness_mm - depth_mm for depth_mm in contact.fibre_depths_mm]
    strains = [press.strains(distances_mm, height_mm, FIBRE_BLUR_MM) for height_mm in heights_mm]
    return [(float(s.compressive.max()), float(max(s.radial.max(), s.hoop.max()))) for s in strains]


def describe_large_strain(contact: Contact) -> str:
    """Return a warning if a contact is a layer with strains above 1, which are impossible; "" otherwise."""
    if contact.model != "layer":
        return ""
    press, fibres_mm = contact_press(contact), contact.thickness_mm - min(contact.fibre_depths_mm)
    distances_mm = np.linspace(0, 2 * press.contact_radius_mm, 50)
    heights_mm = np.linspace(0, fibres_mm, 9)  # at and below the fibres
    strains = [press.strains(distances_mm, height_mm, FIBRE_BLUR_MM) for height_mm in heights_mm.tolist()]
    largest = float(np.abs(strains).max())
    if largest <= 1:
        return ""
    return (
        f"[contact] strains the silicone by up to {largest:.2f}, {contact.depth_mm:g} mm deep in"
        f" {contact.thickness_mm:g} mm, which is possible in a linear model alone: signals and errors are rough"
    )


@lru_cache(maxsize=128)
def profile_weights(contact: Contact) -> tuple[tuple[Array, Array, Array], ...]:
    """Return the weights of a contact that is no shape, once for all fibres, or for each family.

    An element has the weight w(d) + v(d) cos^2 phi, with its distance d and the angle phi between the fibre and the
    direction to the press. Returned are distances d, mm, ascending from 0 to the end of the weight, and w and v there;
    all of shape (n,). For a layer these are strains, whose integral along a fibre is its effective elongation.
    """
    if contact.model == "profile":
        distance, weight = np.array(contact.sensitivity_profile).T
        return ((distance, weight, np.zeros_like(weight)),)
    press = contact_press(contact)
    thickness_mm = min(contact.thickness_mm, MAX_REACH_RADII * press.contact_radius_mm)
    distance = _layer_distances(contact, press.contact_radius_mm, thickness_mm)
    fade = np.clip((distance[-1] - distance) / thickness_mm, 0, 1)
    fade = fade * fade * (3 - 2 * fade)
    families = []
    for depth_mm in contact.fibre_depths_mm:
        strains = press.strains(distance, contact.thickness_mm - depth_mm, FIBRE_BLUR_MM)
        plain = contact.squeeze * strains.compressive + contact.stretch * strains.hoop
        directed = contact.stretch * (strains.radial - strains.hoop)
        directed[0] = 0.0  # by symmetry, except for rounding
        families.append((contact.scale * distance, fade * plain, fade * directed))
    return tuple(families)


def half_width_mm(contact: Contact) -> float:
    """Return the mean of `half_widths_mm` over the families, mm."""
    return float(np.mean(half_widths_mm(contact)))


def half_widths_mm(contact: Contact) -> list[float]:
    """Return the largest distance at which the weight is half of its maximum, mm, once for all fibres or by family.

    The weight is that of a layer or a profile, averaged over all directions of the fibre.
    """
    widths = []
    for distance, plain, directed in profile_weights(contact):
        weight = np.abs(plain + directed / 2)
        half = weight.max() / 2
        last = int(np.flatnonzero(weight >= half)[-1])  # not the last point, whose weight is 0
        share = (weight[last] - half) / (weight[last] - weight[last + 1])
        widths.append(float(distance[last] + share * (distance[last + 1] - distance[last])))
    return widths


def _layer_distances(contact: Contact, contact_radius_mm: float, thickness_mm: float) -> Array:
    """Return the distances at which strains are computed: nodes of panels that are shortest at the edge of the contact.

    The nodes are Chebyshev-Lobatto points of the squared distance; neighbouring panels have a node in common.
    """
    finest_mm = PANEL_SHARE * math.hypot(min(contact.fibre_depths_mm), 2 * FIBRE_BLUR_MM)

    def panels(length_mm: float) -> Array:
        ends = [0.0]
        while ends[-1] < length_mm:
            ends.append(ends[-1] + max(finest_mm, PANEL_SHARE * ends[-1]))
        return length_mm / ends[-1] * np.array(ends)

    reach_mm = LAYER_REACH[contact.base] * thickness_mm
    inside, outside = contact_radius_mm - panels(contact_radius_mm), contact_radius_mm + panels(reach_mm - thickness_mm)
    fading = outside[-1] + thickness_mm * np.array([0.5, 1.0])
    bounds = np.concatenate([inside[:0:-1], outside, fading]) ** 2
    nodes = (1 - np.cos(np.pi * np.arange(geometry.DEGREE) / geometry.DEGREE)) / 2
    squares = bounds[:-1, None] + np.diff(bounds)[:, None] * nodes
    return np.sqrt(np.append(squares, bounds[-1]))


def signals_quantized(
    pad: Morphology | Array, presses: ArrayLike, contact: Contact | None = None, samples: int = 2000
) -> Array:
    """Compute signals by the published rule, by which segments of a sampled fibre count if they start in the press.

    Args:
        pad: as in `signals`.
        presses: as in `signals`.
        contact: contact model; PUBLISHED_CONTACT if None.
        samples: points per fibre, uniform along its axis, at least 2 (published: 2000).

    Returns:
        Signals; shape (Q, F), or (..., Q, F) of a population; grid units for weights without unit.

    Raises:
        InputError: presses of the wrong shape or not finite, or fewer than 2 samples.
    """
    contact = or_default("contact", contact, Contact, PUBLISHED_CONTACT)
    along, across, layout, batch = fibre_axes(pad)
    pads, fibres, _ = along.shape
    shape, samples = press_shape(contact, layout.unit_mm), check_samples(samples, fibres)
    centres, press_counts = check_presses(presses, several=True)
    check_memory(pads * len(centres) * fibres)
    out = np.zeros((pads, len(centres), fibres))

    def compute(begin: int, end: int) -> None:
        quantized_signals(along, across, layout.horizontals, centres, shape, samples, begin, end, out)

    map_chunks(compute, pads * fibres, max(1, 200_000 // (samples + len(centres))))
    return _sum_simultaneous(out, (*batch, *press_counts, fibres))


def check_memory(values: int) -> None:
    """Check that signals fit into memory."""
    if values > MAX_VALUES:
        raise InputError(f"these are {values} signals, allowed at once are {MAX_VALUES}")


def check_samples(samples: int, fibres: int) -> int:
    """Check the number of samples per fibre, and return it."""
    return check_int("samples", samples, 2, min(MAX_SAMPLES, MAX_VALUES // max(fibres, 1)))


def check_presses(presses: ArrayLike, several: bool = False) -> tuple[Array, tuple[int, int]]:
    """Return presses (Q, 2) or, if `several`, (Q, C, 2) as a contiguous array (Q C, 2), and (Q, C)."""
    positions = check_array("presses", presses, MAX_COORDINATE)
    if positions.shape == (0,):
        positions = positions.reshape(0, 2)
    if positions.ndim not in ((2, 3) if several else (2,)) or positions.shape[-1] != 2:
        allowed = "(Q, 2) or (Q, C, 2)" if several else "(Q, 2)"
        raise InputError(f"presses have shape {positions.shape}, expected {allowed}")
    simultaneous = positions.shape[1] if positions.ndim == 3 else 1
    return np.ascontiguousarray(positions.reshape(-1, 2)), (len(positions), simultaneous)


def serpentine_presses(rectangle: Rectangle, side: int, jitter: float = 0.0, seed: int = 214) -> Array:
    """Return side x side presses (side^2, 2) in serpentine order: x ascends in even rows and descends in odd ones.

    Each is shifted by U(0, jitter) along both axes. Numbers are from NumPy's legacy RandomState, as in the publication.
    """
    rows = grid_positions(rectangle, side).reshape(side, side, 2)
    rows[1::2] = rows[1::2, ::-1]
    return rows.reshape(-1, 2) + np.random.RandomState(seed).random_sample((side * side, 2)) * jitter


def grid_positions(rectangle: Rectangle, side: int) -> Array:
    """Return evenly spaced positions (side^2, 2) from corner to corner of a rectangle, row by row from below."""
    x, y = (np.linspace(low, high, side) for low, high in zip(*rectangle, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
