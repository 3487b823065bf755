"""An elastic layer on a rigid base, pressed by a tool: contact radius, force, deflection and strains.

The layer of thickness t is incompressible, linear, and bonded to its base or free to slip on it; the tool is a body of
revolution that slides on the pressed face. Displacements are Hankel integrals over the wavenumber k of the pressure p
on the face (Sneddon 1951, Fourier Transforms, ch. 10; Johnson 1985, Contact Mechanics, ch. 3 and 5). At the height z,
the displacements downward (w) and outward (u) are, with the shear modulus G and the transfer functions W, E of
`_transfer`,

    w(r, z) = 1 / 2G  int p(k) W(k, z) J0(k r) dk,      u(r, z) = 1 / 2G  int p(k) E(k, z) J1(k r) dk,
    -eps_zz = 1 / 2G  int k p(k) E(k, z) J0(k r) dk,    p(k) = 4 G / pi  int_0^a phi(s) cos(k s) ds.

This form of p(k) has no pressure outside the contact radius a. Inside it the face follows the tool if (Lebedev and
Ufliand 1958, Axisymmetric contact problem for an elastic layer)

    (1 + c) phi(x) - 2 / pi  int_0^a phi(s) int (1 - W(k, t)) cos(k x) cos(k s) dk ds = d - f(x),    0 <= x <= a,

    f(x) = x^2 / R  for a dome, a paraboloid of tip radius R,    x artanh(x / R)  for a ball,    0  for a flat end,

which is solved with even Legendre polynomials for phi. d is the depth. The contact of a smooth tool ends at the radius
a of phi(a) = 0, that of a flat end at its edge. c is the compliance of the tool relative to that of the pad: 0 for a
rigid tool, 1 for a finger, a dome as soft as the pad. On a thick layer the results are Hertz's and Sneddon's closed
forms.
"""

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.common.validation import InputError
from padforge.design.settings import Base, Tool

Array = NDArray[np.float64]


def reduced_modulus_kpa(modulus_kpa: float) -> float:
    """Return E* = E / (1 - nu^2) of an incompressible material, nu = 1/2, from its Young's modulus E, kPa."""
    return modulus_kpa / (1 - 0.5**2)


SILICONE, MODULUS_KPA = "Ecoflex 00-20", 55
"""Silicone of a pad where no other is stated, and its modulus at 100 % strain in the manufacturer's data sheet."""
REDUCED_MODULUS_KPA = reduced_modulus_kpa(MODULUS_KPA)
"""E* of that silicone, kPa."""
TERMS = 16
"""Number of Legendre polynomials of phi, with which forces have a relative error of 1e-6 up to a contact radius of ten
thicknesses, and of 5e-4 at MAX_CONTACT."""
MAX_CONTACT = 100.0  # maximum contact radius, thicknesses
_DECAY = 25.0  # wavenumber times depth below the face from which a field is neglected, since it has decayed to exp(-25)


class Strains(NamedTuple):
    """Strains (n,) of the incompressible silicone at a height, by the distance from the axis of the tool."""

    compressive: Array  # vertical compression -eps_zz
    radial: Array  # du / dr
    hoop: Array  # circumferential strain u / r


@dataclass(frozen=True)
class LayerPress:
    """One press of a tool into a layer."""

    thickness_mm: float
    base: Base
    contact_radius_mm: float
    load: Array  # coefficients of phi by the Legendre polynomials P_0, P_2, ... of x / a; shape (TERMS,), mm

    def force_n(self, reduced_modulus_kpa: float = REDUCED_MODULUS_KPA) -> float:
        """Return the force, N, for E* = E / (1 - nu^2) of the silicone, kPa."""
        return 2e-3 * reduced_modulus_kpa * self.contact_radius_mm * float(self.load[0])  # kPa mm^2 = 1e-3 N

    def deflection(self, r_mm: ArrayLike) -> Array:
        """Return the downward displacement (n,) of the pressed face, mm, at distances (n,) from the axis."""
        r, a = np.asarray(r_mm, dtype=float), self.contact_radius_mm
        nodes, weights = _gauss(200)
        # 1. the half-space: int phi(s) / sqrt(r^2 - s^2) ds with s = min(r, a) sin(angle)
        inside, angle = np.minimum(r, a)[:, None], np.pi / 2 * nodes
        series = np.polynomial.legendre.legval(inside / a * np.sin(angle), np.insert(self.load, range(1, TERMS), 0.0))
        within = r[:, None] <= a
        root = np.sqrt(np.maximum(r[:, None] ** 2 - (a * np.sin(angle)) ** 2, 1e-300))
        half_space = np.where(within, series, series * a * np.cos(angle) / root) @ (np.pi / 2 * weights)
        # 2. the correction for the finite thickness
        k, correction = _thickness_correction(self.base, self.thickness_mm, a + float(r.max(initial=0.0)))
        layer = correction * (self.load @ _legendre_waves(k, a))
        return 2 / np.pi * (half_space - _bessel(0, r, k) @ layer)

    def strains(self, r_mm: ArrayLike, height_mm: float, blur_mm: float = 0.0) -> Strains:
        """Return the strains at a height.

        Args:
            r_mm: distances from the axis; shape (n,).
            height_mm: height above the base, mm; clipped to a depth below the face of a hundredth of the thickness or
                of the contact radius.
            blur_mm: standard deviation of a Gaussian in the plane by which strains are averaged, mm.
        """
        r = np.asarray(r_mm, dtype=float)
        min_depth_mm = 0.01 * min(self.thickness_mm, self.contact_radius_mm)
        height_mm = min(height_mm, self.thickness_mm - min_depth_mm)
        k, weight, pressure = self._waves(height_mm, r.max(initial=0.0), blur_mm)
        _, outward = _transfer(self.base, k, height_mm, self.thickness_mm)
        amplitude = weight * pressure * outward * np.exp(-((k * blur_mm) ** 2) / 2)
        compressive = _bessel(0, r, k) @ (k * amplitude)
        hoop = np.where(r > 0, _bessel(1, r, k) @ amplitude / np.where(r > 0, r, 1), compressive / 2)
        return Strains(compressive, compressive - hoop, hoop)

    def _waves(self, height_mm: float, farthest_mm: float, blur_mm: float) -> tuple[Array, Array, Array]:
        """Return wavenumbers, their quadrature weights, and p(k) / 2G, for a field up to a distance."""
        depth = self.thickness_mm - height_mm
        # the solution of k depth + k^2 blur^2 / 2 = _DECAY
        max_k = 2 * _DECAY / (depth + math.sqrt(depth**2 + 2 * _DECAY * blur_mm**2))
        # A panel has up to 24 radians of the fastest oscillation, which 16 nodes integrate to 1e-10. Twenty panels
        # resolve the transfer functions of the layer.
        panels = 20 + math.ceil(max_k * (self.contact_radius_mm + farthest_mm) / 24)
        nodes, weights = _gauss(16)
        k = (max_k / panels * (np.arange(panels)[:, None] + nodes)).ravel()
        weight = np.tile(max_k / panels * weights, panels)
        return k, weight, 2 / np.pi * (self.load @ _legendre_waves(k, self.contact_radius_mm))


@lru_cache(maxsize=256)
def solve_press(
    tool: Tool, radius_mm: float, depth_mm: float, thickness_mm: float, base: Base = "bonded"
) -> LayerPress:
    """Solve the contact of a tool with a layer.

    Args:
        tool: "dome", a paraboloid of tip radius R; "ball", a sphere; "flat", the end of a rod; "finger", a soft dome.
        radius_mm: R of the tool, > 0.
        depth_mm: depth of the tool's tip below the undeformed face, > 0; for a finger, the approach of both bodies.
        thickness_mm: thickness of the layer, more than the depth.
        base: "bonded" to its base, or "slipping" on it without friction.

    Returns:
        The press. A ball that is pressed in deeper than its radius allows has the contact radius of its equator.

    Raises:
        InputError: the contact is wider than MAX_CONTACT.
    """
    from scipy.optimize import brentq

    compliance = 1.0 if tool == "finger" else 0.0  # the moduli of fingertip and pad are both tens of kPa

    @cache  # the solver evaluates the ends of its bracket again, and its root
    def solve(a: float) -> tuple[Array, Array]:
        return _solve_phi(tool, radius_mm, a, thickness_mm, base, compliance)

    def minus_phi_at_edge(a: float) -> float:  # phi(a) is the sum of its coefficients, since P_2n(1) = 1
        unit, shape = solve(a)
        return float(shape.sum() - depth_mm * unit.sum())

    # the contact radius is between Hertz's and, for a thin layer, twice that; the bracket has slack
    hertz = math.sqrt(radius_mm * depth_mm)
    tool_limit = radius_mm if tool == "flat" else radius_mm * (1 - 1e-6) if tool == "ball" else math.inf
    upper = min(3 * hertz, tool_limit, MAX_CONTACT * thickness_mm)
    if tool == "flat" or minus_phi_at_edge(upper) < 0:
        a = tool_limit
        if a > MAX_CONTACT * thickness_mm:
            raise InputError(
                f"tool_radius_mm is {radius_mm:g}, by which the contact is too wide for a thickness_mm of "
                f"{thickness_mm:g}, allowed are {MAX_CONTACT:g} times the thickness"
            )
    else:
        lower = min(0.5 * hertz, upper / 2)
        a = float(brentq(minus_phi_at_edge, lower, upper, xtol=1e-10 * hertz))  # pyright: ignore[reportArgumentType]
    unit, shape = solve(a)
    return LayerPress(thickness_mm, base, a, depth_mm * unit - shape)


def _solve_phi(
    tool: Tool, radius: float, a: float, thickness: float, base: Base, compliance: float
) -> tuple[Array, Array]:
    """Return the Legendre coefficients (TERMS,) of phi on [0, a], by Galerkin's method for 1 and for f(x).

    The phi of a press is that for 1, times its depth, less that for f(x).
    """
    nodes, weights = _gauss(400)
    x = a * nodes
    k, correction = _thickness_correction(base, thickness, 2 * a)
    waves = _legendre_waves(k, a)
    order = np.arange(TERMS)
    matrix = np.diag((1 + compliance) * a / (4 * order + 1))
    matrix -= 2 / np.pi * (waves * correction) @ waves.T
    shape = x * np.arctanh(x / radius) if tool == "ball" else x**2 / radius * (tool != "flat")
    polynomials = np.polynomial.legendre.legvander(nodes, 2 * TERMS - 2)[:, ::2].T
    right = np.stack([polynomials @ (a * weights), polynomials @ (a * weights * shape)])
    unit_solution, shape_solution = np.linalg.solve(matrix, right.T).T
    return unit_solution, shape_solution


def _thickness_correction(base: Base, thickness: float, farthest: float) -> tuple[Array, Array]:
    """Return wavenumbers k, and quadrature weights times 1 - W on the face, which is 0 for a half-space.

    The integrands oscillate at most as fast as cos(k farthest).
    """
    nodes, weights = _gauss(400)
    panels = math.ceil(farthest / (40 * thickness))  # up to 800 radians in each
    width = 20.0 / thickness / panels  # from k t = 20 on, the layer equals a half-space to 1e-15
    k = (width * (np.arange(panels)[:, None] + nodes)).ravel()
    return k, np.tile(width * weights, panels) * (1 - _transfer(base, k, thickness, thickness)[0])


def _transfer(base: Base, k: Array, height: float, thickness: float) -> tuple[Array, Array]:
    """Return W and E at wavenumbers k > 0 and a height; they are 1 and 0 on the face of a half-space.

    They solve (d^2 / dz^2 - k^2)^2 w = 0 with p(k) and no shear on the face, and with w = 0 and u = 0 or no shear on
    the base. All terms are scaled by exp(-k t) to avoid overflow.
    """
    x, y = k * thickness, k * height
    decayed = np.exp(-2 * x)
    cosh, sinh = (1 + decayed) / 2, (1 - decayed) / 2
    cosh_y, sinh_y = (np.exp(y - x) + np.exp(-y - x)) / 2, (np.exp(y - x) - np.exp(-y - x)) / 2
    if base == "slipping":
        determinant = sinh * cosh + x * decayed
        downward = ((sinh + x * cosh) * sinh_y - sinh * y * cosh_y) / determinant
        return downward, (x * cosh * cosh_y - sinh * y * sinh_y) / determinant
    determinant = cosh**2 + x**2 * decayed
    first, second = (cosh + x * sinh) / determinant, x * cosh / determinant
    return first * (sinh_y - y * cosh_y) + second * y * sinh_y, second * (sinh_y + y * cosh_y) - first * y * sinh_y


def _legendre_waves(k: Array, a: float) -> Array:
    """Return the integrals of P_2n(x / a) cos(k x) over [0, a]; shape (TERMS, n)."""
    from scipy.special import spherical_jn

    order = np.arange(TERMS)[:, None]
    return a * (-1.0) ** order * spherical_jn(2 * order, a * k)


def _bessel(order: int, r: Array, k: Array) -> Array:
    """Return J_order(k r); shape (n, waves)."""
    from scipy.special import j0, j1

    return (j0 if order == 0 else j1)(np.multiply.outer(r, k))


@cache
def _gauss(count: int) -> tuple[Array, Array]:
    """Return the nodes and weights of a Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (1 + nodes) / 2, weights / 2
