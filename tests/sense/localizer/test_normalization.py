"""Inputs become numbers of about 1, and numbers become mm, as the formulas say."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sense.localizer.features import Inputs
from sense.localizer.normalization import MAX_INPUT, Normalization
from sense.localizer.response.response_model import BUMPS, WIDTH, bumps
from tests.helpers.effort import few

PRESSES, FIBRES, WINDOWS = 300, 3, 4


def made(seed: int = 0) -> tuple[Inputs, np.ndarray]:
    """Presses without a history, each fibre and window of a size of its own, the last fibre dead in some of them."""
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.1, 2.0, (FIBRES, WINDOWS))
    windows = 3 + sizes * rng.standard_normal((PRESSES, FIBRES, WINDOWS))
    alive = np.ones((PRESSES, FIBRES), dtype=bool)
    alive[::4, 2] = False
    windows[::4, 2] = 1e3
    return Inputs(windows, np.empty((PRESSES, FIBRES, 0)), alive), rng.uniform((-20, 0), (30, 10), (PRESSES, 2))


def test_a_window_is_scaled_by_the_mean_of_its_own_spread_and_its_fibres() -> None:
    inputs, places = made()
    scaling, table = Normalization.fit(inputs, places)
    for fibre in range(FIBRES):
        own = inputs.windows[inputs.alive[:, fibre], fibre]
        variance = own.var(axis=0)
        np.testing.assert_allclose(scaling.centre[fibre], own.mean(axis=0))
        np.testing.assert_allclose(scaling.spread[fibre], np.sqrt(np.sqrt(variance) * np.sqrt(variance.mean())))
    scaled = scaling.inputs(inputs)
    np.testing.assert_allclose(
        scaled.inputs[1], (inputs.windows[1] - scaling.centre) / scaling.spread, rtol=1e-5, atol=1e-6
    )
    np.testing.assert_array_equal(scaled.alive, inputs.alive)
    scaling.refuse_unsound(table)


def test_what_lies_far_off_is_held() -> None:
    inputs, places = made()
    scaling, _ = Normalization.fit(inputs, places)
    far = scaling.scaled(np.full((1, FIBRES, WINDOWS), 1e9))
    assert (far == MAX_INPUT).all()
    assert (scaling.scaled(-np.full((1, FIBRES, WINDOWS), 1e9)) == -MAX_INPUT).all()


def test_places_are_counted_from_the_middle_in_halves_of_the_longer_side() -> None:
    inputs, places = made()
    places[:4] = [[-20, 0], [30, 10], [30, 0], [5, 5]]
    scaling, _ = Normalization.fit(inputs, places)
    np.testing.assert_allclose(scaling.middle_mm, [5, 5])
    assert scaling.span_mm == 25
    np.testing.assert_allclose(scaling.targets(places[:4]), [[-1, -0.2], [1, 0.2], [1, -0.2], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(scaling.places_mm(scaling.targets(places)), places, atol=1e-4)
    assert scaling.entries("masked") == FIBRES * WINDOWS + FIBRES
    assert scaling.entries("published") == FIBRES * WINDOWS


def test_bumps_are_gaussians_on_a_grid_over_the_pad() -> None:
    places = np.array([[0.3, -0.8], [-1.0, 1.0]])
    line = np.linspace(-1, 1, BUMPS)
    for place, found in zip(places, bumps(places), strict=True):
        away = [
            np.exp(-((place[0] - x) ** 2 + (place[1] - y) ** 2) / (2 * (0.1 * WIDTH) ** 2)) for x in line for y in line
        ]
        assert found == pytest.approx(np.array(away))


def raw(windows: np.ndarray, history: np.ndarray | None = None) -> Inputs:
    past = np.zeros((*windows.shape[:2], 0)) if history is None else history
    return Inputs(windows, past, np.ones(windows.shape[:2], dtype=bool))


@few(2)  # each fits the whole pad twice
@given(seed=st.integers(0, 999), gain=st.floats(1e-3, 1e3))
def test_scaled_inputs_do_not_depend_on_the_gain(seed: int, gain: float) -> None:
    rng = np.random.default_rng(seed)
    inputs, places = rng.standard_normal((30, 3, 4)), rng.uniform(-9, 9, (30, 2))
    (plain, table), (scaled, same) = (Normalization.fit(raw(factor * inputs), places) for factor in (1, gain))
    assert np.allclose(plain.inputs(raw(inputs)).inputs, scaled.inputs(raw(gain * inputs)).inputs, atol=1e-4)
    assert np.allclose(table, same, atol=1e-3)
    assert np.abs(plain.targets(places)).max() <= 1 + 1e-6
    assert np.allclose(plain.places_mm(plain.targets(places)), places, atol=1e-5)


def test_a_dead_fibre_is_scaled_to_finite_numbers() -> None:
    inputs = np.zeros((10, 2, 3))
    inputs[:, 0] = np.random.default_rng(0).standard_normal((10, 3))
    assert np.isfinite(Normalization.fit(raw(inputs), np.zeros((10, 2)))[0].inputs(raw(inputs)).inputs).all()


def test_a_fibre_that_was_never_there_is_scaled_to_finite_numbers() -> None:
    rng = np.random.default_rng(0)
    inputs = replace(raw(rng.standard_normal((10, 2, 3))), alive=np.tile([True, False], (10, 1)))
    scaling, table = Normalization.fit(inputs, rng.uniform(-9, 9, (10, 2)))
    assert np.isfinite(scaling.inputs(inputs).inputs).all()
    assert np.isfinite(table).all()


def test_a_fibre_that_varies_by_rounding_only_is_not_blown_up() -> None:
    inputs = 3.3 + 1e-15 * np.random.default_rng(0).standard_normal((10, 2, 3))
    scaling, _ = Normalization.fit(raw(inputs), np.zeros((10, 2)))
    assert (scaling.spread == 1).all()
