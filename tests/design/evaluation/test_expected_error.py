"""The expected error against slow oracles and closed forms, and its gradient against differences."""

import numpy as np
import pytest
import torch

from design.evaluation import expected_error as module
from design.evaluation.expected_error import (
    RIDGE,
    WIDTH,
    expected_error,
    expected_errors,
    over_losses,
    shifted_lattice,
)
from design.pad.morphology import Morphology
from design.settings import PUBLISHED_CONTACT, PUBLISHED_PAD, Contact, PadSettings

SIDE, SIZE = 14, np.array([4.0, 4.0])
PLACES, STEPS = shifted_lattice(((0.0, 0.0), (4.0, 4.0)), SIDE, np.random.default_rng(0))
STEP = torch.tensor(STEPS)
NONE_LOST = torch.ones(1, 2)
SILENT = 1e-9
"""Noise that adds nothing where signals tell the place."""


def errors(signals: np.ndarray, kept, sigma=SILENT) -> list[float]:
    return expected_error(torch.tensor(signals), torch.tensor(PLACES), STEP, torch.tensor(kept), sigma).tolist()


def error(signals: np.ndarray, sigma=SILENT) -> float:
    """With all fibres."""
    return errors(signals, [[1.0] * len(signals)], sigma)[0]


def drawn(fibres=3):
    return np.sin(PLACES @ np.random.default_rng(5).standard_normal((2, fibres))).T


def taught_without_each(signals: np.ndarray) -> float:
    """Mean error of regressions that each lack one press."""
    scaled, places = signals.T / WIDTH, PLACES - PLACES.mean(axis=0)
    kernel = np.exp(-((scaled[:, None] - scaled[None]) ** 2).sum(axis=-1) / 2)
    errors = []
    for left in range(len(places)):
        rest = np.delete(np.arange(len(places)), left)
        learnt = np.linalg.solve(kernel[np.ix_(rest, rest)] + RIDGE * np.eye(len(rest)), places[rest])
        errors.append(np.linalg.norm(kernel[left, rest] @ learnt - places[left]))
    return float(np.mean(errors))


def test_a_shifted_lattice_lies_within_the_rectangle():
    for rectangle in (((1.0, 2.0), (4.0, 6.2)), ((0.5, 0.5), (40.5, 40.5))):
        places, step = shifted_lattice(rectangle, SIDE, np.random.default_rng(0))
        assert (places >= rectangle[0]).all()
        assert (places <= rectangle[1]).all()
        each = places.reshape(SIDE, SIDE, 2)
        assert np.diff(each[..., 0], axis=1) == pytest.approx(step[0])
        assert np.diff(each[..., 1], axis=0) == pytest.approx(step[1])
        assert np.ptp(places, axis=0).max() < module.WINDOW


def test_without_noise_it_is_the_error_of_regressions_that_each_lack_one_press():
    signals = drawn()
    assert error(signals) == pytest.approx(taught_without_each(signals), rel=1e-6)


def test_a_lost_fibre_tells_nothing():
    other = drawn()
    other[1] = other[1, ::-1]
    kept = [[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    found, changed = errors(drawn(), kept, 0.01), errors(other, kept, 0.01)
    assert found[0] == pytest.approx(changed[0])
    assert found[1] != pytest.approx(changed[1])
    assert found[0] == pytest.approx(error(drawn()[[0, 2]], 0.01))


def test_a_gain_of_a_tenth_counts_alike_however_many_fibres_are_lost():
    kept = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    given = torch.tensor([0.1, 0.2, 0.4, 2.7])
    even = (1 / 3, 1 / 3, 1 / 3)
    usual = over_losses(given, kept, even).item()
    assert usual == pytest.approx((0.1 * 0.3 * 2.7) ** (1 / 3))
    for level in ([0], [1, 2], [3]):
        better = given.clone()
        better[level] *= 0.9
        assert over_losses(better, kept, even).item() == pytest.approx(0.9 ** (1 / 3) * usual)
    assert over_losses(given[:3], kept[:3], (0.2, 0.8, 0.0)).item() == pytest.approx(0.1**0.2 * 0.3**0.8)
    assert over_losses(given[:1], kept[:1], even).item() == pytest.approx(0.1), "what cannot be lost counts for nothing"


def test_the_bound_of_signals_that_are_the_place_is_their_noise():
    rates = module._rates(torch.tensor(PLACES) * 0.5, STEP)
    assert rates.numpy() == pytest.approx(np.broadcast_to(0.5 * np.eye(2), rates.shape))
    # 0.02 off in each signal is 0.04 grid units in each direction; what is known beforehand adds next to nothing
    bound = module._bound(rates / 0.02, NONE_LOST.double(), torch.tensor(SIZE))
    assert bound.item() == pytest.approx(np.sqrt(2) * 0.04, rel=1e-3)


def test_without_signals_nothing_is_known_but_that_the_place_is_on_the_pad():
    known = torch.zeros(1, 2, 2).double()
    assert module._bound(known, NONE_LOST.double(), torch.tensor(SIZE)).item() == pytest.approx(np.sqrt(2 * 16 / 12))
    # about the mean distance of a place of a square of side 4 from its middle, 0.3826 sides
    assert error(np.zeros((2, SIDE**2))) - np.sqrt(2 * 16 / 12) == pytest.approx(4 * 0.3826, rel=0.03)


def test_a_regression_finds_places_that_signals_tell_the_worse_the_louder_they_are():
    told = PLACES.T / 4
    assert error(told) < 0.03
    # both are four times as loud as a grid unit, and stand across each other
    assert error(told, sigma=0.05) - error(told) == pytest.approx(np.sqrt(2) * 0.05 * 4, rel=0.03)


@pytest.mark.parametrize("sigma", [SILENT, 0.05])
def test_its_gradient_is_that_of_differences(sigma):
    signals = torch.tensor(drawn(), requires_grad=True)
    kept, shares = torch.tensor([[1.0, 1, 1], [1, 0, 1]]).double(), (0.6, 0.4)

    def joint(signals):
        return over_losses(expected_error(signals, torch.tensor(PLACES), STEP, kept, sigma), kept, shares)

    joint(signals).backward()
    way = torch.tensor(np.random.default_rng(6).standard_normal(signals.shape))
    with torch.no_grad():
        slope = (joint(signals + 1e-6 * way) - joint(signals - 1e-6 * way)) / 2e-6
    assert signals.grad is not None
    assert slope.item() == pytest.approx((signals.grad * way).sum().item(), rel=1e-3)


def test_single_precision_serves():
    signals = drawn(8)
    given = torch.tensor(PLACES), STEP, torch.ones(1, 8), 0.01
    fine, coarse = (expected_error(torch.tensor(each), *given).item() for each in (signals, signals.astype(np.float32)))
    assert coarse == pytest.approx(fine, rel=1e-3)


def test_a_pad_errs_more_the_more_fibres_are_lost_and_the_louder_they_are():
    pad = Morphology.straight(3)
    wide = Contact(reach=((0, 1), (5.6, 0.66), (11.2, 0.19), (18.6, 0)), length="euclidean")
    quiet, loud = (expected_errors(pad, wide, 2, noise, PadSettings(grid=3)) for noise in (0.01, 0.05))
    assert quiet == sorted(quiet)
    assert np.all(np.array(loud) > quiet)


def test_under_the_published_contact_random_zigzags_err_less_than_straight_fibres():
    asked = PUBLISHED_CONTACT, 1, 1e-3, PUBLISHED_PAD
    random, straight = (expected_errors(pad, *asked) for pad in (Morphology.random(4, 5, 1), Morphology.straight(4)))
    assert np.all(np.array(random) < straight)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_where_one_direction_alone_is_told_a_faint_noise_leaves_the_other_to_what_is_known(dtype):
    along = np.stack([PLACES[:, 0], 2 * PLACES[:, 0]]).astype(dtype)
    rates = module._rates(torch.tensor(along).T, STEP.to(torch.tensor(along).dtype)) / 1e-9
    bound = module._bound(rates, NONE_LOST.to(rates.dtype), torch.tensor(SIZE, dtype=rates.dtype))
    assert bound.item() == pytest.approx(SIZE[1] / np.sqrt(12), rel=1e-3)


def test_a_pad_that_answers_no_press_errs_as_a_guess():
    errors = expected_errors(Morphology.straight(2), Contact(radius=1e-9), 1, 0.01, PadSettings(grid=2))
    assert errors == pytest.approx([errors[0]] * 2)
    assert errors[0] > 1.0
