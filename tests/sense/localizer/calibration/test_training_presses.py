"""Presses as a table would stand to them that has not seen them."""

import numpy as np

from sense.localizer.calibration.networks.training_presses import TrainingPresses, as_unseen
from sense.localizer.response.response_model import STEPS, ResponseModel, leverages, looked_up

PRESSES, FIBRES, WINDOWS = 90, 2, 3


def made() -> tuple[np.ndarray, np.ndarray]:
    """Places that the table has an entry for, some of them pressed twice, and what fibres gave there."""
    rng = np.random.default_rng(0)
    places = rng.integers(-STEPS // 2, STEPS // 2, (PRESSES, 2)) / (STEPS / 2)
    places[1::9] = places[0::9]
    return places, np.sin(3 * places[:, :1, None] + np.arange(WINDOWS)) + rng.standard_normal(
        (PRESSES, FIBRES, WINDOWS)
    )


def table_of(places: np.ndarray, windows: np.ndarray) -> np.ndarray:
    nothing, alive = np.empty((len(places), FIBRES, 0)), np.ones((len(places), FIBRES), dtype=bool)
    return ResponseModel.fit(places, windows, nothing, alive).table.astype(np.float32)


def test_they_are_as_far_off_as_from_a_table_fitted_without_them() -> None:
    places, windows = made()
    alive = np.ones((PRESSES, FIBRES), dtype=bool)
    table = table_of(places, windows)
    presses = TrainingPresses(windows.astype(np.float32), alive, places.astype(np.float32))
    flat = table.reshape(*table.shape[:2], -1)
    rest = as_unseen(presses, table).inputs - looked_up(flat, places).reshape(windows.shape)
    for press in (0, 4, 17):
        others = (places != places[press]).any(axis=1)
        without = table_of(places[others], windows[others])
        expected = looked_up(without.reshape(*table.shape[:2], -1), places[[press]]).reshape(FIBRES, WINDOWS)
        same = (places == places[press]).all(axis=1)
        # Of several presses at one place, left out together, their mean stands to the table as each of them does here.
        np.testing.assert_allclose(rest[same].mean(axis=0), windows[same].mean(axis=0) - expected, atol=0.02, rtol=0.02)


def test_what_no_table_expects_is_left_as_it_was() -> None:
    places, windows = made()
    table = np.pad(table_of(places, windows), ((0, 0), (0, 0), (0, 0), (0, 1)))
    inputs = np.pad(windows, ((0, 0), (0, 0), (0, 1)), constant_values=0.7).astype(np.float32)
    presses = TrainingPresses(inputs, np.ones((PRESSES, FIBRES), dtype=bool), places.astype(np.float32))
    found = as_unseen(presses, table).inputs
    assert np.array_equal(found[:, :, -1], inputs[:, :, -1])
    assert not np.allclose(found[:, :, :-1], inputs[:, :, :-1])


def test_leverages_are_shares_that_add_up_to_what_a_fit_can_tell() -> None:
    places, _ = made()
    found = leverages(places)
    assert found.min() > 0
    assert found.max() < 1
    twice = leverages(np.concatenate([places, places]))
    assert (twice[:PRESSES] > found).all()
    assert np.array_equal(twice[:PRESSES], twice[PRESSES:])
