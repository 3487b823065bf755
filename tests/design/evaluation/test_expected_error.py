"""The expected error against closed forms, and its gradient against differences."""

import numpy as np
import pytest
import torch

from design.evaluation import expected_error as module
from design.evaluation.expected_error import balanced, expected_error, expected_errors, two_lattices
from design.pad.morphology import Morphology
from design.settings import Contact, PadSettings

SIDE, SIZE = 14, np.array([4.0, 4.0])
PLACES, STEPS = two_lattices(((0.0, 0.0), (4.0, 4.0)), np.random.default_rng(0))
STEP = torch.tensor(STEPS)
NONE_LOST = torch.ones(1, 2), torch.ones(1)


def error(signals: np.ndarray, kept=NONE_LOST[0], weight=NONE_LOST[1], sigma=0.01, noisy=True) -> float:
    noise = torch.tensor(np.random.default_rng(3).standard_normal(signals.shape)) * noisy
    given = torch.tensor(signals), torch.tensor(PLACES), STEP, kept.double(), weight.double(), noise
    return expected_error(*given, sigma).item()


def test_two_lattices_lie_within_the_rectangle_a_step_apart():
    places, step = two_lattices(((1.0, 2.0), (4.0, 6.2)), np.random.default_rng(0))
    assert (places >= [1, 2]).all()
    assert (places <= [4, 6.2]).all()
    for each in places.reshape(2, 14, 14, 2):
        assert np.diff(each[..., 0], axis=1) == pytest.approx(step[0])
        assert np.diff(each[..., 1], axis=0) == pytest.approx(step[1])
    large, _ = two_lattices(((0.5, 0.5), (40.5, 40.5)), np.random.default_rng(0))
    assert np.ptp(large, axis=0).max() < 5


def test_a_pad_errs_more_the_more_fibres_are_lost_and_the_louder_they_are():
    pad = Morphology.straight(3)
    wide = Contact(reach=((0, 1), (0.5, 0.66), (1.0, 0.19), (1.65, 0)), length="euclidean")
    quiet, loud = (expected_errors(pad, wide, 2, noise, PadSettings(grid=3)) for noise in (0.01, 0.05))
    assert quiet == sorted(quiet)
    assert np.all(np.array(loud) > quiet)


def test_balanced_shares_count_a_further_loss_less():
    assert balanced((0.5, 0.5)) == pytest.approx((0.75, 0.25))
    assert balanced((0.0, 1.0, 0.0)) == (0, 1, 0)


def test_the_bound_of_signals_that_are_the_place_is_their_noise():
    rates = module._rates(torch.tensor(PLACES[: SIDE**2]) * 0.5, STEP)
    assert rates.numpy() == pytest.approx(np.broadcast_to(0.5 * np.eye(2), rates.shape))
    # 0.02 off in each signal is 0.04 grid units in each direction; what is known beforehand adds next to nothing
    bound = module._bound(rates / 0.02, NONE_LOST[0].double(), torch.tensor(SIZE))
    assert bound.item() == pytest.approx(np.sqrt(2) * 0.04, rel=1e-3)


def test_without_signals_nothing_is_known_but_that_the_place_is_on_the_pad():
    flat = np.zeros((2, 2 * SIDE**2))
    known = torch.zeros(1, 2, 2).double()
    assert module._bound(known, NONE_LOST[0].double(), torch.tensor(SIZE)).item() == pytest.approx(np.sqrt(2 * 16 / 12))
    # about the mean distance of a place of a square of side 4 from its middle, 0.3826 sides
    assert error(flat) - np.sqrt(2 * 16 / 12) == pytest.approx(4 * 0.3826, rel=0.1)


def test_a_regression_finds_places_that_signals_tell():
    told = PLACES.T / 4
    assert error(told, sigma=1e-6, noisy=False) < 0.03
    assert error(told, sigma=0.05) > 3 * error(told, sigma=0.01)


def test_a_lost_fibre_takes_its_direction_away():
    told = PLACES.T / 4
    lost = torch.tensor([[1.0, 0.0]]), torch.ones(1)
    assert error(told, *lost) > 1.0
    both = torch.tensor([[1.0, 1.0], [1.0, 0.0]]), torch.tensor([0.75, 0.25])
    assert error(told, *both) == pytest.approx(0.75 * error(told) + 0.25 * error(told, *lost))


def test_its_gradient_is_that_of_differences():
    rng = np.random.default_rng(5)
    signals = torch.tensor(np.sin(PLACES @ rng.standard_normal((2, 3))).T, requires_grad=True)
    noise, kept = torch.tensor(rng.standard_normal((3, len(PLACES)))), torch.tensor([[1.0, 1, 1], [1, 0, 1]]).double()
    rest = torch.tensor(PLACES), STEP, kept, torch.tensor([0.6, 0.4]).double(), noise, 0.05
    expected_error(signals, *rest).backward()
    way = torch.tensor(rng.standard_normal(signals.shape))
    with torch.no_grad():
        slope = (expected_error(signals + 1e-6 * way, *rest) - expected_error(signals - 1e-6 * way, *rest)) / 2e-6
    assert signals.grad is not None
    assert slope.item() == pytest.approx((signals.grad * way).sum().item(), rel=1e-4)
