"""Localisation ambiguity against closed forms, the losses it is a mean over, and its map by position."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Contact, Morphology
from padforge.design.contact import relative_stretch, signals
from padforge.design.objectives.ambiguity import ambiguities, ambiguity, ambiguity_map, free_presses, full_scale
from padforge.design.objectives.fibre_loss import failure_shares, failure_subsets, sample_failures
from padforge.design.objectives.score import sharpness
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings

pytestmark = pytest.mark.usefixtures("one_thread")
PAIR = torch.tensor([[0.0, 0.0], [1.0, 0.0]])


def test_ambiguity_of_two_presses_has_a_closed_form():
    """Of two presses a distance s apart in signal the posterior of the other is 1 / (1 + exp(s^2 / 4 sigma^2))."""
    distance, noise = 0.3, 0.2
    value = ambiguity(torch.tensor([[0.0, distance]]), PAIR, torch.ones(1, 1), torch.ones(1), noise).item()
    assert value == pytest.approx(1 / (1 + np.exp(distance**2 / (4 * noise**2))), rel=1e-6)


def test_ambiguity_ignores_failed_fibres():
    signals = torch.tensor([[0.0, 9.0], [0.0, 0.0]])
    masks = torch.tensor([[0.0, 1.0], [1.0, 1.0]])
    assert ambiguity(signals, PAIR, masks, torch.tensor([1.0, 0.0]), noise=0.1).item() == pytest.approx(0.5)
    assert ambiguity(signals, PAIR, masks, torch.tensor([0.5, 0.5]), noise=0.1).item() == pytest.approx(0.25)


def test_ambiguity_and_sharpness_gradients_match_finite_differences():
    rng = np.random.default_rng(1)
    signals = torch.tensor(rng.uniform(0, 1, (4, 9)), requires_grad=True)
    places = torch.tensor(rng.uniform(1, 4, (9, 2)))
    masks, weight = torch.tensor([[1.0, 1, 1, 1], [1, 0, 1, 1]]).double(), torch.tensor([0.3, 0.7]).double()
    assert torch.autograd.gradcheck(lambda s: ambiguity(s, places, masks, weight, 0.3), signals)
    assert torch.autograd.gradcheck(sharpness, signals)


def test_full_scale_and_sharpness_have_closed_forms():
    signals = torch.tensor([[0.0, 2.0, 1.0], [0.0, 0.0, 0.0], [6.0, 3.0, 0.0]])
    assert full_scale(signals) == pytest.approx(4.0)
    assert full_scale(torch.zeros(2, 3)) == 1.0
    assert sharpness(torch.tensor([[0.0, 1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0]])).item() == pytest.approx((1 + 2) / 4)


def test_failure_shares_are_equal_or_as_weighted():
    assert failure_shares(3) == (3 / 6, 1 / 6, 1 / 6, 1 / 6)
    assert failure_shares(1) == (0.5, 0.5)
    assert failure_shares(0) == (1.0,)
    assert failure_shares((1.0, 0.0, 3.0)) == (0.25, 0.0, 0.75)


@settings(max_examples=20)
@given(st.integers(0, 4) | st.lists(st.sampled_from([0.0, 1.0, 3.0]), min_size=1, max_size=5).filter(sum).map(tuple))
def test_sample_failures_draws_two_sets_of_each_possible_size_and_one_of_size_0(lost):
    shares = failure_shares(lost)
    n_failed = 8 - sample_failures(8, shares, np.random.default_rng(0)).sum(axis=1)
    draws = [min(k + 1, 2) if share > 0 else 0 for k, share in enumerate(shares)]
    assert [(n_failed == k).sum() for k in range(len(shares))] == draws
    masks = sample_failures(2, failure_shares(5), np.random.default_rng(0))
    assert masks.sum(axis=1).min() == 1  # a pad is never left without a fibre


def test_failure_subsets_are_all_or_a_sample():
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert failure_subsets(4, 2) == failure_subsets(4, 2, max_subsets=6) == pairs
    assert failure_subsets(3, 0) == [()]
    drawn = failure_subsets(8, 3, max_subsets=20)
    assert drawn == sorted(set(drawn)) == failure_subsets(8, 3, max_subsets=20)
    assert len(drawn) == 20
    assert all(0 <= a < b < c < 8 for a, b, c in drawn)
    assert {fibre for loss in drawn for fibre in loss} == set(range(8))


def test_ambiguities_do_not_depend_on_untouched_fibres():
    """Of 64 x 64 fibres a lattice of presses misses most, which `ambiguities` leaves out."""
    pad, contact, size = Morphology.straight(64), PUBLISHED_CONTACT, PadSettings(grid=64)
    presses = free_presses(size)
    responses = torch.tensor(signals(pad, presses, contact).T, dtype=torch.float32)
    assert not responses.any(dim=1).all()
    places, one = torch.tensor(presses, dtype=torch.float32), torch.ones(1)
    every = ambiguity(responses, places, torch.ones(1, len(responses)), one, 0.01 * full_scale(responses)).item()
    assert ambiguities(pad, contact, 0, 0.01, size) == pytest.approx([every], rel=1e-6)


@pytest.mark.parametrize(
    ("pad", "contact"),
    [
        (Morphology.random(4, 5, 1), Contact()),
        (Morphology.random((2, 5), 3, 2, (8.0, 13.0)), PUBLISHED_CONTACT),
        (Morphology.random((2, 5), 3, 2, (8.0, 5.0)), Contact()),
        (Morphology.straight((1, 0)), Contact()),
    ],
)
def test_ambiguity_map_has_the_ambiguity_as_mean(pad, contact):
    size = PadSettings().for_layout(pad.layout)
    means = ambiguity_map(pad, free_presses(size), contact, 3, 0.05).mean(axis=1)
    # the score's is in single precision
    assert means == pytest.approx(ambiguities(pad, contact, 3, 0.05, size), rel=1e-3, abs=3e-4)
    assert (np.diff(means) >= 0).all()


def test_ambiguity_map_shows_where_presses_are_alike():
    """One fibre along x tells how far off it a press is, but not on which side: its own line alone is certain."""
    presses = np.stack([np.ones(9), np.linspace(0.2, 1.8, 9)], axis=1)
    values = ambiguity_map(Morphology.straight((1, 0)), presses, Contact(), 0, 1e-3)[0]
    assert values[4] == pytest.approx(0, abs=1e-9)
    assert values[:4] == pytest.approx(np.linspace(0.8, 0.2, 4), rel=1e-6)  # half of the way to the other side
    assert values[5:] == pytest.approx(values[:4][::-1])


def test_ambiguity_map_has_the_full_scale_of_touched_fibres():
    """Presses beside the lowest of six fibres, of which it is the only one to respond."""
    pad, presses = Morphology.straight((6, 0)), np.stack([np.ones(5), np.linspace(0.8, 1.4, 5)], axis=1)
    stretch = torch.tensor(relative_stretch(pad, presses, PUBLISHED_CONTACT).T)
    assert stretch.any(dim=1).tolist() == [True] + 5 * [False]
    noise, one = 0.05 * stretch.max().item(), torch.ones(1).double()
    expected = ambiguity(stretch, torch.tensor(presses), torch.ones(1, 6), one, noise).item()
    assert expected > 0.05
    assert ambiguity_map(pad, presses, PUBLISHED_CONTACT, 0, 0.05)[0].mean() == pytest.approx(expected, rel=1e-9)
