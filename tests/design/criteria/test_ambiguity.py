"""Localisation ambiguity against what must come out by its formula."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from design import Morphology
from design.criteria.ambiguity import ambiguity, full_scale, sharpness
from design.criteria.fibre_loss import draw_losses, loss_shares, lost_subsets
from design.criteria.score import ambiguities
from design.pad.contact import relative_stretch
from design.settings import PUBLISHED_CONTACT, PadSettings

PAIR = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
ALL = torch.ones(1, 3), torch.ones(1)


def test_presses_that_cannot_be_told_apart_are_off_by_their_mean_distance():
    assert ambiguity(torch.zeros(3, 2), PAIR, *ALL, noise=0.1).item() == pytest.approx(0.5)


def test_presses_far_apart_in_signal_are_not_confused():
    assert ambiguity(torch.tensor([[0.0, 9.0]] * 3), PAIR, *ALL, noise=0.1).item() == pytest.approx(0, abs=1e-6)


def test_two_presses_follow_the_closed_form():
    """Of two presses a distance s apart in signal the posterior of the other is 1 / (1 + exp(s^2 / 4 sigma^2))."""
    apart, noise = 0.3, 0.2
    found = ambiguity(torch.tensor([[0.0, apart]]), PAIR, torch.ones(1, 1), torch.ones(1), noise)
    assert found.item() == pytest.approx(1 / (1 + np.exp(apart**2 / (4 * noise**2))), rel=1e-6)


def test_a_lost_fibre_tells_nothing():
    signals = torch.tensor([[0.0, 9.0], [0.0, 0.0]])
    kept = torch.tensor([[0.0, 1.0], [1.0, 1.0]])
    assert ambiguity(signals, PAIR, kept, torch.tensor([1.0, 0.0]), noise=0.1).item() == pytest.approx(0.5)
    assert ambiguity(signals, PAIR, kept, torch.tensor([0.5, 0.5]), noise=0.1).item() == pytest.approx(0.25)


def test_it_is_zero_where_the_conditional_entropy_is_and_largest_where_that_is():
    """n presses that cannot be told apart: H is log2 n bits and A their mean distance; all told apart: both 0."""
    rng = np.random.default_rng(0)
    places = torch.tensor(rng.uniform(1, 4, (16, 2)))
    masks = torch.ones(1, 4, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    blind = ambiguity(torch.zeros(4, 16, dtype=torch.float64), places, *masks, noise=0.2)
    assert blind.item() == pytest.approx(torch.cdist(places, places).mean().item())
    told = ambiguity(torch.tensor(100 * rng.standard_normal((4, 16))), places, *masks, noise=0.2)
    assert told.item() < 1e-9


def test_its_gradient_is_that_of_finite_differences():
    rng = np.random.default_rng(1)
    signals = torch.tensor(rng.uniform(0, 1, (4, 9)), requires_grad=True)
    places = torch.tensor(rng.uniform(1, 4, (9, 2)))
    kept, weight = torch.tensor([[1.0, 1, 1, 1], [1, 0, 1, 1]]).double(), torch.tensor([0.3, 0.7]).double()
    assert torch.autograd.gradcheck(lambda s: ambiguity(s, places, kept, weight, 0.3), signals)
    assert torch.autograd.gradcheck(sharpness, signals)


@given(st.integers(0, 4) | st.lists(st.sampled_from([0.0, 1.0, 3.0]), min_size=1, max_size=5).filter(sum).map(tuple))
def test_drawn_losses_have_the_shares_that_are_asked_for(lost):
    shares = loss_shares(lost)
    assert sum(shares) == pytest.approx(1)
    kept, weights = draw_losses(8, shares, np.random.default_rng(0))
    numbers = 8 - kept.sum(axis=1)
    assert [weights[numbers == k].sum() for k in range(len(shares))] == pytest.approx(list(shares))


def test_a_pad_is_never_left_without_a_fibre():
    kept, weights = draw_losses(2, loss_shares(5), np.random.default_rng(0))
    assert kept.sum(axis=1).min() == 1
    assert weights.sum() == pytest.approx(1)


def test_losses_are_all_of_a_size_or_as_many_different_ones_as_wanted():
    assert lost_subsets(4, 2) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert lost_subsets(4, 2, most=6) == lost_subsets(4, 2)
    assert lost_subsets(3, 0) == [()]
    some = lost_subsets(8, 3, most=20)
    assert some == sorted(set(some)) == lost_subsets(8, 3, most=20)
    assert len(some) == 20
    assert all(0 <= a < b < c < 8 for a, b, c in some)
    assert {a for loss in some for a in loss} == set(range(8))


def test_shares_of_losses_are_half_for_none_and_equal_or_as_weighted():
    assert loss_shares(3) == (3 / 6, 1 / 6, 1 / 6, 1 / 6)
    assert loss_shares(1) == (0.5, 0.5)
    assert loss_shares(0) == (1.0,)
    assert loss_shares((1.0, 0.0, 3.0)) == (0.25, 0.0, 0.75)


def test_the_full_scale_is_the_mean_largest_signal_of_what_is_touched():
    signals = torch.tensor([[0.0, 2.0, 1.0], [0.0, 0.0, 0.0], [6.0, 3.0, 0.0]])
    assert full_scale(signals) == pytest.approx(4.0)
    assert full_scale(torch.zeros(2, 3)) == 1.0


def test_sharpness_is_the_mean_second_difference():
    assert sharpness(torch.tensor([[0.0, 1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0]])).item() == pytest.approx((1 + 2) / 4)


def test_the_score_holds_the_ambiguity_of_every_number_of_losses():
    """On the module's own grid of presses, each mask of losses counted alike."""
    pad, contact, noise = Morphology.random(2, 3, seed=0), PUBLISHED_CONTACT, 0.07
    size = PadSettings(grid=2)
    line = np.linspace(0.5, 2.5, 20)
    presses = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    found = torch.tensor(relative_stretch(pad, presses, contact).T)
    sigma = noise * found.amax(dim=1).mean().item()
    expected = []
    for masks in (np.ones((1, 4)), 1 - np.eye(4)):
        weight = torch.full((len(masks),), 1 / len(masks), dtype=torch.float64)
        expected.append(ambiguity(found, torch.tensor(presses), torch.tensor(masks), weight, sigma).item())
    assert ambiguities(pad, contact, 1, noise, size) == pytest.approx(expected, rel=1e-3)
    assert len(ambiguities(pad, contact, 9, noise, size)) == 4
