"""The gradient of the signals: Taylor tests for every weight, length, shape and profile."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings

from padforge.design import Contact, Morphology, signals
from padforge.design.contact import fibre_axes
from padforge.design.morphology import fibre_ends
from padforge.design.settings import DEFAULT_PITCH_MM, PUBLISHED_CONTACT, Layout
from padforge.design.torch_signals import pchip_slopes, press_signals
from tests.design.wild_pads import SEEDS, wild_contacts, wild_pads

PROFILE = ((0.0, 1.0), (3.4, 0.9), (6.8, 0.5), (10.1, 0.15), (13.5, -0.04), (18.0, 0.0))
CONTACTS = [
    PUBLISHED_CONTACT,
    Contact(sides=None),
    Contact(sides=3),
    Contact(sides=4, length="euclidean"),
    Contact(weight="inverse_square"),
    Contact(sides=None, weight="inverse_square", length="euclidean"),
    Contact(weight="inverse"),
    Contact(sides=None, weight="inverse", length="euclidean"),
    Contact(sensitivity_profile=PROFILE),
    Contact(sensitivity_profile=PROFILE, length="euclidean"),
    Contact(sensitivity_profile=((0.0, -0.3), (2.3, -0.5), (4.0, -0.35), (5.6, 0.1), (6.8, 0.2), (10.1, 0.0))),
]


def straight_axes(grid):
    """Travel and cross (2M, 3) of straight fibres with a knot in the middle: a search has at least one."""
    ends = np.array(fibre_axes(Morphology.straight(grid))[:2])[:, 0]
    return [torch.tensor(np.insert(axis, 1, axis.mean(axis=1), axis=1), requires_grad=True) for axis in ends]


def torch_signals(travel, cross, presses, contact):
    slope = pchip_slopes(travel, cross)
    return press_signals(
        travel, cross, slope, presses, contact, fibre_ends(Layout.create(len(travel) // 2)), DEFAULT_PITCH_MM
    )


def taylor_ratio(contact, seed):
    """How much more a step twice as long leaves over after the gradient's own part: 4 for a right gradient."""
    rng = np.random.default_rng(seed)
    axes = fibre_axes(Morphology.random(3, 4, seed))
    knots = torch.tensor(np.stack([axes[0][0], axes[1][0]]), requires_grad=True)
    presses, weights = rng.uniform(1, 3, (8, 2)), torch.tensor(rng.normal(size=(6, 8)))
    move = torch.tensor(rng.normal(size=knots.shape))
    move[:, :, [0, -1]] = 0

    def value(knots):
        travel, cross = knots
        return (weights * torch_signals(travel, cross, presses, contact)).sum()

    base = value(knots)
    (gradient,) = torch.autograd.grad(base, knots)
    left = [abs(value(knots + step * move) - base - step * (move * gradient).sum()).item() for step in (2e-6, 1e-6)]
    return left[0] / left[1]


@pytest.mark.parametrize(
    "contact", CONTACTS, ids=lambda c: f"{len(c.sensitivity_profile) or c.sides}-{c.weight}-{c.length}"
)
def test_signal_gradient_passes_the_taylor_test(contact):
    assert np.median([taylor_ratio(contact, seed) for seed in range(5)]) == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize(
    "contact", [CONTACTS[0], CONTACTS[5], CONTACTS[9]], ids=["polygon", "inverse square", "profile"]
)
@pytest.mark.parametrize("counts", [(2, 3), (3, 1), (0, 2)])
def test_torch_signals_match_exact_ones_on_rectangles(contact, counts):
    pad, rng = Morphology.random(Layout.create(counts, (5.0, 20.0)), 3, seed=1), np.random.default_rng(1)
    presses = rng.uniform(0, pad.layout.extent, (20, 2))
    travel, cross, ends, _ = fibre_axes(pad)

    def found(across):
        along = torch.tensor(travel[0])
        return press_signals(along, across, pchip_slopes(along, across), presses, contact, ends, pad.unit_mm)

    across = torch.tensor(cross[0], requires_grad=True)
    exact = signals(pad, presses, contact)
    np.testing.assert_allclose(found(across).detach().T, exact, rtol=1e-3, atol=2e-3 * abs(exact).max())
    upstream, move = torch.tensor(rng.normal(size=exact.T.shape)), torch.tensor(rng.normal(size=across.shape))
    move[:, [0, -1]] = 0
    (upstream * found(across)).sum().backward()
    assert across.grad is not None
    with torch.no_grad():
        ahead, behind = ((upstream * found(across + step * move)).sum().item() for step in (1e-6, -1e-6))
    assert (across.grad * move).sum().item() == pytest.approx((ahead - behind) / 2e-6, rel=2e-3, abs=2e-3)


@given(wild_pads((1, 2), (1, 5)), wild_contacts, SEEDS)
@settings(max_examples=20)
def test_signal_gradients_on_wild_pads_are_finite(pad, contact, seed):
    travel, cross, ends, _ = fibre_axes(pad)
    assume(np.diff(travel).min() > 1e-6)
    along, across = torch.tensor(travel[0]), torch.tensor(cross[0], requires_grad=True)
    presses = np.random.default_rng(seed).uniform(0, pad.grid + 1, (3, 2))
    press_signals(along, across, pchip_slopes(along, across), presses, contact, ends, pad.unit_mm).sum().backward()
    assert across.grad is not None
    assert torch.isfinite(across.grad).all()


def test_gradient_at_grazing_fibres_is_limited():
    """The length cut off at height y is 2 sqrt(r^2 - y^2): it changes by -2 y / sqrt(r^2 - y^2), at most 2 / 0.02."""
    radius, contact = 0.5, Contact(radius=0.5, sides=None)
    for height, expected in (
        (0.3, -2 * 0.3 / 0.4),
        (radius * np.sqrt(1 - 0.021**2), -2 * np.sqrt(1 - 0.021**2) / 0.021),
        (radius * (1 - 1e-9), -2 / 0.02),
    ):
        travel, cross = straight_axes(2)
        torch_signals(travel, cross, np.array([[1.5, 1 - height]]), contact)[0, 0].backward()
        assert cross.grad is not None
        assert cross.grad[0].sum().item() == pytest.approx(expected, rel=1e-4)
    travel, cross = straight_axes(3)
    grazing = np.array([[2.0, 2.0 - 0.6], [2.0, 2.0 - 0.6 + 1e-12]])
    torch_signals(travel, cross, grazing, Contact(sides=None)).sum().backward()
    assert cross.grad is not None
    assert torch.isfinite(cross.grad).all()
    assert not cross.grad[[2, 3, 5]].any()
