"""The layer contact against closed forms of contact mechanics and finite elements."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from padforge.design.contact import FIBRE_BLUR_MM, contact_press, describe_large_strain
from padforge.design.layer import MAX_CONTACT, solve_press
from padforge.design.settings import Contact
from tests.helpers.axisymmetric import press
from tests.helpers.golden import Golden


def tool_depth(tool, radius, depth, r):
    """Depth of the tool's surface below the undeformed face, far above it beside the end of a rod."""
    if tool == "flat":
        return np.where(r <= radius * (1 + 1e-9), depth, -1e3)
    if tool == "ball":
        return depth - radius + np.sqrt(np.maximum(radius**2 - r**2, 0))
    return depth - r**2 / (2 * radius)


@pytest.mark.parametrize(("radius", "depth"), [(8.4, 0.5), (4.2, 2.0)])
def test_dome_on_thick_layer_is_hertz(radius, depth):
    solved = solve_press("dome", radius, depth, 100 * radius)
    a = math.sqrt(radius * depth)
    assert solved.contact_radius_mm == pytest.approx(a, rel=0.02)
    assert solved.force_n(73) == pytest.approx(73e-3 * 4 / 3 * math.sqrt(radius) * depth**1.5, rel=0.02)
    r = a * np.array([1.2, 2.0, 4.0])
    outside = ((2 * a**2 - r**2) * np.arcsin(a / r) + a * np.sqrt(r**2 - a**2)) / (math.pi * radius)
    np.testing.assert_allclose(solved.deflection(r), outside, atol=0.02 * depth)


@pytest.mark.parametrize("share", [0.3, 0.95])  # contact radius over that of the ball
def test_ball_on_thick_layer_is_sneddon(share):
    radius, a = 5.0, 5.0 * share
    solved = solve_press("ball", radius, a * math.atanh(share), 200 * radius)
    assert solved.contact_radius_mm == pytest.approx(a, rel=0.02)
    force = 73e-3 * ((a**2 + radius**2) * math.atanh(share) - a * radius)
    assert solved.force_n(73) == pytest.approx(force, rel=0.02)


def test_flat_on_thick_layer_is_sneddon():
    radius, depth = 3.0, 0.7
    solved = solve_press("flat", radius, depth, 100 * radius)
    assert solved.contact_radius_mm == radius
    assert solved.force_n(73) == pytest.approx(73e-3 * 2 * radius * depth, rel=0.02)
    r = radius * np.array([1.1, 2.0, 5.0])
    np.testing.assert_allclose(solved.deflection(r), 2 * depth / np.pi * np.arcsin(radius / r), atol=0.02 * depth)


@pytest.mark.parametrize("below", [0.25, 1.05])
def test_strains_near_the_face_of_a_thick_layer_are_those_of_a_half_space(below):
    solved = solve_press("dome", 0.84, 0.5, 1000.0)
    a, depth = math.sqrt(0.84 * 0.5), 0.5
    # int k^2 exp(-k z) cos(k s) dk in closed form
    strain = quad(
        lambda s: (depth - s**2 / 0.84) * 4 * below**2 * (below**2 - 3 * s**2) / (below**2 + s**2) ** 3 / np.pi, 0, a
    )[0]
    assert solved.strains([0.0], 1000.0 - below).compressive[0] == pytest.approx(strain, rel=0.05)


def test_thin_bonded_layer_is_a_lubrication_film():
    a, thickness = 90.0, 1.0
    dome = solve_press("dome", 1000.0, a**2 / 4000, thickness)
    flat = solve_press("flat", a, 0.01, thickness)
    # incompressible silicone flows out of the gap by t^3 / 3 G of the pressure's slope; edges weigh as t / a
    assert dome.contact_radius_mm == pytest.approx(a, rel=0.03)
    wide = dome.contact_radius_mm
    assert dome.force_n(4) == pytest.approx(1e-3 * math.pi * wide**6 / (32 * thickness**3 * 1000), rel=0.11)
    assert flat.force_n(4) == pytest.approx(1e-3 * 3 * math.pi * 0.01 * a**4 / (8 * thickness**3), rel=0.11)


def test_thin_slipping_layer_has_half_of_chi():
    solved = solve_press("dome", 1000.0, 1.0, 0.5, "slipping")
    assert 1000.0 / solved.contact_radius_mm**2 == pytest.approx(1 / 2, rel=0.01)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
@pytest.mark.parametrize("tool", ["dome", "ball", "flat"])
def test_face_follows_the_tool_inside_and_stays_clear_of_it_outside(tool, base):
    solved = solve_press(tool, 8.4, 3.0, 6.0, base)
    a = solved.contact_radius_mm
    inside, outside = np.linspace(0, 0.999 * a, 40), np.linspace(1.001 * a, 3 * a, 40)
    np.testing.assert_allclose(solved.deflection(inside), tool_depth(tool, 8.4, 3.0, inside), atol=1e-3)
    assert (solved.deflection(outside) > tool_depth(tool, 8.4, 3.0, outside)).all()


def test_strains_above_1_are_said_with_their_size(golden: Golden) -> None:
    """The largest lies in the silicone below the fibres, for a flat end at the edge of the contact."""
    assert describe_large_strain(Contact()) == describe_large_strain(Contact(model="profile")) == ""
    bonded, flat = Contact(base="bonded"), Contact(tool="flat")
    for contact, height_mm in ((bonded, 3.75), (flat, 5.75)):
        golden(f"design/large_strain_{contact.tool}.txt", describe_large_strain(contact))
        strains = contact_press(contact).strains(np.linspace(0, 20, 500), height_mm, FIBRE_BLUR_MM)
        told = float(describe_large_strain(contact).partition("up to ")[2].partition(",")[0])
        assert told == pytest.approx(strains.compressive.max(), abs=0.07)


@pytest.mark.parametrize(
    ("tool", "thickness", "depth", "base"),
    [("dome", 6, 5, "bonded"), ("ball", 8, 4, "slipping"), ("flat", 6, 2, "bonded")],
)
def test_layer_is_that_of_finite_elements(tool, thickness, depth, base):
    """An edge of pressure without bound, of a flat end, is what elements see least."""
    solved = solve_press(tool, 8.4, depth, thickness, base)
    a, count = solved.contact_radius_mm, 12  # elements over the contact
    edges = list(np.linspace(0, 1.5 * a, 3 * count // 2 + 1))
    while edges[-1] < a + (6 if base == "bonded" else 60) * thickness:
        edges.append(edges[-1] + 1.3 * (edges[-1] - edges[-2]))
    heights = np.linspace(0, thickness, max(4, count * thickness // 8) + 1)
    found = press(lambda r: tool_depth(tool, 8.4, depth, r), np.array(edges), heights, bonded=base == "bonded")
    assert solved.force_n(4e3) == pytest.approx(found.force, rel=0.015 if tool == "flat" else 0.004)
    assert found.contact_radius == pytest.approx(a, rel=1e-9)
    row = 3 * len(found.z) // 4
    beside = np.abs(found.r - a) > 0.25 * a
    strains = solved.strains(found.r, found.z[row])
    greatest = np.abs(strains.compressive).max()
    squeezed = np.gradient(found.down, found.z, axis=1)[:, row]
    np.testing.assert_allclose(squeezed[beside], strains.compressive[beside], atol=0.03 * greatest)
    hoop = found.outward[1:, row] / found.r[1:]
    np.testing.assert_allclose(hoop[beside[1:]], strains.hoop[1:][beside[1:]], atol=0.03 * greatest)
    np.testing.assert_allclose(strains.compressive, strains.radial + strains.hoop, atol=1e-12)


def test_finger_on_thick_layer_is_a_dome_with_half_the_force():
    dome, finger = (solve_press(tool, 8.4, 1.0, 1000.0) for tool in ("dome", "finger"))
    assert finger.contact_radius_mm == pytest.approx(dome.contact_radius_mm, rel=0.005)
    assert finger.force_n() == pytest.approx(dome.force_n() / 2, rel=0.01)


@pytest.mark.parametrize(
    ("tool", "radius", "depth", "thickness"),
    [
        ("dome", 0.1, 99, 1000),
        ("ball", 1, 5, 6),  # deeper than its radius
        ("finger", 1000, 0.05, 0.1),
    ],
)
def test_extreme_presses_are_solved(tool, radius, depth, thickness):
    solved = solve_press(tool, radius, depth, thickness, "slipping")
    r = solved.contact_radius_mm * np.array([0, 0.3, 0.9, 1.1])
    assert solved.force_n() > 0
    assert np.isfinite(solved.strains(r, 0.5 * thickness)).all()
    face = solved.deflection(r)
    assert np.isfinite(face).all()
    if tool != "finger":
        np.testing.assert_allclose(face[:3], tool_depth(tool, radius, depth, r[:3]), atol=0.05 * depth)


def test_widest_contact_of_a_layer_is_solved():
    assert solve_press("flat", MAX_CONTACT, 0.1, 1.0).contact_radius_mm == MAX_CONTACT
