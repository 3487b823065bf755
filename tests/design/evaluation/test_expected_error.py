"""The expected error against closed forms, and its gradient against differences."""

import numpy as np
import pytest
import torch

from design.evaluation import expected_error as module
from design.evaluation.expected_error import expected_error, lattice

SIDE, SIZE = 8, np.array([4.0, 4.0])
STEP = torch.tensor(SIZE / SIDE)
PLACES = np.concatenate([lattice(np.zeros(2), SIZE, SIDE, np.random.default_rng(seed)) for seed in (0, 1)])
NONE_LOST = torch.ones(1, 2), torch.ones(1)


def error(signals: np.ndarray, kept=NONE_LOST[0], weight=NONE_LOST[1], sigma=0.01, noisy=True) -> float:
    noise = torch.tensor(np.random.default_rng(3).standard_normal(signals.shape)) * noisy
    given = torch.tensor(signals), torch.tensor(PLACES), STEP, kept.double(), weight.double(), noise
    return expected_error(*given, sigma).item()


def test_a_lattice_lies_within_its_rectangle_a_cell_apart():
    places = lattice(np.array([1.0, 2.0]), np.array([3.0, 6.0]), 3, np.random.default_rng(0)).reshape(3, 3, 2)
    assert (places >= [1, 2]).all()
    assert (places <= [4, 8]).all()
    assert np.diff(places[..., 0], axis=1) == pytest.approx(1.0)
    assert np.diff(places[..., 1], axis=0) == pytest.approx(2.0)


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
