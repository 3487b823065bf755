"""Evaluation by simulation: the published order of the pads, and fresh test presses."""

import os

import numpy as np
import pytest
import torch

from padforge.common.validation import InputError
from padforge.design import Contact, Morphology, signals
from padforge.design.published.networks import (
    SimulatedPresses,
    fresh_presses,
    localisation_error,
    training_presses,
)
from padforge.design.settings import Layout, PadSettings, between_fibres


def means(pad, **settings):
    return [level.mean for level in localisation_error(pad, presses=256, test=500, hidden=20, **settings)]


def test_localisation_error_of_the_published_pad_is_below_the_square_grid(published):
    square = localisation_error(
        Morphology.load(published / "square_grid_cir.mat"), Contact(sides=50), n_failed=(0, 1), subsets=1
    )
    curved = localisation_error(Morphology.load(published / "5para_dis.mat"), n_failed=(0, 1, 3), subsets=1)
    assert [level.subsets for level in curved] == [1, 1, 1]
    for straight, bent in zip(square, curved[:2], strict=True):
        assert bent.mean < 0.7 * straight.mean
    assert 0.15 < square[0].mean < 0.3
    assert 0.04 < curved[0].mean < 0.12
    assert curved[0].mean < curved[2].mean


def test_localisation_error_summarises_all_failure_subsets():
    found = localisation_error(Morphology.random(2, 5, seed=1), n_failed=(0, 2, 4), presses=144, test=300, hidden=10)
    assert [(level.n_failed, level.subsets) for level in found] == [(0, 1), (2, 6)]  # one fibre works at least
    assert found[0].std == 0
    assert found[0].mean < found[1].mean
    assert all(level.mean <= level.max and (level.subsets == 1) == (level.std == 0) for level in found)


def test_localisation_error_depends_on_its_seed_and_not_on_cores(monkeypatch):
    pad = Morphology.random(3, 5, seed=1)
    side_by_side = means(pad, n_failed=(0, 1), subsets=3)
    threads = torch.get_num_threads()
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    assert means(pad, n_failed=(0, 1), subsets=3) == side_by_side
    assert means(pad, n_failed=(0, 1), subsets=3, seed=1) != side_by_side
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("grid", [1, 4])
def test_fresh_presses_differ_from_training_presses(grid):
    between = between_fibres(Layout.create(grid))
    learned, fresh = training_presses(between, 32, seed=0), fresh_presses(between, 2000, seed=0)
    low, high = (0.5, 1.5) if grid == 1 else (1, grid)
    assert not set(map(tuple, learned)) & set(map(tuple, fresh))
    for presses, beyond in ((learned, 5 / 49), (fresh, 0)):
        assert presses.min() >= low
        assert high - 0.1 < presses.max() <= high + beyond
        assert np.unique(presses, axis=0).shape == presses.shape
    assert not np.array_equal(fresh, fresh_presses(between, 2000, seed=1))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"presses": 1000}, "presses is 1000, allowed is a square number"),
        ({"n_failed": (-1,)}, "n_failed is -1, allowed is"),
    ],
)
def test_localisation_error_refuses_invalid_arguments(asked, message):
    with pytest.raises(InputError, match=message):
        localisation_error(**{"pad": Morphology.straight(4)} | asked)


def test_simulated_presses_beyond_the_fibres_with_noise():
    pad, rng = Morphology.random(2, 3, seed=0), np.random.default_rng(0)

    def answer(places):
        return signals(pad, places) + 0.02 * rng.standard_normal((len(places), 4))

    trial = SimulatedPresses.simulate(pad, 12, 300, 0, answer, PadSettings(grid=2, sensed_mm="beyond"))
    for places, jitter in ((trial.train_positions, 5 / 49), (trial.test_positions, 0)):
        assert (places >= 0.5).all()
        assert (places <= 2.5 + jitter).all()
        assert (np.ptp(places, axis=0) > 1.97).all()
    none, one = trial.failure_errors([[()], [(0,), (3,)]], hidden=10)
    assert (none.n_failed, none.subsets, one.n_failed, one.subsets) == (0, 1, 1, 2)
    assert 0.005 < none.mean < one.mean < 0.6


def test_networks_ignore_the_signals_of_failed_fibres():
    pad = Morphology.straight(3)
    presses = SimulatedPresses.simulate(pad, 12, 50, 0, lambda positions: signals(pad, positions))
    failed = (0, 4)
    [network] = presses.fit([failed], hidden=8)
    changed = presses.test_signals.copy()
    changed[:, failed] = np.nan
    errors = presses.position_errors(network, failed, changed, presses.test_positions)
    np.testing.assert_array_equal(errors, presses.test_errors(network, failed))
