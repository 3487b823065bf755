"""The layer contact against closed forms of contact mechanics and finite elements."""

import math
from functools import partial

import numpy as np
import pytest

from padforge.design.contact import FIBRE_BLUR_MM, contact_press, describe_large_strain, profile_weights
from padforge.design.layer import solve_press
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
def test_dome_on_thick_layer_is_hertz_and_a_finger_a_dome_with_half_the_force(radius, depth):
    solved, finger = (solve_press(tool, radius, depth, 100 * radius) for tool in ("dome", "finger"))
    a = math.sqrt(radius * depth)
    assert solved.contact_radius_mm == pytest.approx(a, rel=0.02)
    assert solved.force_n(73) == pytest.approx(73e-3 * 4 / 3 * math.sqrt(radius) * depth**1.5, rel=0.02)
    r = a * np.array([1.2, 2.0, 4.0])
    outside = ((2 * a**2 - r**2) * np.arcsin(a / r) + a * np.sqrt(r**2 - a**2)) / (math.pi * radius)
    np.testing.assert_allclose(solved.deflection(r), outside, atol=0.02 * depth)
    assert finger.contact_radius_mm == pytest.approx(solved.contact_radius_mm, rel=0.005)
    assert finger.force_n() == pytest.approx(solved.force_n() / 2, rel=0.01)


def test_thin_bonded_layer_is_a_lubrication_film():
    a, thickness = 90.0, 1.0
    dome = solve_press("dome", 1000.0, a**2 / 4000, thickness)
    flat = solve_press("flat", a, 0.01, thickness)
    # incompressible silicone flows out of the gap by t^3 / 3 G of the pressure's slope; edges weigh as t / a
    assert dome.contact_radius_mm == pytest.approx(a, rel=0.03)
    wide = dome.contact_radius_mm
    assert dome.force_n(4) == pytest.approx(1e-3 * math.pi * wide**6 / (32 * thickness**3 * 1000), rel=0.11)
    assert flat.force_n(4) == pytest.approx(1e-3 * 3 * math.pi * 0.01 * a**4 / (8 * thickness**3), rel=0.11)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
@pytest.mark.parametrize("tool", ["dome", "ball", "flat"])
def test_face_follows_the_tool_inside_and_stays_clear_of_it_outside(tool, base):
    solved = solve_press(tool, 8.4, 3.0, 6.0, base)
    a = solved.contact_radius_mm
    inside, outside = np.linspace(0, 0.999 * a, 40), np.linspace(1.001 * a, 3 * a, 40)
    np.testing.assert_allclose(solved.deflection(inside), tool_depth(tool, 8.4, 3.0, inside), atol=1e-3)
    assert (solved.deflection(outside) > tool_depth(tool, 8.4, 3.0, outside)).all()


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_strains_are_differences_of_displacements(base):
    solved = solve_press("ball", 8.4, 3.0, 6.0, base)
    r, step = np.linspace(0.5, 15, 20), 1e-4
    left, right = (x * solved.strains(x, 4.5).hoop for x in (r - step, r + step))
    strains = solved.strains(r, 4.5)
    np.testing.assert_allclose((right - left) / (2 * step), strains.radial, atol=1e-6)
    np.testing.assert_allclose(strains.compressive, strains.radial + strains.hoop, atol=1e-12)
    heights, weights = np.polynomial.legendre.leggauss(20)
    squeezed = sum(w * solved.strains(r, 3 + 3 * h).compressive for h, w in zip(heights, weights, strict=True))
    np.testing.assert_allclose(3 * squeezed, solved.deflection(r), atol=0.01 * 3.0)


@pytest.mark.parametrize(
    ("tool", "thickness", "depth", "base"),
    [("dome", 6, 5, "bonded"), ("ball", 8, 4, "slipping"), ("flat", 6, 2, "bonded")],
)
def test_layer_is_that_of_finite_elements(tool, thickness, depth, base):
    solved = solve_press(tool, 8.4, depth, thickness, base)
    a, results = solved.contact_radius_mm, []
    for count in (8, 16):  # elements over the contact
        edges = list(np.linspace(0, 1.5 * a, 3 * count // 2 + 1))
        while edges[-1] < a + (6 if base == "bonded" else 60) * thickness:
            edges.append(edges[-1] + 1.3 * (edges[-1] - edges[-2]))
        heights = np.linspace(0, thickness, max(4, count * thickness // 8) + 1)
        results.append(press(partial(tool_depth, tool, 8.4, depth), np.array(edges), heights, bonded=base == "bonded"))
    coarse, fine = results
    # an edge of pressure without bound, of a flat end, is what elements see least
    assert fine.force == pytest.approx(coarse.force, rel=0.01)
    assert solved.force_n(4e3) == pytest.approx(fine.force, rel=0.01 if tool == "flat" else 0.003)
    assert fine.contact_radius == pytest.approx(a, rel=1e-9)
    row = 3 * len(fine.z) // 4
    beside = np.abs(fine.r - a) > 0.25 * a
    strains = solved.strains(fine.r, fine.z[row])
    greatest = np.abs(strains.compressive).max()
    squeezed = np.gradient(fine.down, fine.z, axis=1)[:, row]
    np.testing.assert_allclose(squeezed[beside], strains.compressive[beside], atol=0.03 * greatest)
    hoop = fine.outward[1:, row] / fine.r[1:]
    np.testing.assert_allclose(hoop[beside[1:]], strains.hoop[1:][beside[1:]], atol=0.03 * greatest)


@pytest.mark.parametrize(
    ("tool", "radius", "depth", "thickness"),
    [
        ("dome", 1000, 0.09, 0.4),
        ("dome", 0.1, 99, 1000),
        ("ball", 1, 5, 6),  # deeper than its radius
        ("flat", 0.1, 5, 1000),
        ("finger", 1000, 0.05, 0.1),
    ],
)
@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_extreme_presses_are_solved(tool, radius, depth, thickness, base):
    solved = solve_press(tool, radius, depth, thickness, base)
    a = solved.contact_radius_mm
    r = a * np.array([0, 0.3, 0.9, 1.1])
    assert 0 < a <= 2.001 * math.sqrt(radius * depth) or tool == "flat"
    assert solved.force_n() > 0
    assert np.isfinite(solved.strains(r, 0.5 * thickness)).all()
    face = solved.deflection(r)
    assert np.isfinite(face).all()
    if tool != "finger":
        shape = tool_depth(tool, radius, depth, r[:3])
        np.testing.assert_allclose(face[:3], shape, atol=0.05 * depth)


@pytest.mark.parametrize("contact", [Contact(), Contact(tool="ball", base="slipping", squeeze=0.7, stretch=1.3)])
def test_weights_of_elements_are_those_of_short_ones_that_are_carried_along(contact):
    """By the silicone, which goes outward: how much longer they get, and how much flatter they are pressed."""
    press = contact_press(contact)
    for depth_mm, (distance, plain, directed) in zip(contact.fibre_depths_mm, profile_weights(contact), strict=True):
        at = np.flatnonzero((distance > 0.5) & (distance < 9))[::20]
        for angle in (0.0, 0.6, math.pi / 2):
            way = 1e-3 * np.array([math.cos(angle), math.sin(angle)])
            ends = np.stack([distance[at], 0 * at], axis=1) + np.array([[-1], [1]])[..., None] * way / 2
            strains = press.strains(np.linalg.norm(ends, axis=-1), contact.thickness_mm - depth_mm, FIBRE_BLUR_MM)
            moved = ends + 1e-3 * ends * strains.hoop[..., None]
            longer = 1e3 * (np.linalg.norm(moved[1] - moved[0], axis=1) / 1e-3 - 1)
            expected = contact.stretch * longer + contact.squeeze * strains.compressive.mean(axis=0)
            found = plain[at] + directed[at] * math.cos(angle) ** 2
            np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(plain).max())


def test_strains_above_1_are_said_with_their_size(golden: Golden) -> None:
    """The largest lies in the silicone below the fibres, for a flat end at the edge of the contact."""
    for contact in (Contact(), Contact(tool="flat", depth_mm=1), Contact(model="profile"), Contact(radius=0.6)):
        assert describe_large_strain(contact) == ""
    for contact in (Contact(base="bonded"), Contact(tool="flat")):
        golden(f"design/large_strain_{contact.tool}.txt", describe_large_strain(contact))


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_pads_of_any_great_thickness_weigh_fibres_alike(base):
    contacts = (Contact(thickness_mm=mm, base=base, tool_radius_mm=2, depth_mm=0.5) for mm in (100, 1000))
    thick, thicker = map(profile_weights, contacts)
    for (distance, plain, directed), (other, *weights) in zip(thick, thicker, strict=True):
        for weight, second in zip((plain, directed), weights, strict=True):
            np.testing.assert_allclose(weight, np.interp(distance, other, second), atol=0.05 * plain.max())
