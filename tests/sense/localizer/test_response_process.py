"""The response by few presses: closed forms of a normal process, and which fibres are those of an earlier pad."""

import numpy as np
import pytest

from padforge.sense.localizer import response_process
from padforge.sense.localizer.response_model import GRID_CELLS, grid_positions, interpolate_grid
from padforge.sense.localizer.response_process import ResponsePrior, fit_response

SIDE, WINDOWS, PRESSES, FIBRES = GRID_CELLS + 1, 3, 40, 4


def make_maps(n_maps: int, seed: int) -> np.ndarray:
    """Random plane waves over the grid; shape (S, S, C, n)."""
    rng = np.random.default_rng(seed)
    waves = grid_positions(SIDE) @ rng.normal(0, 2, (2, FIBRES * n_maps)) + rng.uniform(0, 2 * np.pi, FIBRES * n_maps)
    return np.cos(waves).reshape(SIDE, SIDE, FIBRES, n_maps)


@pytest.fixture
def positions() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (PRESSES, 2))


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A single process, so that fits without a press have the same one."""
    for name, value in (("SNR_NEW", (30.0,)), ("KERNELS", ((1.0, 0.03),)), ("ROUNDS", 1)):
        monkeypatch.setattr(response_process, name, value)


def test_fit_response_finds_the_weights_of_its_maps(positions: np.ndarray) -> None:
    """Of twelve maps and noise of a fiftieth, forty presses leave a tenth of the response unexplained at most."""
    rng, maps = np.random.default_rng(1), make_maps(12, seed=2)
    truth = np.einsum("xycj,cjf->xycf", maps, rng.standard_normal((FIBRES, 12, WINDOWS)))
    windows = interpolate_grid(truth, positions)
    windows += 0.02 * windows.std() * rng.standard_normal(windows.shape)
    fit = fit_response(positions, windows, np.ones((PRESSES, FIBRES), bool), ResponsePrior(maps))
    assert (fit.table - truth).std() < 0.1 * truth.std()
    assert fit.is_new.all()
    # Presses of twice the depth respond twice as much.
    depth = np.linspace(0.5, 2, PRESSES)
    deep = fit_response(
        positions, depth[:, None, None] * windows, np.ones((PRESSES, FIBRES), bool), ResponsePrior(maps), depth
    )
    assert (deep.table - truth).std() < 0.1 * truth.std()


@pytest.mark.usefixtures("one_process")
def test_fit_response_is_the_posterior_mean_and_its_leverages_leave_presses_out(positions: np.ndarray) -> None:
    rng, maps = np.random.default_rng(3), make_maps(2, seed=4)
    windows, valid = rng.standard_normal((PRESSES, FIBRES, WINDOWS)), np.ones((PRESSES, FIBRES), bool)
    prior = ResponsePrior(maps)
    fit = fit_response(positions, windows, valid, prior)
    # The conditional mean of a normal distribution, of fibre 0 at one node of the grid.
    at, node = interpolate_grid(maps, positions)[:, 0], maps[10, 20, 0]
    squares = (((other - positions) ** 2).sum(axis=-1) for other in (positions[:, None], grid_positions(SIDE)[10, 20]))
    smooth, to_node = (0.03 * np.exp(-0.5 * each / response_process.REMAINDER_STD**2) for each in squares)
    covariance, cross = 30 * (at @ at.T + smooth), 30 * (at @ node + to_node)
    expected = cross @ np.linalg.solve(covariance + np.eye(PRESSES), windows[:, 0])
    np.testing.assert_allclose(fit.table[10, 20, 0], expected, atol=1e-9)
    # The residual over 1 - leverage is that of a fit without the press; its table is interpolated.
    without = fit_response(positions[1:], windows[1:], valid[1:], prior)
    left_out = windows[0] - interpolate_grid(without.table, positions[:1])[0]
    residual = windows[0] - interpolate_grid(fit.table, positions[:1])[0]
    np.testing.assert_allclose(residual / (1 - fit.leverage[0])[:, None], left_out, atol=0.02)


@pytest.mark.usefixtures("one_process")
def test_presses_at_one_position_count_once_and_masked_ones_not(positions: np.ndarray) -> None:
    rng, prior = np.random.default_rng(5), ResponsePrior(make_maps(2, seed=6))
    windows, valid = rng.standard_normal((PRESSES, FIBRES, WINDOWS)), np.ones((PRESSES, FIBRES), bool)
    once = fit_response(positions, windows, valid, prior)
    twice = fit_response(np.tile(positions, (2, 1)), np.tile(windows, (2, 1, 1)), np.tile(valid, (2, 1)), prior)
    np.testing.assert_allclose(twice.table, once.table, atol=1e-8)
    np.testing.assert_allclose(twice.leverage, np.tile(once.leverage, (2, 1)), atol=1e-8)
    valid[:9, 1], windows[:9, 1] = False, np.nan
    masked = fit_response(positions, windows, valid, prior)
    alone = fit_response(positions[9:], windows[9:], valid[9:], prior)
    np.testing.assert_allclose(masked.table[:, :, 1], alone.table[:, :, 1], atol=1e-12)
    np.testing.assert_allclose(masked.table[:, :, 0], once.table[:, :, 0], atol=1e-12)
    dead = fit_response(positions, windows, valid & (np.arange(FIBRES) != 1), prior)
    assert not dead.table[:, :, 1].any()
    assert dead.is_new.tolist() == [True, False, True, True]


def test_fit_response_tells_fibres_of_the_earlier_pad_from_new_ones(positions: np.ndarray) -> None:
    """Old fibres drifted by a tenth; a pad of which no more than half are old is another one."""
    rng, maps = np.random.default_rng(7), make_maps(12, seed=8)
    old, other = (np.einsum("xycj,cjf->xycf", maps, rng.standard_normal((FIBRES, 12, WINDOWS))) for _ in range(2))
    for new in ([], [2], [0, 1, 3]):
        truth = 1.1 * old
        truth[:, :, new] = other[:, :, new]
        windows = interpolate_grid(truth, positions)
        windows = windows * (1 + 0.1 * rng.standard_normal(windows.shape))
        fit = fit_response(positions, windows, np.ones((PRESSES, FIBRES), bool), ResponsePrior(maps, old))
        assert np.flatnonzero(fit.is_new).tolist() == (new if len(new) < 2 else [0, 1, 2, 3])
        assert (fit.table - truth).std() < 0.25 * truth.std()
