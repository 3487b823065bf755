"""The pad's response: a smooth map and a linear memory are found again from presses made of them."""

import numpy as np
import pytest

from sense.localizer.response.response_model import RIDGE_HISTORY, STEPS, ResponseModel, bumps, settled

FIBRES, PASTS, WINDOWS, FEW, PRESSES = 2, 3, 4, 1500, 60_000
"""Among so many presses the ridge takes next to nothing of a memory."""


def made(seed: int, noise: float) -> tuple[np.ndarray, ...]:
    """Places, windows, history and the memory of a pad that answers by sines of the place."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1, 1, (PRESSES, 2))
    history = rng.standard_normal((PRESSES, FIBRES, PASTS)) * [1.0, 0.1, 10.0] + 2
    memory = rng.standard_normal((FIBRES, PASTS, WINDOWS)) * np.array([1.0, 10.0, 0.1])[:, None]
    windows = answer(places) + np.einsum("qcj,cjf->qcf", history - history.mean(axis=0), memory)
    return places, windows + noise * rng.standard_normal(windows.shape), history, memory


def answer(places: np.ndarray) -> np.ndarray:
    x, y = places.T
    waves = [np.sin(2 * x + k) * np.cos((1 + k) * y) for k in range(FIBRES * WINDOWS)]
    return 0.5 * np.stack(waves, axis=1).reshape(len(places), FIBRES, WINDOWS)


def test_map_and_memory_are_found_again() -> None:
    places, windows, history, memory = made(0, noise=0.05)
    alive = np.ones((PRESSES, FIBRES), dtype=bool)
    found = ResponseModel.fit(places, windows, history, alive)
    spread = history.std(axis=0)[:, :, None]
    assert np.abs((found.memory - memory) * spread).max() < 0.02
    assert found.usual == pytest.approx(history.mean(axis=0))
    inner = slice(STEPS // 4, -STEPS // 4)
    grid = np.linspace(-1, 1, STEPS + 1)[inner]
    at = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    expected = answer(at.reshape(-1, 2)).reshape(len(grid), len(grid), FIBRES, WINDOWS)
    assert np.abs(found.table[inner, inner] - expected).max() < 0.06


def test_settled_windows_depend_on_the_place_only() -> None:
    places, windows, history, _ = made(1, noise=0.0)
    found = ResponseModel.fit(places, windows, history, np.ones((PRESSES, FIBRES), dtype=bool))
    left = settled(windows, history, found.memory, found.usual) - answer(places)
    assert np.abs(left).max() < 0.05 * np.abs(windows - answer(places)).max()


def test_gains_are_told_by_the_history() -> None:
    """Of a fibre that answers by 0.3 more for a spread of its history while the probe rests, by 0.1 when it left."""
    rng = np.random.default_rng(0)
    places, history = rng.uniform(-1, 1, (FEW, 2)), rng.standard_normal((FEW, FIBRES, PASTS))
    stronger = np.zeros((FIBRES, PASTS, WINDOWS))
    stronger[0, 0], stronger[0, 1] = [0.3, 0.3, 0.0, 0.0], [0.0, 0.0, 0.1, 0.1]
    windows = answer(places) * (1 + np.einsum("qcj,cjf->qcf", history, stronger))
    alive, phases = np.ones((FEW, FIBRES), dtype=bool), (slice(0, 2), slice(2, 4))
    found = ResponseModel.fit(places, windows, history, alive, phases=phases)
    assert found.table.shape[3] == WINDOWS + len(phases)
    assert not found.table[..., WINDOWS:].any()
    shown = settled(windows, history, found.memory, found.usual)
    assert shown.shape == (FEW, FIBRES, WINDOWS + len(phases))
    rested, left = shown[:, 0, WINDOWS:].T
    assert np.corrcoef(rested, history[:, 0, 0])[0, 1] > 0.95
    assert rested.std() == pytest.approx(FEW / (FEW + RIDGE_HISTORY) * 0.3, rel=0.15)
    assert np.corrcoef(left, history[:, 0, 1])[0, 1] > 0.8
    assert np.abs(shown[:, 1, WINDOWS:]).max() < 0.1


def test_a_fibre_learns_only_from_presses_in_which_it_lived() -> None:
    places, windows, history, _ = made(2, noise=0.1)
    alive = np.ones((PRESSES, FIBRES), dtype=bool)
    alive[::3, 0] = False
    before = ResponseModel.fit(places, windows, history, alive)
    windows[::3, 0], history[::3, 0] = 99.0, -99.0
    after = ResponseModel.fit(places, windows, history, alive)
    assert np.array_equal(before.table, after.table)
    assert np.array_equal(before.memory, after.memory)
    lived = alive[:, 0]
    left = settled(windows, history, after.memory, after.usual)[lived, 0] - answer(places)[lived, 0]
    assert np.sqrt((left**2).mean()) < 0.15  # noise is 0.1, and what memory shows about 3
    assert after.usual[0] == pytest.approx(history[lived, 0].mean(axis=0))
    middle = answer(np.zeros((1, 2)))[0]
    np.testing.assert_allclose(after.table[STEPS // 2, STEPS // 2], middle, atol=0.1)
    alive[:, 1] = False
    gone = ResponseModel.fit(places, windows, history, alive)
    assert not gone.table[:, :, 1].any()
    assert np.isfinite(gone.table).all()


def test_history_that_never_varied_tells_nothing() -> None:
    places, windows, history, _ = made(3, noise=0.1)
    history[:] = history[:1]
    found = ResponseModel.fit(places, windows, history, np.ones((PRESSES, FIBRES), dtype=bool))
    assert np.isfinite(found.memory).all()
    assert not found.memory.any()


def test_bumps_add_up_to_something_flat_within_the_pad() -> None:
    places = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 2))
    total = bumps(places).sum(axis=1)
    assert np.ptp(total) < 1e-2 * total.mean()


def test_answers_in_proportion_to_the_depth_are_one_table() -> None:
    """A fibre that answers 0.1 V per mm at any place, from presses of 1 to 4 mm, none of which is of 2 mm."""
    rng = np.random.default_rng(0)
    places, depths = rng.uniform(-1, 1, (600, 2)), rng.choice([1.0, 3.0, 4.0], 600)
    windows = (0.1 * depths)[:, None, None]
    model = ResponseModel.fit(places, windows, np.zeros((600, 1, 1)), np.ones((600, 1), bool), depths / 2)
    np.testing.assert_allclose(model.table[10:-10, 10:-10], 0.2, rtol=0.06)
    assert model.table.mean() == pytest.approx(0.2, rel=0.02)
