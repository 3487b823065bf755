"""The indentation model against identities of contact mechanics, closed forms and adaptive quadrature."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from padforge.design import InputError, Morphology
from padforge.design.contact import fibre_axes
from padforge.design.indentation import REDUCED_MODULUS_KPA, Indenter, indented_signals
from tests.design.wild_pads import SEEDS, mirrored, transposed, wild_pads, wild_presses

INDENTERS = [Indenter("sphere", 0.7), Indenter("cone", angle_deg=30), Indenter("flat", 0.45)]

indenters = st.builds(
    Indenter, shape=st.sampled_from(["sphere", "cone", "flat"]), radius=st.floats(0.2, 2), angle_deg=st.floats(2, 80)
)


def slope(indenter, r, depth):
    """dw/dr, differentiated by hand from the deflections of the module's docstring."""
    a, flank = indenter.contact_radius(depth), np.tan(np.radians(indenter.angle_deg))
    if indenter.shape == "sphere":
        if r <= a:
            return -r / indenter.radius
        return -2 / (np.pi * indenter.radius) * (r * np.arcsin(a / r) - a * np.sqrt(1 - (a / r) ** 2))
    if indenter.shape == "cone":
        return -flank if r <= a else flank * (np.sqrt(1 - (a / r) ** 2) - 1)
    return 0.0 if r <= a else -2 * depth / np.pi * a / (r * np.sqrt(r**2 - a**2))


def oracle(pad, press, depth, indenter, fibre):
    """One signal: SciPy's adaptive quadrature between knots, edges of the contact and the nearest point."""
    axis = 0 if fibre < pad.grid else 1
    t, a = pad.knots[fibre, :, axis], float(indenter.contact_radius(depth))
    curve = PchipInterpolator(t, pad.knots[fibre, :, 1 - axis])
    rise = curve.derivative()

    def away(x):
        return np.hypot(x - press[axis], curve(x) - press[1 - axis])

    def density(x):
        r, own = away(x), np.hypot(1, rise(x))
        fall = 0.0
        if r > 0:
            along = (x - press[axis]) + (curve(x) - press[1 - axis]) * rise(x)
            fall = slope(indenter, r, depth) * along / r
        return np.hypot(own, fall) - own

    cuts = set(t)
    for low, high in pairwise(t):
        at = np.linspace(low, high, 2001)
        inside = away(at) <= a
        cuts |= {
            brentq(lambda x: away(x) - a, at[i], at[i + 1], xtol=1e-15)
            for i in np.flatnonzero(inside[1:] != inside[:-1])
        }
        cuts.add(at[away(at).argmin()])
    total = 0.0
    for low, high in pairwise(sorted(cuts)):
        middle, half = (low + high) / 2, (high - low) / 2
        # towards both ends by a cosine, which takes the pole at a flat punch's edge away
        total += quad(
            lambda u, m=middle, h=half: density(m - h * np.cos(u)) * h * np.sin(u), 0, np.pi, epsrel=1e-9, limit=200
        )[0]
    return total


@given(indenters, st.floats(0.01, 0.19))
@settings(max_examples=40)
def test_indenter_stiffness_is_twice_modulus_times_contact_radius(indenter, depth):
    step = 1e-5 * depth
    stiffness = (indenter.force(depth + step) - indenter.force(depth - step)) / (2 * step)
    np.testing.assert_allclose(stiffness, 2 * indenter.contact_radius(depth), rtol=1e-6)


@given(indenters, st.floats(0.01, 0.19), st.floats(0.02, 6))
@settings(max_examples=30)
def test_deflection_is_a_superposition_of_flat_punches(indenter, depth, r):
    """Any contact grows as a flat punch of the present radius would be pressed on (Mossakovskii 1963)."""
    a, deflection = float(indenter.contact_radius(depth)), float(indenter.deflection(r, depth))

    def pressed_on(radius):  # depth gained per contact radius
        if indenter.shape == "sphere":
            return 2 * radius / indenter.radius
        return np.pi / 2 * np.tan(np.radians(indenter.angle_deg))

    def below(radius):
        return 2 / np.pi * np.arcsin(min(1, radius / r))

    if indenter.shape == "flat":
        expected = depth * below(a)
    else:
        edges = [0, min(r, a), a]
        expected = sum(quad(lambda s: below(s) * pressed_on(s), *ends)[0] for ends in pairwise(edges))
    np.testing.assert_allclose(deflection, expected, rtol=1e-6, atol=1e-9)


@given(indenters, st.integers(0, 6), st.floats(0.01, 0.19), SEEDS)
@settings(max_examples=12)
def test_indented_signals_match_adaptive_quadrature(indenter, knots, depth, seed):
    rng = np.random.default_rng(seed)
    pad = Morphology.random(2, knots, rng)
    presses = rng.uniform(0, 3, (1, 2))
    found = indented_signals(pad, presses, depth, indenter)
    expected = [[oracle(pad, press, depth, indenter, fibre) for fibre in range(4)] for press in presses]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-11)


@pytest.mark.parametrize("indenter", INDENTERS, ids=lambda indenter: indenter.shape)
@pytest.mark.parametrize("miss", [0, 1e-12, 1e-6, -1e-6, -1e-12])
def test_indented_signals_are_continuous_at_grazing_fibres(indenter, miss):
    depth = 0.3
    a = float(indenter.contact_radius(depth))
    pad = Morphology.straight(2)
    at = np.array([[1.3, 1 + a + miss], [1.3, 1 + a + 1e-7]])
    grazed, neighbour = indented_signals(pad, at, depth, indenter)[:, 0]
    assert grazed == pytest.approx(neighbour, rel=0.01)


@given(
    wild_pads((1, 2), (0, 5)),
    st.sampled_from(["sphere", "cone", "flat"]),
    st.sampled_from([(1e-6, 0.01), (0.7, 30.0), (1e4, 89.9)]),
    st.sampled_from([0.0, 1e-300, 1e-9, 1e-6, 0.3]),
    SEEDS,
)
@settings(max_examples=25)
def test_indented_signals_are_invariant_under_reflection_and_finite(pad, shape, size, depth, seed):
    indenter, presses, grid = Indenter(shape, *size), wild_presses(pad, seed, 4), pad.grid
    depth = depth * min(indenter.radius, 1) if shape == "sphere" else depth
    found = indented_signals(pad, presses, depth, indenter)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert depth > 0 or not found.any()
    swapped = indented_signals(transposed(pad), presses[:, ::-1], depth, indenter)
    np.testing.assert_allclose(np.roll(swapped, grid, axis=1), found, rtol=1e-3, atol=1e-6 * max(depth, 1e-9))
    if pad.knots.shape[1] == 2 or np.diff(fibre_axes(pad)[0]).min() > 1e-5:  # steps move by rounding in a mirror
        flipped = indented_signals(mirrored(pad), presses * [-1, 1] + [grid + 1, 0], depth, indenter)
        order = np.r_[:grid, 2 * grid - 1 : grid - 1 : -1]
        # the slope of a flat punch is infinite at its rim, so that the rounding of a mirrored position shows
        atol = (1e-3 if shape == "flat" else 1e-6) * max(depth, 1e-9)
        np.testing.assert_allclose(flipped[:, order], found, rtol=1e-3, atol=atol)


def test_indented_signals_do_not_depend_on_batching():
    pad, rng = Morphology.random(4, 5, 0), np.random.default_rng(3)
    presses, depths = rng.uniform(0, 5, (120, 2)), rng.uniform(0.1, 0.45, 120)
    many = indented_signals(pad, presses, depths, INDENTERS[0])
    one = indented_signals(pad, presses[107:108], depths[107:108], INDENTERS[0])
    np.testing.assert_array_equal(many[107:108], one)
    assert indented_signals(pad, [], [], INDENTERS[0]).shape == (0, 8)
    # a ball of 20 mm pressed 2 mm into a half-space of 100 kPa: 4/3 1e5 sqrt(0.01) 0.002^1.5
    ball = Indenter("sphere", radius=2.0)
    assert ball.force_n(0.4, unit_mm=5, reduced_modulus_kpa=100) == pytest.approx(4 / 3 * 1e5 * 0.1 * 0.002**1.5)
    assert pytest.approx(73.33, abs=0.01) == REDUCED_MODULUS_KPA


@pytest.mark.parametrize(
    ("indenter", "depths", "message"),
    [
        ({"shape": "cube"}, 0, "shape is 'cube', allowed is sphere, cone, flat"),
        ({}, [0.1, 0.8], "depth is 0.8, allowed is 0 to the sphere's radius, 0.7"),
        ({}, [0.1], r"depths have shape \(1,\), expected \(2,\)"),
    ],
)
def test_indenters_refuse_impossible_shapes_and_depths(indenter, depths, message):
    with pytest.raises(InputError, match=message):
        indented_signals(Morphology.straight(2), [[1, 1], [2, 2]], depths, Indenter(**indenter))


@pytest.mark.parametrize("share", [1e-1, 1e-3, 1e-5])
@pytest.mark.parametrize("shape", ["cone", "flat"])
def test_indented_signals_resolve_tips_and_edges(shape, share):
    """Its slope turns round within a length that quadrature could step over."""
    depth, pad = 0.3, Morphology.straight(2)
    indenter = Indenter(shape, radius=0.45, angle_deg=50)
    a = float(indenter.contact_radius(depth))
    away = a * share if shape == "cone" else a * (1 + share)
    found = indented_signals(pad, [[1.3, 1 + away], [1.8, 1 - away]], depth, indenter)[:, 0]
    expected = [oracle(pad, press, depth, indenter, 0) for press in ((1.3, 1 + away), (1.8, 1 - away))]
    np.testing.assert_allclose(found, expected, rtol=3e-5)
