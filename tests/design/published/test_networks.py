from functools import partial

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals
from padforge.design.published.networks import SimulatedPresses, fit_batch, fresh_presses, training_presses
from padforge.design.settings import PUBLISHED_CONTACT, Layout, between_fibres


def test_networks_ignore_failed_fibres_and_are_scaled_by_their_training_samples_alone():
    pad = Morphology.straight(3)
    presses = SimulatedPresses.simulate(pad, 12, 50, 0, lambda positions: signals(pad, positions))
    failed = (0, 4)
    [network] = presses.fit([failed], hidden=8)
    changed = presses.test_signals.copy()
    changed[:, failed] = np.nan
    errors = presses.position_errors(network, failed, changed, presses.test_positions)
    np.testing.assert_array_equal(errors, presses.test_errors(network, failed))
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (1, 60, 3)), rng.uniform(-1, 1, (60, 2))
    checked = rng.uniform(-9, 9, (1, 20, 3)), rng.uniform(-9, 9, (20, 2))
    [network] = fit_batch(x, y, [rng], hidden=3, epochs=2, validation=checked)
    for scaler, samples in ((network.inputs, x[0]), (network.targets, y)):
        np.testing.assert_array_equal(scaler.transform(samples).min(axis=0), -1)
        np.testing.assert_array_equal(scaler.transform(samples).max(axis=0), 1)


def test_errors_of_the_published_pad_are_below_those_of_the_square_grid(published):
    square, curved = (Morphology.load(published / f"{name}.mat") for name in ("square_grid_cir", "5para_dis"))
    errors = []
    for pad, contact in ((square, Contact(sides=50)), (curved, PUBLISHED_CONTACT)):
        presses = SimulatedPresses.simulate(pad, 32, 2000, 0, partial(signals, pad, contact=contact))
        errors.append([presses.test_errors(presses.fit([failed], 50)[0], failed).mean() for failed in ((), (0,))])
    straight, found = np.array(errors)
    assert (found < 0.7 * straight).all()
    assert 0.15 < straight[0] < 0.3
    assert 0.04 < found[0] < 0.12


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
