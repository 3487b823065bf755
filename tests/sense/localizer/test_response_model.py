"""The response model recovers a smooth response and a linear history; by few presses, with priors, a normal process."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Contact, Morphology
from padforge.sense.localizer import response_process
from padforge.sense.localizer.response_model import (
    GRID_CELLS,
    RIDGE_HISTORY,
    RIDGE_MODULATION,
    ResponseModel,
    grid_positions,
    interpolate_grid,
    remove_history,
)
from padforge.sense.localizer.response_priors import map_prior, plan_prior, planned_pad, stated_contact
from padforge.sense.localizer.response_process import ResponsePrior, fit_response
from padforge.sense.localizer.scaler import leave_one_out_residuals
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.built_pad import build_pad, press_contacts
from tests.helpers.presses import training_presses

FIBRES, PASTS, WINDOWS, FEW, PRESSES = 2, 3, 4, 1500, 9000
Made = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def answer(places: np.ndarray) -> np.ndarray:
    x, y = places.T
    waves = [np.sin(2 * x + k) * np.cos((1 + k) * y) for k in range(FIBRES * WINDOWS)]
    return 0.5 * np.stack(waves, axis=1).reshape(len(places), FIBRES, WINDOWS)


@pytest.fixture
def made() -> Made:
    """Places, windows with noise, history and the memory of a pad that answers by sines of the place."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (PRESSES, 2))
    history = rng.standard_normal((PRESSES, FIBRES, PASTS)) * [1.0, 0.1, 10.0] + 2
    memory = rng.standard_normal((FIBRES, PASTS, WINDOWS)) * np.array([0.3, 3.0, 0.03])[:, None]
    windows = answer(places) + np.einsum("qcj,cjf->qcf", history - history.mean(axis=0), memory)
    return places, windows + 0.05 * rng.standard_normal(windows.shape), history, memory


def test_fit_recovers_response_and_history(made: Made) -> None:
    places, windows, history, memory = made
    found = ResponseModel.fit(places, windows, history, np.ones((PRESSES, FIBRES), dtype=bool))
    spread = history.std(axis=0)[:, :, None]
    kept = PRESSES / (PRESSES + RIDGE_HISTORY)  # the rest is the ridge's
    assert np.abs((found.history_coef - kept * memory) * spread).max() < 0.02
    assert found.history_mean_v == pytest.approx(history.mean(axis=0))
    inner = slice(GRID_CELLS // 4, -GRID_CELLS // 4)
    expected = answer(grid_positions(GRID_CELLS + 1).reshape(-1, 2)).reshape(found.table.shape)
    assert np.abs(found.table - expected)[inner, inner].max() < 0.08
    # windows without history depend on the place only
    left = remove_history(windows, history, found.history_coef / kept, found.history_mean_v) - answer(places)
    assert left.std() < 0.06
    history[:] = history[:1]  # which tells nothing then
    still = ResponseModel.fit(places[:500], windows[:500], history[:500], np.ones((500, FIBRES), dtype=bool))
    assert not still.history_coef.any()


def test_fit_recovers_sensitivity_modulation_and_depth() -> None:
    """A fibre answers by 0.3 more for a spread of its history while the probe rests, by 0.1 when it left.

    Another one answers 0.1 V per mm at any place, to presses of 1 to 4 mm, none of which is of 2 mm.
    """
    rng = np.random.default_rng(0)
    places, history = rng.uniform(-1, 1, (FEW, 2)), rng.standard_normal((FEW, FIBRES, PASTS))
    stronger = np.zeros((FIBRES, PASTS, WINDOWS))
    stronger[0, 0], stronger[0, 1] = [0.3, 0.3, 0.0, 0.0], [0.0, 0.0, 0.1, 0.1]
    windows = answer(places) * (1 + np.einsum("qcj,cjf->qcf", history, stronger))
    fibre_mask, phases = np.ones((FEW, FIBRES), dtype=bool), (slice(0, 2), slice(2, 4))
    found = ResponseModel.fit(places, windows, history, fibre_mask, phases=phases)
    assert found.table.shape[3] == WINDOWS + len(phases)
    assert not found.table[..., WINDOWS:].any()
    shown = remove_history(windows, history, found.history_coef, found.history_mean_v)
    assert shown.shape == (FEW, FIBRES, WINDOWS + len(phases))
    rested, left = shown[:, 0, WINDOWS:].T
    assert np.corrcoef(rested, history[:, 0, 0])[0, 1] > 0.95
    assert rested.std() == pytest.approx(FEW / (FEW + RIDGE_MODULATION) * 0.3, rel=0.15)
    assert np.corrcoef(left, history[:, 0, 1])[0, 1] > 0.8
    assert np.abs(shown[:, 1, WINDOWS:]).max() < 0.1
    rng = np.random.default_rng(0)
    places, depths = rng.uniform(-1, 1, (600, 2)), rng.choice([1.0, 3.0, 4.0], 600)
    windows = (0.1 * depths)[:, None, None]
    model = ResponseModel.fit(places, windows, np.zeros((600, 1, 1)), np.ones((600, 1), bool), depths / 2)
    np.testing.assert_allclose(model.table[10:-10, 10:-10], 0.2, rtol=0.06)
    assert model.table.mean() == pytest.approx(0.2, rel=0.02)


def test_fit_ignores_masked_presses(made: Made) -> None:
    places, windows, history, _ = (part[:FEW] for part in made)
    fibre_mask = np.ones((FEW, FIBRES), dtype=bool)
    fibre_mask[::3, 0] = False
    before = ResponseModel.fit(places, windows, history, fibre_mask)
    windows[::3, 0], history[::3, 0] = 99.0, -99.0
    after = ResponseModel.fit(places, windows, history, fibre_mask)
    assert np.array_equal(before.table, after.table)
    assert np.array_equal(before.history_coef, after.history_coef)
    assert after.history_mean_v[0] == pytest.approx(history[fibre_mask[:, 0], 0].mean(axis=0))
    fibre_mask[:, 1] = False
    gone = ResponseModel.fit(places, windows, history, fibre_mask)
    assert not gone.table[:, :, 1].any()
    assert np.isfinite(gone.table).all()


@settings(max_examples=20)
@given(seed=st.integers(0, 999), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_interpolate_grid_is_bilinear(seed: int, x: float, y: float) -> None:
    """Against a bilinear function, which linear interpolation gives exactly; of tables of any further axes."""
    a, b, c, d = np.random.default_rng(seed).standard_normal(4)
    u, v = np.moveaxis(grid_positions(9), 2, 0)
    table = (a + b * u + c * v + d * u * v)[:, :, None, None] * np.array([[1.0], [2.0]])
    found = interpolate_grid(table, np.array([[x, y], [-x, y]]))
    assert found[0, :, 0] == pytest.approx((a + b * x + c * y + d * x * y) * np.array([1, 2]), abs=4e-3)
    assert found.shape == (2, 2, 1)


def pressed() -> tuple[np.ndarray, np.ndarray]:
    """Places that the table has an entry for, some of them pressed twice, and what fibres gave there."""
    rng = np.random.default_rng(0)
    places = rng.integers(-GRID_CELLS // 2, GRID_CELLS // 2, (90, 2)) / (GRID_CELLS / 2)
    places[1::9] = places[0::9]
    return places, np.sin(3 * places[:, :1, None] + np.arange(3)) + rng.standard_normal((90, FIBRES, 3))


def table_of(places: np.ndarray, windows: np.ndarray) -> np.ndarray:
    nothing, fibre_mask = np.empty((len(places), FIBRES, 0)), np.ones((len(places), FIBRES), dtype=bool)
    return ResponseModel.fit(places, windows, nothing, fibre_mask).table.astype(np.float32)


def test_leave_one_out_residuals_are_those_of_fits_without_them() -> None:
    places, windows = pressed()
    fibre_mask = np.ones((90, FIBRES), dtype=bool)
    table = table_of(places, windows)
    presses = training_presses(windows, fibre_mask, places)
    rest = leave_one_out_residuals(presses, table).inputs - interpolate_grid(table, places)
    for press in (0, 4, 17):
        others = (places != places[press]).any(axis=1)
        expected = interpolate_grid(table_of(places[others], windows[others]), places[[press]])[0]
        same = (places == places[press]).all(axis=1)
        # Of several presses at one place, left out together, their mean stands to the table as each of them does here.
        np.testing.assert_allclose(rest[same].mean(axis=0), windows[same].mean(axis=0) - expected, atol=0.02, rtol=0.02)
    # What no table expects is left as it was.
    more = np.pad(windows, ((0, 0), (0, 0), (0, 1)), constant_values=0.7).astype(np.float32)
    padded = np.pad(table, ((0, 0), (0, 0), (0, 0), (0, 1)))
    found = leave_one_out_residuals(training_presses(more, fibre_mask, places), padded).inputs
    assert np.array_equal(found[:, :, -1], more[:, :, -1])


SIDE = GRID_CELLS + 1


def unexplained(maps: np.ndarray, deviations: np.ndarray) -> float:
    """Share of the variance of maps (S, S) that no sum of deviations (S, S, J) explains, with a slight ridge."""
    a, y = deviations.reshape(SIDE * SIDE, -1), maps.ravel()
    weights = np.linalg.solve(a.T @ a + 0.1 * np.eye(a.shape[1]), a.T @ y)
    return float((y - a @ weights).var() / y.var())


@pytest.mark.parametrize("path_mm", [0.0, 1.0])
def test_plan_prior_spans_pads_as_built(path_mm: float) -> None:
    """Uneven sensitivities are linear in it; paths beside their plan nearly so."""
    pad, rig, scale_mm = Morphology.random(2, knots=3, seed=5), RigSettings(path_mm=path_mm), 11.0
    contact, origin_mm = Contact(), np.array([1.0, -0.5])
    prior = plan_prior(pad, contact, origin_mm, scale_mm)
    positions_mm = grid_positions(SIDE).reshape(-1, 2) * scale_mm + origin_mm
    parts = build_pad(pad, rig).stretch(positions_mm, press_contacts(contact, rig))
    for fibre in range(4):
        shares = [unexplained(part[:, fibre].reshape(SIDE, SIDE), prior.deviations[:, :, fibre]) for part in parts]
        assert max(shares) < (0.02 if path_mm == 0 else 0.05)
        others = unexplained(parts.held[:, fibre].reshape(SIDE, SIDE), prior.deviations[:, :, (fibre + 2) % 4])
        assert others > 10 * shares[0]  # they are no maps of just anything
    variance = (prior.deviations**2).sum(axis=3)
    assert 1 <= variance.max() < 10  # of some unit, wherever it is largest


def test_map_prior_scales_maps_smoothly() -> None:
    rng, x = np.random.default_rng(0), grid_positions(SIDE)
    maps = np.exp(-0.5 * (x[..., :1] / 0.3) ** 2)[..., None] * np.array([1.0, -0.4])
    prior = map_prior(maps)
    assert prior.mean is maps
    scaled = maps[:, :, 0, 0] * (1 + 0.5 * np.sin(2 * x[..., 1] + rng.uniform(0, 6)))
    assert unexplained(scaled, prior.deviations[:, :, 0]) < 0.01
    assert unexplained(np.roll(scaled, SIDE // 2, axis=0), prior.deviations[:, :, 0]) > 0.3
    assert np.isfinite(map_prior(np.zeros((SIDE, SIDE, 1, 2))).deviations).all()  # of a fibre that was dead


def test_planned_pad_is_the_one_of_the_recording_unless_told(recording: Recording) -> None:
    plan = planned_pad(recording)
    assert plan is not None
    assert len(plan.knots) == recording.fibres
    assert stated_contact(recording) == Contact()
    foreign = replace(recording, source={})
    assert planned_pad(foreign) is None
    assert planned_pad(foreign, plan) is plan
    assert planned_pad(replace(recording, source={**recording.source, "twin": {}})) is None


N_WINDOWS, N_PRESSES, N_FIBRES = 3, 40, 4


def make_maps(n_maps: int, seed: int) -> np.ndarray:
    """Random plane waves over the grid; shape (S, S, C, n)."""
    rng = np.random.default_rng(seed)
    waves = grid_positions(SIDE) @ rng.normal(0, 2, (2, N_FIBRES * n_maps))
    return np.cos(waves + rng.uniform(0, 2 * np.pi, N_FIBRES * n_maps)).reshape(SIDE, SIDE, N_FIBRES, n_maps)


@pytest.fixture
def positions() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (N_PRESSES, 2))


one_process = patch.multiple(response_process, SNR_NEW=(30.0,), KERNELS=((1.0, 0.03),), ROUNDS=1)
"""A single process, so that fits without a press have the same one."""


@one_process
def test_fit_response_is_the_posterior_mean_and_its_leverages_leave_presses_out(positions: np.ndarray) -> None:
    rng, maps = np.random.default_rng(3), make_maps(2, seed=4)
    windows, valid = rng.standard_normal((N_PRESSES, N_FIBRES, N_WINDOWS)), np.ones((N_PRESSES, N_FIBRES), bool)
    prior = ResponsePrior(maps)
    fit = fit_response(positions, windows, valid, prior)
    # The conditional mean of a normal distribution, of fibre 0 at one node of the grid.
    at, node = interpolate_grid(maps, positions)[:, 0], maps[10, 20, 0]
    squares = (((other - positions) ** 2).sum(axis=-1) for other in (positions[:, None], grid_positions(SIDE)[10, 20]))
    smooth, to_node = (0.03 * np.exp(-0.5 * each / response_process.REMAINDER_STD**2) for each in squares)
    covariance, cross = 30 * (at @ at.T + smooth), 30 * (at @ node + to_node)
    expected = cross @ np.linalg.solve(covariance + np.eye(N_PRESSES), windows[:, 0])
    np.testing.assert_allclose(fit.table[10, 20, 0], expected, atol=1e-9)
    # The residual over 1 - leverage is that of a fit without the press; its table is interpolated.
    without = fit_response(positions[1:], windows[1:], valid[1:], prior)
    left_out = windows[0] - interpolate_grid(without.table, positions[:1])[0]
    residual = windows[0] - interpolate_grid(fit.table, positions[:1])[0]
    np.testing.assert_allclose(residual / (1 - fit.leverage[0])[:, None], left_out, atol=0.02)


@one_process
def test_presses_at_one_position_count_once_and_masked_ones_not(positions: np.ndarray) -> None:
    rng, prior = np.random.default_rng(5), ResponsePrior(make_maps(2, seed=6))
    windows, valid = rng.standard_normal((N_PRESSES, N_FIBRES, N_WINDOWS)), np.ones((N_PRESSES, N_FIBRES), bool)
    once = fit_response(positions, windows, valid, prior)
    twice = fit_response(np.tile(positions, (2, 1)), np.tile(windows, (2, 1, 1)), np.tile(valid, (2, 1)), prior)
    np.testing.assert_allclose(twice.table, once.table, atol=1e-8)
    np.testing.assert_allclose(twice.leverage, np.tile(once.leverage, (2, 1)), atol=1e-8)
    valid[:9, 1], windows[:9, 1] = False, np.nan
    masked = fit_response(positions, windows, valid, prior)
    alone = fit_response(positions[9:], windows[9:], valid[9:], prior)
    np.testing.assert_allclose(masked.table[:, :, 1], alone.table[:, :, 1], atol=1e-12)
    np.testing.assert_allclose(masked.table[:, :, 0], once.table[:, :, 0], atol=1e-12)
    dead = fit_response(positions, windows, valid & (np.arange(N_FIBRES) != 1), prior)
    assert not dead.table[:, :, 1].any()
    assert dead.is_new.tolist() == [True, False, True, True]


def test_fit_response_tells_fibres_of_the_earlier_pad_from_new_ones(positions: np.ndarray) -> None:
    """Old fibres drifted by a tenth; a pad of which no more than half are old is another one."""
    rng, maps = np.random.default_rng(7), make_maps(12, seed=8)
    old, other = (np.einsum("xycj,cjf->xycf", maps, rng.standard_normal((N_FIBRES, 12, N_WINDOWS))) for _ in range(2))
    for new in ([], [2], [0, 1, 3]):
        truth = 1.1 * old
        truth[:, :, new] = other[:, :, new]
        windows = interpolate_grid(truth, positions)
        windows = windows * (1 + 0.1 * rng.standard_normal(windows.shape))
        fit = fit_response(positions, windows, np.ones((N_PRESSES, N_FIBRES), bool), ResponsePrior(maps, old))
        assert np.flatnonzero(fit.is_new).tolist() == (new if len(new) < 2 else [0, 1, 2, 3])
        assert (fit.table - truth).std() < 0.25 * truth.std()
