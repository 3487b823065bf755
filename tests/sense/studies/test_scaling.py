"""The study of larger surfaces, in small."""

import numpy as np
import pytest

from padforge.design import Morphology, signals
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense.studies import scaling
from padforge.sense.studies.scaling import family_shares, scaling_study, spread_presses, tile_inputs


def test_a_network_for_all_tiles_keeps_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("TEST", 600), ("HIDDEN", 30), ("EPOCHS", 30)):
        monkeypatch.setattr(scaling, name, value)
    tasks = {task.name: task for task in scaling_study({"a": Morphology.straight(2)}, grids=(4, 16), side=32).tasks}
    small, large = (tasks[f"a, {grid} x {grid}, shared"].compute()["errors"].mean() for grid in (4, 16))
    assert large < 1.3 * small < 0.4


def test_family_shares_divide_by_the_sum_of_each_family() -> None:
    responses = np.array([[1.0, 3.0, 0.0, 0.0], [0.0, 2.0, 5.0, 5.0]])
    np.testing.assert_allclose(family_shares(responses), [[0.25, 0.75, 0, 0, 4, 0], [0, 1, 0.5, 0.5, 2, 10]])


def test_tile_inputs_are_the_same_in_every_tile() -> None:
    """A published press ends within its tile; what a layer feels of fibres bent beyond its neighbours differs."""
    pad = Morphology.random(2, 3, 1).tiled(6)
    position = np.array([[5.2, 7.1]])
    inputs, origin = tile_inputs(signals(pad, position, PUBLISHED_CONTACT), 2)
    moved = signals(pad, position + np.array([2.0, -4.0]), PUBLISHED_CONTACT)
    moved_inputs, moved_origin = tile_inputs(moved, 2)
    np.testing.assert_allclose(inputs, moved_inputs, atol=1e-9)
    np.testing.assert_array_equal(moved_origin - origin, [[2.0, -4.0]])
    assert inputs.shape == (1, 12)


def test_spread_presses_draws_one_in_each_cell() -> None:
    positions = spread_presses(((1, 1), (9, 9)), 8, 0)
    assert set(map(tuple, np.floor(positions - 1).astype(int))) == {(x, y) for x in range(8) for y in range(8)}
