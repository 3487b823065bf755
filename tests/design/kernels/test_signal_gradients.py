"""The gradient of the signals against differences, for every weight, length, shape, profile and layer."""

import numpy as np
import pytest
from hypothesis import assume, given, settings

from padforge.design import Contact, Morphology
from padforge.design.contact import fibre_axes
from padforge.design.settings import PUBLISHED_CONTACT
from tests.design.kernels.test_element_signals import CONTACTS as ELEMENT_CONTACTS
from tests.design.kernels.test_element_signals import curves
from tests.design.wild_pads import SEEDS, wild_contacts, wild_pads

SHAPES = [
    PUBLISHED_CONTACT,
    Contact(sides=None),
    Contact(sides=3, length="euclidean"),
    Contact(weight="inverse_square"),
    Contact(sides=None, weight="inverse_square", length="euclidean"),
    Contact(sides=None, weight="inverse", length="euclidean"),
]


def gradient_of(fibres, presses, contact, upstream):
    """By the knots, of the sum of signals times `upstream` (F, Q)."""
    return fibres.by_knots(fibres.signals(presses, contact)[1](upstream))


@pytest.mark.parametrize("counts", [(2, 3), (0, 2)])
@pytest.mark.parametrize(
    "contact", [*SHAPES, *ELEMENT_CONTACTS.values()], ids=lambda c: f"{c.model}-{c.sides}-{c.weight}-{c.length}"
)
def test_signal_gradients_equal_differences(contact, counts):
    """Steps so short that no span passes from near elements to far ones, and none is cut into other pieces."""
    pad, rng = Morphology.random(counts, 3, seed=3, pitch_mm=(8.0, 12.0)), np.random.default_rng(3)
    presses = rng.uniform(0, pad.layout.extent, (12, 2))
    upstream, move = rng.normal(size=(sum(counts), 12)), rng.normal(size=(2, *fibre_axes(pad)[0][0].shape))
    move[:, :, [0, -1]] = 0

    def value(step):
        return (upstream * curves(pad, step * move).signals(presses, contact)[0]).sum()

    expected = (gradient_of(curves(pad), presses, contact, upstream) * move).sum()
    assert (value(1e-6) - value(-1e-6)) / 2e-6 == pytest.approx(expected, rel=1e-4, abs=1e-4)


@given(wild_pads((1, 2), (1, 5)), wild_contacts, SEEDS)
@settings(max_examples=20)
def test_signal_gradients_on_wild_pads_are_finite(pad, contact, seed):
    assume(np.diff(fibre_axes(pad)[0]).min() > 1e-6)
    presses = np.random.default_rng(seed).uniform(0, pad.grid + 1, (3, 2))
    assert np.isfinite(gradient_of(curves(pad), presses, contact, np.ones((len(pad.knots), 3)))).all()


def test_gradient_at_grazing_fibres_is_limited():
    """The length cut off at height y is 2 sqrt(r^2 - y^2): it changes by -2 y / sqrt(r^2 - y^2), at most 2 / 0.02."""
    radius, contact = 0.5, Contact(radius=0.5, sides=None)
    knots = Morphology.straight(2).knots
    straight = Morphology(np.insert(knots, 1, knots.mean(axis=1), axis=1))  # a search has a knot at least
    for height, expected in (
        (0.3, -2 * 0.3 / 0.4),
        (radius * np.sqrt(1 - 0.021**2), -2 * np.sqrt(1 - 0.021**2) / 0.021),
        (radius * (1 - 1e-9), -2 / 0.02),
    ):
        by_across = gradient_of(curves(straight), np.array([[1.5, 1 - height]]), contact, np.eye(4)[:, :1])[1]
        assert by_across[0].sum() == pytest.approx(expected, rel=1e-4)
