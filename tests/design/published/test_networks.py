"""Evaluation by simulation: the published order of the pads, and fresh test presses."""

import os
from typing import Any

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals
from padforge.design.published.networks import (
    SimulatedPresses,
    fit_batch,
    fresh_presses,
    localisation_error,
    training_presses,
)
from padforge.design.settings import Layout, between_fibres


def test_localisation_error_summarises_all_failure_subsets():
    found = localisation_error(Morphology.random(2, 5, seed=1), n_failed=(0, 2, 4), presses=144, test=300, hidden=10)
    assert [(level.n_failed, level.subsets) for level in found] == [(0, 1), (2, 6)]  # one fibre works at least
    assert found[0].std == 0
    assert found[0].mean < found[1].mean
    assert all(level.mean <= level.max and (level.subsets == 1) == (level.std == 0) for level in found)


def test_networks_ignore_the_signals_of_failed_fibres():
    pad = Morphology.straight(3)
    presses = SimulatedPresses.simulate(pad, 12, 50, 0, lambda positions: signals(pad, positions))
    failed = (0, 4)
    [network] = presses.fit([failed], hidden=8)
    changed = presses.test_signals.copy()
    changed[:, failed] = np.nan
    errors = presses.position_errors(network, failed, changed, presses.test_positions)
    np.testing.assert_array_equal(errors, presses.test_errors(network, failed))


def test_networks_are_scaled_by_their_training_samples_alone():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (1, 60, 3)), rng.uniform(-1, 1, (60, 2))
    checked = rng.uniform(-9, 9, (1, 20, 3)), rng.uniform(-9, 9, (20, 2))
    [network] = fit_batch(x, y, [rng], hidden=3, epochs=2, validation=checked)
    for scaler, samples in ((network.inputs, x[0]), (network.targets, y)):
        np.testing.assert_array_equal(scaler.transform(samples).min(axis=0), -1)
        np.testing.assert_array_equal(scaler.transform(samples).max(axis=0), 1)


def test_localisation_error_of_the_published_pad_is_below_the_square_grid(published):
    square, curved = (Morphology.load(published / f"{name}.mat") for name in ("square_grid_cir", "5para_dis"))
    straight = localisation_error(square, Contact(sides=50), n_failed=(0, 1), subsets=1)
    found = localisation_error(curved, n_failed=(0, 1), subsets=1)
    for before, after in zip(straight, found, strict=True):
        assert after.mean < 0.7 * before.mean
    assert 0.15 < straight[0].mean < 0.3
    assert 0.04 < found[0].mean < 0.12


def test_localisation_error_depends_on_its_seed_and_not_on_cores(monkeypatch):
    pad = Morphology.random(2, 3, seed=1)
    asked: dict[str, Any] = {"presses": 100, "test": 100, "hidden": 8, "subsets": 3}
    side_by_side, other = (localisation_error(pad, n_failed=(0, 1), seed=seed, **asked) for seed in (0, 1))
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    assert localisation_error(pad, n_failed=(0, 1), **asked) == side_by_side != other


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
