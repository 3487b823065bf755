"""Signals of a measured reach as a search takes them: beside the exact ones, and elements no more than are felt."""

from typing import Literal

import numpy as np
import pytest
import torch

from design import Contact, Morphology, signals
from design.criteria.differentiable import pchip_slopes, press_signals
from design.pad.contact import fibre_axes
from design.pad.kernels.measured_signals import PRECISION, fibre_elements, spacing_of
from design.pad.kernels.press import MANHATTAN
from design.pad.knots import kernel_ends
from design.settings import DEFAULT_PITCH_MM, Layout

REACHES = {
    "broad": ((0.0, 1.0), (0.3, 0.9), (0.6, 0.5), (0.9, 0.15), (1.2, -0.04), (1.6, 0.0)),
    "nearly a disc": ((0.0, 1.0), (0.3, 1.0), (0.55, 1.0), (0.6, 0.85), (0.65, 0.15), (0.7, 0.0), (0.9, 0.0)),
    "below 0": ((0.0, -0.3), (0.2, -0.5), (0.35, -0.35), (0.5, 0.1), (0.6, 0.2), (0.9, 0.0)),
    "beyond the pad": ((0.0, 1.0), (2.0, 0.8), (4.0, 0.3), (6.0, 0.0)),
}
"""In grid units."""


def contact_of(reach, length: Literal["manhattan", "euclidean"] = "euclidean"):
    """The contact on pads of the default pitch."""
    return Contact(reach=tuple((DEFAULT_PITCH_MM * d, w) for d, w in reach), length=length)


def pads():
    yield Morphology.straight(3)
    for knots in (1, 5, 21):
        yield Morphology.random(3, knots, seed=knots)
    yield Morphology.random(3, 5, seed=6, pitch_mm=(30.0, 5.0))
    yield Morphology.random(3, 5, seed=7, pitch_mm=6.0)


def knots_of(pad):
    return [torch.tensor(axis[0], requires_grad=True) for axis in fibre_axes(pad)[:2]]


def searched(pad, presses, contact):
    """(Q, 2M) signals of the kind that a search takes."""
    travel, cross = knots_of(pad)
    return (
        press_signals(
            travel, cross, pchip_slopes(travel, cross), presses, contact, kernel_ends(pad.layout), pad.unit_mm
        )
        .detach()
        .numpy()
        .T
    )


@pytest.mark.parametrize("length", ["manhattan", "euclidean"])
@pytest.mark.parametrize("reach", REACHES.values(), ids=REACHES)
def test_a_search_sees_the_signals_to_its_precision(reach, length):
    contact = contact_of(reach, length)
    for pad in pads():
        presses = np.random.default_rng(0).uniform(0, 4, (60, 2))
        exact = signals(pad, presses, contact)
        assert abs(searched(pad, presses, contact) - exact).max() < PRECISION * abs(exact).max()


def test_signals_of_the_opposite_reach_are_the_opposite():
    pad, presses = Morphology.random(3, 5, seed=0), np.random.default_rng(0).uniform(0, 4, (20, 2))
    there, back = (contact_of((d, sign * w) for d, w in REACHES["broad"]) for sign in (1, -1))
    np.testing.assert_allclose(searched(pad, presses, back), -searched(pad, presses, there), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("reach", REACHES.values(), ids=REACHES)
def test_the_gradient_is_that_of_the_exact_signals(reach):
    """Along a random change of all knots, within what a difference of exact signals can tell."""
    rng = np.random.default_rng(1)
    contact, presses = contact_of(reach), rng.uniform(0, 4, (40, 2))
    upstream = rng.normal(size=6)
    pad = Morphology.random(3, 5, seed=2)
    travel, cross = knots_of(pad)
    slope = pchip_slopes(travel, cross)
    found = press_signals(travel, cross, slope, presses, contact, kernel_ends(pad.layout), pad.unit_mm)
    (torch.tensor(upstream)[:, None] * found).sum().backward()
    assert cross.grad is not None
    move = rng.normal(size=cross.shape)
    move[:, [0, -1]] = 0
    along = np.stack([np.zeros_like(move), move], axis=-1)
    along[3:] = along[3:, :, ::-1]
    ahead, behind = (signals(pad.knots + step * along, presses, contact) @ upstream for step in (1e-5, -1e-5))
    expected = ((ahead - behind) / 2e-5).sum()
    assert (cross.grad.numpy() * move).sum() == pytest.approx(expected, rel=2e-3)


def test_elements_lie_only_where_a_press_may_feel_them():
    """Of a large pad pressed near one corner: on the spans about there, whose knots alone have a gradient."""
    grid, reach, corner = 40, REACHES["broad"], np.array([[1.0, 1.0], [2.0, 1.5]])
    travel = torch.linspace(0, grid + 1, 42, dtype=torch.float64).repeat(2 * grid, 1)
    cross = torch.arange(1.0, grid + 1, dtype=torch.float64).repeat(2)[:, None].repeat(1, 42).requires_grad_()
    slope = torch.zeros_like(cross)
    t, v, d = (x.detach().numpy() for x in (travel, cross, slope))
    starts = fibre_elements(t, v, d, grid, corner, 1.6, spacing_of(reach), MANHATTAN).starts
    felt = np.diff(starts) > 0
    assert felt.any(axis=1).nonzero()[0].tolist() == [0, 1, 2, 40, 41, 42]
    assert felt.any(axis=0).nonzero()[0].tolist() == [0, 1, 2, 3]
    layout = Layout.of(grid)
    press_signals(travel, cross, slope, corner, contact_of(reach), kernel_ends(layout), layout.unit_mm).sum().backward()
    assert cross.grad is not None
    moved = cross.grad.numpy().astype(bool)
    assert moved[0, :4].all()
    assert not moved[:, 5:].any()
    assert not moved[3:40].any()


def test_elements_are_as_close_as_a_reach_is_steep_whatever_its_size():
    broad, steep = REACHES["broad"], REACHES["nearly a disc"]
    assert spacing_of(steep) / steep[-1][0] < spacing_of(broad) / broad[-1][0]
    larger = tuple((3 * d, 5 * w) for d, w in broad)
    assert spacing_of(larger) == pytest.approx(3 * spacing_of(broad))
