"""A rigid indenter pressed into the pad: how far it makes contact, what it takes, and what the fibres signal.

The pad is taken for an elastic half-space, the indenter for a rigid body of revolution without friction; depth d,
contact radius a and force F are then closed forms (Sneddon 1965, The relation between load and penetration in the
axisymmetric Boussinesq problem for a punch of arbitrary profile; Johnson 1985, Contact Mechanics, chapters 3 to 5).
w(r) is how far the surface goes down at the distance r from the axis, E* = E / (1 - nu^2) the reduced modulus:

    sphere of radius R    a = sqrt(R d)             F = 4/3 E* sqrt(R) d^1.5
        w = d - r^2 / (2 R) inside,     ((2 a^2 - r^2) asin(a / r) + a sqrt(r^2 - a^2)) / (pi R) outside
    cone of flank angle b    a = 2 d / (pi tan b)   F = 2 E* d^2 / (pi tan b)
        w = d - r tan b inside,         tan b (a asin(a / r) + sqrt(r^2 - a^2) - r) outside
    flat end of radius R     a = R                  F = 2 E* R d
        w = d inside,                   2 d / pi asin(a / r) outside

This is small-strain theory: the sphere is a paraboloid to it, a thin pad on a hard table is stiffer and deflects less
far around, and silicone stiffens with strain. Lengths are in grid units.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.parallel import map_chunks
from padforge.design.common.validation import InputError, check_array, check_float, check_type, short_repr
from padforge.design.contact import check_memory, check_presses, fibre_axes
from padforge.design.kernels.indentation import CONE, FLAT, SPHERE, lengthenings
from padforge.design.kernels.pchip import population_slopes
from padforge.design.morphology import MAX_COORDINATE, Array, Morphology

Shape = Literal["sphere", "cone", "flat"]

REDUCED_MODULUS_KPA = 55 / (1 - 0.5**2)
"""E* of EcoFlex 00-20, kPa: 55 kPa is its modulus at 100 % strain (maker's data sheet), and it is incompressible."""
NEGLIGIBLE = 1e-7
"""Error of a piece of fibre that does not matter, of the lengthening right at the press."""
MIN_DEPTH = 1e-9
"""Depth below which a press lengthens nothing, grid units: its error could no longer be told from rounding."""
_SHAPES = {"sphere": SPHERE, "cone": CONE, "flat": FLAT}


@dataclass(frozen=True)
class Indenter:
    """A rigid body of revolution that is pressed straight down.

    Attributes:
        shape: "sphere", "cone", or "flat" for a punch with a flat end.
        radius: R of the sphere or of the flat end, grid units; a cone has none.
        angle_deg: between the cone's flank and the surface, degrees; the others have none.

    Raises:
        InputError: an unknown shape, or a radius or an angle out of range.
    """

    shape: Shape = "sphere"
    radius: float = 0.7
    angle_deg: float = 45.0

    def __post_init__(self) -> None:
        if not isinstance(self.shape, str) or self.shape not in get_args(Shape):
            raise InputError(f"shape is {short_repr(self.shape)}, allowed is {', '.join(get_args(Shape))}")
        object.__setattr__(self, "radius", check_float("radius", self.radius, 1e-6, 1e4))
        object.__setattr__(self, "angle_deg", check_float("angle_deg", self.angle_deg, 0.01, 89.9))

    def contact_radius(self, depths: ArrayLike) -> Array:
        """Radius of the contact, of the shape of `depths`; all in grid units."""
        d = self._checked(depths)
        if self.shape == "sphere":
            return np.sqrt(self.radius * d)
        if self.shape == "cone":
            return 2 * d / (np.pi * self._flank)
        return np.where(d > 0, self.radius, 0.0)

    def deflection(self, r: ArrayLike, depth: float) -> Array:
        """How far down the surface goes at distances `r` from the axis, of the shape of `r`; all in grid units."""
        r, depth = check_array("r", r, MAX_COORDINATE), check_float("depth", depth, 0, MAX_COORDINATE)
        a = float(self.contact_radius(depth))
        if a == 0:
            return np.zeros(r.shape)
        angle = np.arcsin(a / np.maximum(r, a))
        height = np.sqrt(np.maximum(r**2 - a**2, 0))
        if self.shape == "sphere":
            outside = ((2 * a**2 - r**2) * angle + a * height) / (np.pi * self.radius)
            return np.where(r <= a, depth - r**2 / (2 * self.radius), outside)
        if self.shape == "cone":
            return np.where(r <= a, depth - r * self._flank, self._flank * (a * angle + height - r))
        return 2 * depth / np.pi * angle

    def force(self, depths: ArrayLike) -> Array:
        """F / E* in squared grid units, of the shape of `depths`."""
        d = self._checked(depths)
        if self.shape == "sphere":
            return 4 / 3 * np.sqrt(self.radius) * d**1.5
        if self.shape == "cone":
            return 2 * d**2 / (np.pi * self._flank)
        return 2 * self.radius * d

    def force_n(self, depths: ArrayLike, unit_mm: float, reduced_modulus_kpa: float = REDUCED_MODULUS_KPA) -> Array:
        """Force in newton, of the shape of `depths`, on a pad whose grid unit is `unit_mm`."""
        unit_mm = check_float("unit_mm", unit_mm, 0.1, 1000)
        reduced_modulus_kpa = check_float("reduced_modulus_kpa", reduced_modulus_kpa, 0, 1e12)
        return self.force(depths) * unit_mm**2 * reduced_modulus_kpa * 1e-3  # kPa mm^2 = 1e-3 N

    @property
    def _flank(self) -> float:
        return float(np.tan(np.radians(self.angle_deg)))

    def _checked(self, depths: ArrayLike) -> Array:
        """Depths as numbers.

        Raises:
            InputError: a depth that is not finite, below 0, or deeper than the sphere's radius.
        """
        d = check_array("depths", depths)
        deepest = self.radius if self.shape == "sphere" else MAX_COORDINATE
        wrong = d[(d < 0) | (d > deepest)]
        if wrong.size:
            allowed = f"0 to the sphere's radius, {deepest:g}" if self.shape == "sphere" else f"0 to {deepest:g}"
            raise InputError(f"depth is {wrong.flat[0]:g}, allowed is {allowed} (grid units)")
        return d


def indented_signals(pad: Morphology, presses: ArrayLike, depths: ArrayLike, indenter: Indenter) -> Array:
    """Signals of presses of a given depth: how much longer each fibre becomes that follows the deflected surface.

    A fibre lies on the surface and sticks to it; its lengthening is the integral of sqrt(1 + (dw/ds)^2) - 1 over its
    own length s. The deflection reaches everywhere, but the integrand falls with the fourth power of the distance: the
    whole fibre is integrated, nothing is cut off but what lies beyond the pad.

    Args:
        presses: (Q, 2) places of the indenter's axis, grid units. depths: (Q,) depths, or one for all, grid units.

    Returns:
        (Q, F) lengthenings in grid units, within 3e-5 of themselves (measured against adaptive quadrature).

    Raises:
        InputError: presses or depths of the wrong shape, not finite, or deeper than the indenter allows.
    """
    places, _ = check_presses(presses)
    deep = check_array("depths", depths)
    if deep.shape not in ((), (len(places),)):
        raise InputError(f"depths have shape {deep.shape}, expected ({len(places)},), one for every press")
    deep = np.broadcast_to(deep, len(places))
    a = np.where(deep < MIN_DEPTH, 0, check_type("indenter", indenter, Indenter).contact_radius(deep))
    steepness = _steepness(indenter, deep, a)
    travel, cross, ends, _ = fibre_axes(check_type("pad", pad, Morphology))
    check_memory(len(places) * travel.shape[1])
    slope = population_slopes(travel, cross)[0]
    out = np.zeros((len(places), travel.shape[1]))
    floor = NEGLIGIBLE * deep * np.minimum(1, steepness)

    def work(begin: int, end: int) -> None:
        shape = _SHAPES[indenter.shape]
        lengthenings(travel[0], cross[0], slope, ends.horizontals, places, a, steepness, floor, shape, begin, end, out)

    map_chunks(work, len(places), min_chunk=50)
    return out


def _steepness(indenter: Indenter, depths: Array, a: Array) -> Array:
    """(Q,) what scales the slope of the surface, as `lengthenings` takes it."""
    if indenter.shape == "sphere":
        return a / indenter.radius
    if indenter.shape == "cone":
        return np.full(len(a), np.tan(np.radians(indenter.angle_deg)))
    return 2 * depths / (np.pi * indenter.radius)
