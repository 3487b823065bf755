"""The gradient of the signals: Taylor tests for every weight, length, shape and profile."""

import numpy as np
import pytest
from hypothesis import assume, given, settings

from padforge.design import Contact, Morphology, signals
from padforge.design.contact import fibre_axes
from padforge.design.morphology import fibre_ends
from padforge.design.settings import DEFAULT_PITCH_MM, PUBLISHED_CONTACT, Layout
from padforge.design.signal_gradients import FibreCurves
from tests.design.wild_pads import SEEDS, wild_contacts, wild_pads

PROFILE = ((0.0, 1.0), (3.4, 0.9), (6.8, 0.5), (10.1, 0.15), (13.5, -0.04), (18.0, 0.0))
CONTACTS = [
    PUBLISHED_CONTACT,
    Contact(sides=None),
    Contact(sides=3, length="euclidean"),
    Contact(weight="inverse_square"),
    Contact(sides=None, weight="inverse_square", length="euclidean"),
    Contact(sides=None, weight="inverse", length="euclidean"),
    Contact(sensitivity_profile=PROFILE, length="euclidean"),
]


def straight_curves(grid):
    """Straight fibres with a knot in the middle: a search has at least one."""
    ends = np.array(fibre_axes(Morphology.straight(grid))[:2])[:, 0]
    return curves(*(np.insert(axis, 1, axis.mean(axis=1), axis=1) for axis in ends))


def curves(along, across):
    return FibreCurves(along, across, fibre_ends(Layout.create(len(along) // 2)), DEFAULT_PITCH_MM)


def gradient_of(fibres, presses, contact, upstream):
    """By the knots, of the sum of signals times `upstream` (F, Q)."""
    return fibres.by_knots(fibres.signals(presses, contact)[1](upstream))


def taylor_ratio(contact, seed):
    """How much more a step twice as long leaves over after the gradient's own part: 4 for a right gradient."""
    rng = np.random.default_rng(seed)
    axes = fibre_axes(Morphology.random(3, 4, seed))
    knots = np.stack([axes[0][0], axes[1][0]])
    presses, weights = rng.uniform(1, 3, (8, 2)), rng.normal(size=(6, 8))
    move = rng.normal(size=knots.shape)
    move[:, :, [0, -1]] = 0

    def value(knots):
        return (weights * curves(*knots).signals(presses, contact)[0]).sum()

    base, slope = value(knots), (move * gradient_of(curves(*knots), presses, contact, weights)).sum()
    left = [abs(value(knots + step * move) - base - step * slope) for step in (2e-6, 1e-6)]
    return left[0] / left[1]


@pytest.mark.parametrize(
    "contact", CONTACTS, ids=lambda c: f"{len(c.sensitivity_profile) or c.sides}-{c.weight}-{c.length}"
)
def test_signal_gradient_passes_the_taylor_test(contact):
    assert np.median([taylor_ratio(contact, seed) for seed in range(5)]) == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize("contact", [CONTACTS[0], CONTACTS[-1]], ids=["polygon", "profile"])
@pytest.mark.parametrize("counts", [(2, 3), (0, 2)])
def test_signals_and_gradients_match_exact_ones_on_rectangles(contact, counts):
    pad, rng = Morphology.random(Layout.create(counts, (5.0, 20.0)), 3, seed=1), np.random.default_rng(1)
    presses = rng.uniform(0, pad.layout.extent, (20, 2))
    travel, cross, ends, _ = fibre_axes(pad)

    def moved(across):
        return FibreCurves(travel[0], across, ends, pad.unit_mm)

    across, exact = cross[0], signals(pad, presses, contact)
    found = moved(across).signals(presses, contact)[0]
    np.testing.assert_allclose(found.T, exact, rtol=1e-3, atol=2e-3 * abs(exact).max())
    upstream, move = rng.normal(size=exact.T.shape), rng.normal(size=across.shape)
    move[:, [0, -1]] = 0
    by_across = gradient_of(moved(across), presses, contact, upstream)[1]
    ahead, behind = (
        (upstream * moved(across + step * move).signals(presses, contact)[0]).sum() for step in (1e-6, -1e-6)
    )
    assert (by_across * move).sum() == pytest.approx((ahead - behind) / 2e-6, rel=2e-3, abs=2e-3)


@given(wild_pads((1, 2), (1, 5)), wild_contacts, SEEDS)
@settings(max_examples=20)
def test_signal_gradients_on_wild_pads_are_finite(pad, contact, seed):
    travel, cross, ends, _ = fibre_axes(pad)
    assume(np.diff(travel).min() > 1e-6)
    presses = np.random.default_rng(seed).uniform(0, pad.grid + 1, (3, 2))
    fibres = FibreCurves(travel[0], cross[0], ends, pad.unit_mm)
    assert np.isfinite(gradient_of(fibres, presses, contact, np.ones((len(pad.knots), 3)))).all()


def test_gradient_at_grazing_fibres_is_limited():
    """The length cut off at height y is 2 sqrt(r^2 - y^2): it changes by -2 y / sqrt(r^2 - y^2), at most 2 / 0.02."""
    radius, contact = 0.5, Contact(radius=0.5, sides=None)
    first = np.eye(4)[:, :1]
    for height, expected in (
        (0.3, -2 * 0.3 / 0.4),
        (radius * np.sqrt(1 - 0.021**2), -2 * np.sqrt(1 - 0.021**2) / 0.021),
        (radius * (1 - 1e-9), -2 / 0.02),
    ):
        by_across = gradient_of(straight_curves(2), np.array([[1.5, 1 - height]]), contact, first)[1]
        assert by_across[0].sum() == pytest.approx(expected, rel=1e-4)
    grazing = np.array([[2.0, 2.0 - 0.6], [2.0, 2.0 - 0.6 + 1e-12]])
    by_across = gradient_of(straight_curves(3), grazing, Contact(sides=None), np.ones((6, 2)))[1]
    assert np.isfinite(by_across).all()
    assert not by_across[[2, 3, 5]].any()
