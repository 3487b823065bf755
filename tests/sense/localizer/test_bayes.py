"""The Bayesian localizer finds what least squares find of linear responses."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.localizer.bayes import N_SUMMARY, PRIOR_WEIGHT, BayesianLocalizer, fit_stages
from padforge.sense.localizer.features import N_FEATURES
from padforge.sense.localizer.moments import BAYES_STAGES, LATEST_WINDOWS, N_TIMED, bayes_stage
from padforge.sense.localizer.response_model import grid_positions

SIDE, FIBRES, WINDOWS, PRESSES, NOISE = 61, 4, 3, 2500, 0.05
Response = Callable[[np.ndarray], np.ndarray]


def linear(places: np.ndarray) -> np.ndarray:
    """(Q, 2) to (Q, C, F), by slopes of about 1."""
    slopes = np.random.default_rng(5).standard_normal((2, FIBRES * WINDOWS))
    return (places @ slopes).reshape(len(places), FIBRES, WINDOWS)


def waves(places: np.ndarray) -> np.ndarray:
    x, y = places.T
    parts = [np.sin((1 + 0.3 * k) * x + k) + np.cos((2 - 0.1 * k) * y + 2 * k) for k in range(FIBRES * WINDOWS)]
    return np.stack(parts, axis=1).reshape(len(places), FIBRES, WINDOWS)


def table_of(answer: Response) -> np.ndarray:
    return answer(grid_positions(SIDE).reshape(-1, 2)).reshape(SIDE, SIDE, FIBRES, WINDOWS).astype(np.float32)


def fit_bayes(answer: Response, noise: float = NOISE, seed: int = 0) -> "Fitted":
    """A Bayesian localizer of a pad of this response, with new presses: inputs and positions."""
    rng, table = np.random.default_rng(seed), table_of(answer)
    places = rng.uniform(-1, 1, (2 * PRESSES, 2))
    inputs = answer(places) + noise * rng.standard_normal((2 * PRESSES, FIBRES, WINDOWS))
    fibre_mask = np.ones((PRESSES, FIBRES), dtype=bool)
    bayes = BayesianLocalizer.fit(table, inputs[:PRESSES], fibre_mask, places[:PRESSES])
    return bayes, inputs[PRESSES:], places[PRESSES:]


Fitted = tuple[BayesianLocalizer, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def fitted_waves() -> Fitted:
    return fit_bayes(waves)


@pytest.fixture(scope="module")
def fitted_line() -> Fitted:
    return fit_bayes(linear)


@pytest.mark.parametrize("lost", [(), (0,), (1, 3), (0, 1, 2)])
def test_predict_solves_least_squares_of_linear_responses(fitted_line: Fitted, lost: tuple[int, ...]) -> None:
    bayes, inputs, places = fitted_line
    inner = (np.abs(places) < 0.7).all(axis=1)
    inputs, places = inputs[inner], places[inner]
    fibre_mask = np.ones((len(inputs), FIBRES), dtype=bool)
    fibre_mask[:, list(lost)] = False
    found, summary = bayes.predict(inputs, fibre_mask)
    kept = [fibre for fibre in range(FIBRES) if fibre not in lost]
    slopes = linear(np.eye(2))[:, kept].reshape(2, -1)
    solved = np.linalg.solve(slopes @ slopes.T, slopes @ inputs[:, kept].reshape(len(inputs), -1).T).T
    bound = NOISE**2 * np.diag(np.linalg.inv(slopes @ slopes.T))
    # What the grid tells counts a little besides, and the scatter is that of some hundred presses nearby.
    assert np.abs(found - solved).mean() < 0.2 * np.sqrt(bound.mean())
    assert np.sqrt(((found - places) ** 2).mean()) < 1.05 * np.sqrt(bound.mean())
    variance = np.exp(4 * (summary[:, 2:4] - 1)).mean(axis=0)
    np.testing.assert_allclose(variance, bound / (1 + PRIOR_WEIGHT), rtol=0.15)


def test_predict_spreads_over_positions_of_equal_response() -> None:
    """Fibres tell how far a press is from the middle, but not on which side."""

    def even(places: np.ndarray) -> np.ndarray:
        return linear(np.stack([np.square(places[:, 0]), places[:, 1]], axis=1))

    bayes, _, _ = fit_bayes(even)
    press = even(np.array([[0.6, 0.1]]))
    found, summary = bayes.predict(press, np.ones((1, FIBRES), dtype=bool))
    on_grid = np.exp(2 * (summary[0, 6:8] - 1))  # standard deviations
    assert abs(summary[0, 4]) / 2 < 0.1
    assert on_grid[0] == pytest.approx(0.6, rel=0.1)
    assert on_grid[1] < 0.1
    assert found[0, 1] == pytest.approx(0.1, abs=0.05)


@settings(max_examples=10)
@given(seed=st.integers(0, 999), size=st.sampled_from([0.1, 1.0, 1e4]))
def test_predict_ignores_masked_fibres_and_agrees_with_torch(fitted_waves: Fitted, seed: int, size: float) -> None:
    """Of presses of the pad; others, however large, are put somewhere on it by both."""
    bayes, inputs, _ = fitted_waves
    rng = np.random.default_rng(seed)
    fibre_mask = rng.random((20, FIBRES)) < 0.7
    press = inputs[rng.integers(len(inputs), size=20)].astype(np.float32)
    spoilt = np.where(fibre_mask[:, :, None], press, rng.choice([np.nan, np.inf, 1e4]))
    expected = bayes.predict(press.astype(np.float64), fibre_mask)
    for one, other in zip(expected, bayes.predict(spoilt, fibre_mask), strict=True):
        assert np.isfinite(one).all()
        assert np.array_equal(one, other)
    in_torch = bayes.map_arrays(torch.from_numpy)
    found, summary = in_torch.predict(torch.from_numpy(press), torch.from_numpy(fibre_mask), torch)
    np.testing.assert_allclose(found.numpy(), expected[0], atol=2e-3)
    np.testing.assert_allclose(summary.numpy(), expected[1], atol=1e-2)
    assert summary.shape == (20, N_SUMMARY)
    wild = (size * rng.standard_normal(press.shape)).astype(np.float32)
    for xp, one, values in ((np, bayes, wild.astype(np.float64)), (torch, in_torch, torch.from_numpy(wild))):
        place, about = one.predict(values, fibre_mask if xp is np else torch.from_numpy(fibre_mask), xp)
        assert np.abs(np.asarray(place)).max() <= 1 + 1e-6
        assert np.isfinite(np.asarray(about)).all()


def test_transformed_can_be_repeated(fitted_waves: Fitted) -> None:
    bayes, inputs, _ = fitted_waves
    turn, shift = np.array([[0.9, -0.2], [0.3, 1.1]]), np.array([0.1, -0.4])
    fibre_mask = np.ones((30, FIBRES), dtype=bool)
    place, summary = bayes.predict(inputs[:30], fibre_mask)
    moved, as_before = bayes.transformed(turn, shift).transformed(turn, shift).predict(inputs[:30], fibre_mask)
    np.testing.assert_allclose(moved, (place @ turn.T + shift) @ turn.T + shift, atol=1e-6)
    assert np.array_equal(summary, as_before)


def test_fit_stages_know_only_what_is_complete() -> None:
    """Neither later windows nor those of now move the position that a stage finds; the last one uses every window."""
    rng = np.random.default_rng(0)
    slopes = rng.standard_normal((2, 2 * N_FEATURES))
    table = (grid_positions(SIDE) @ slopes).reshape(SIDE, SIDE, 2, N_FEATURES).astype(np.float32)
    places = rng.uniform(-1, 1, (200, 2))
    inputs = (places @ slopes).reshape(200, 2, N_FEATURES) + NOISE * rng.standard_normal((200, 2, N_FEATURES))
    fibre_mask = np.ones((200, 2), dtype=bool)
    stages = fit_stages(table, inputs, fibre_mask, places, N_TIMED)
    assert len(stages) == len(BAYES_STAGES)
    for n_complete, stage in zip(BAYES_STAGES, stages, strict=True):
        spoilt = inputs.copy()
        spoilt[:, :, n_complete : N_TIMED + len(LATEST_WINDOWS)] = 77.0
        found, _ = stage.predict(spoilt, fibre_mask)
        assert np.array_equal(found, stage.predict(inputs, fibre_mask)[0])
        spoilt[:, :, n_complete - 1] = 77.0
        assert not np.array_equal(found, stage.predict(spoilt, fibre_mask)[0])
    assert len(fit_stages(table, inputs, fibre_mask, places, 0)) == 1
    # a press is answered by the latest that is complete
    assert [bayes_stage(count, N_TIMED) for count in range(N_TIMED + 1)] == [None] * 12 + [0, 1, 2, 3, 3, 4]
    assert bayes_stage(0, 0) == 0
