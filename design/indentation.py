"""Indentation by a rigid body: contact radius, force, and the elongation of fibres on the deflected surface.

The pad is an elastic half-space and the indenter a frictionless rigid body of revolution. Depth d, contact radius a and
force F are then closed forms (Sneddon 1965, The relation between load and penetration in the axisymmetric Boussinesq
problem for a punch of arbitrary profile; Johnson 1985, Contact Mechanics, chapters 3 to 5). w(r) is the deflection of
the surface at the distance r from the axis, E* = E / (1 - nu^2) the reduced modulus:

    sphere of radius R    a = sqrt(R d)             F = 4/3 E* sqrt(R) d^1.5
        w = d - r^2 / (2 R) inside,     ((2 a^2 - r^2) asin(a / r) + a sqrt(r^2 - a^2)) / (pi R) outside
    cone of flank angle b    a = 2 d / (pi tan b)   F = 2 E* d^2 / (pi tan b)
        w = d - r tan b inside,         tan b (a asin(a / r) + sqrt(r^2 - a^2) - r) outside
    flat end of radius R     a = R                  F = 2 E* R d
        w = d inside,                   2 d / pi asin(a / r) outside

This is small-strain theory: the sphere is a paraboloid, a thin pad on a hard table is stiffer and deflects over a
smaller area, and silicone stiffens with strain. Lengths are in grid units.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.parallel import map_chunks
from padforge.design.common.validation import InputError, check_array, check_float, check_type, short_repr
from padforge.design.contact import check_memory, check_presses, fibre_axes
from padforge.design.kernels.indentation import CONE, FLAT, SPHERE, integrate_elongations
from padforge.design.kernels.pchip import population_slopes
from padforge.design.morphology import MAX_COORDINATE, Array, Morphology

Shape = Literal["sphere", "cone", "flat"]

REDUCED_MODULUS_KPA = 55 / (1 - 0.5**2)
"""E* of EcoFlex 00-20, kPa: modulus 55 kPa at 100 % strain (manufacturer's data sheet), incompressible."""
NEGLIGIBLE = 1e-7
"""Negligible error of a piece of fibre, relative to the elongation at the press."""
MIN_DEPTH = 1e-9
"""Depth below which fibres do not elongate, grid units: rounding errors would dominate."""
_SHAPES = {"sphere": SPHERE, "cone": CONE, "flat": FLAT}


@dataclass(frozen=True)
class Indenter:
    """A rigid body of revolution that is pressed straight down.

    Attributes:
        shape: "sphere", "cone", or "flat" for a punch with a flat end.
        radius: R of the sphere or of the flat end, grid units; not used for a cone.
        angle_deg: angle between a cone's flank and the surface, degrees; not used for the others.

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
        """Return the contact radius at each depth, grid units.

        Args:
            depths: depths of any shape, grid units.
        """
        d = self._check_depths(depths)
        if self.shape == "sphere":
            return np.sqrt(self.radius * d)
        if self.shape == "cone":
            return 2 * d / (np.pi * self.flank_slope)
        return np.where(d > 0, self.radius, 0.0)

    def deflection(self, r: ArrayLike, depth: float) -> Array:
        """Return the deflection of the surface, grid units.

        Args:
            r: distances from the axis, of any shape; grid units.
            depth: depth of the press, grid units.
        """
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
            return np.where(r <= a, depth - r * self.flank_slope, self.flank_slope * (a * angle + height - r))
        return 2 * depth / np.pi * angle

    def force(self, depths: ArrayLike) -> Array:
        """Return F / E* at each depth, squared grid units.

        Args:
            depths: depths of any shape, grid units.
        """
        d = self._check_depths(depths)
        if self.shape == "sphere":
            return 4 / 3 * np.sqrt(self.radius) * d**1.5
        if self.shape == "cone":
            return 2 * d**2 / (np.pi * self.flank_slope)
        return 2 * self.radius * d

    def force_n(self, depths: ArrayLike, unit_mm: float, reduced_modulus_kpa: float = REDUCED_MODULUS_KPA) -> Array:
        """Return the force at each depth, N.

        Args:
            depths: depths of any shape, grid units.
            unit_mm: the pad's grid unit, mm.
            reduced_modulus_kpa: E*, kPa.
        """
        unit_mm = check_float("unit_mm", unit_mm, 0.1, 1000)
        reduced_modulus_kpa = check_float("reduced_modulus_kpa", reduced_modulus_kpa, 0, 1e12)
        return self.force(depths) * unit_mm**2 * reduced_modulus_kpa * 1e-3  # kPa mm^2 = 1e-3 N

    @property
    def flank_slope(self) -> float:
        """Slope of a cone's flank."""
        return float(np.tan(np.radians(self.angle_deg)))

    def _check_depths(self, depths: ArrayLike) -> Array:
        d = check_array("depths", depths)
        deepest = self.radius if self.shape == "sphere" else MAX_COORDINATE
        refused = d[(d < 0) | (d > deepest)]
        if refused.size:
            allowed = f"0 to the sphere's radius, {deepest:g}" if self.shape == "sphere" else f"0 to {deepest:g}"
            raise InputError(f"depth is {refused.flat[0]:g}, allowed is {allowed} (grid units)")
        return d


def indented_signals(pad: Morphology, presses: ArrayLike, depths: ArrayLike, indenter: Indenter) -> Array:
    """Compute signals of presses of known depth: the elongation of each fibre on the deflected surface.

    A fibre lies on the surface and sticks to it; its elongation is the integral of sqrt(1 + (dw/ds)^2) - 1 over its
    length s. The deflection is nowhere 0, but the integrand falls with the fourth power of the distance: the integral
    is over the entire fibre, and neglects only what lies beyond the pad.

    Args:
        pad: the fibres.
        presses: positions of the indenter's axis; shape (Q, 2), grid units.
        depths: depths; shape (Q,), or one for all; grid units.
        indenter: the rigid body.

    Returns:
        Elongations; shape (Q, F), grid units, with a relative error of 3e-5 (measured against adaptive quadrature).

    Raises:
        InputError: presses or depths of the wrong shape, not finite, or deeper than the indenter allows.
    """
    centres, _ = check_presses(presses)
    deep = check_array("depths", depths)
    if deep.shape not in ((), (len(centres),)):
        raise InputError(f"depths have shape {deep.shape}, expected ({len(centres)},), one for every press")
    deep = np.broadcast_to(deep, len(centres))
    a = np.where(deep < MIN_DEPTH, 0, check_type("indenter", indenter, Indenter).contact_radius(deep))
    steepness = {  # scale of dw/dr, see `integrate_elongations`
        "sphere": a / indenter.radius,
        "cone": np.full(len(a), indenter.flank_slope),
        "flat": 2 * deep / (np.pi * indenter.radius),
    }[indenter.shape]
    along, across, ends, _ = fibre_axes(check_type("pad", pad, Morphology))
    check_memory(len(centres) * along.shape[1])
    curves = along[0], across[0], population_slopes(along, across)[0]
    indentation = a, steepness, NEGLIGIBLE * deep * np.minimum(1, steepness), _SHAPES[indenter.shape]
    out = np.zeros((len(centres), along.shape[1]))

    def compute(begin: int, end: int) -> None:
        integrate_elongations(curves, ends.horizontals, centres, indentation, begin, end, out)

    map_chunks(compute, len(centres), min_chunk=50)
    return out
