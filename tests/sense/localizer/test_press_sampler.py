"""What a training draws: moments of a phase, windows that are complete by then, fingers that slide or rest."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.sense.localizer import press_sampler
from padforge.sense.localizer.features import N_FEATURES
from padforge.sense.localizer.moments import LATEST_WINDOWS, N_PRESS_WINDOWS, N_TIMED, PHASES, PRESS_WINDOWS, Phase
from padforge.sense.localizer.press_sampler import PressSampler
from padforge.sense.localizer.response_model import grid_positions, interpolate_grid
from padforge.sense.localizer.scaler import FeatureScaler, TrainingPresses
from tests.helpers.constants import with_constants
from tests.helpers.presses import training_presses

PRESSES, FIBRES, SIDE, BATCH = 60, 2, 9, 400
SPEED = 1 / (20 * 13.3)  # scaled, of 1 mm/s at 13.3 readings a second
OF_NOW = slice(N_TIMED, N_TIMED + len(LATEST_WINDOWS))
LAST = [N_PRESS_WINDOWS - 1] * len(LATEST_WINDOWS)  # windows of the latest readings of a press that has rested


def make_presses(slopes: np.ndarray, level: float, noise: float) -> tuple[TrainingPresses, np.ndarray]:
    """Presses of a finger that rests on a pad of linear response, and the table of that."""
    rng = np.random.default_rng(0)
    level_of = level * rng.standard_normal((FIBRES, N_FEATURES))
    table = np.einsum("xyk,kcf->xycf", grid_positions(SIDE), slopes) + level_of
    targets = rng.uniform(-0.5, 0.5, (PRESSES, 2))
    inputs = interpolate_grid(table, targets)
    inputs += noise * rng.standard_normal(inputs.shape)
    for windows in (inputs, table):
        windows[..., OF_NOW] = windows[..., LAST]
    return training_presses(inputs, np.ones((PRESSES, FIBRES), bool), targets, N_TIMED, SPEED), table.astype(np.float32)


def waves() -> np.ndarray:
    """(2, C, F) slopes that differ from window to window."""
    return np.random.default_rng(1).standard_normal((2, FIBRES, N_FEATURES))


def draw(presses: TrainingPresses, table: np.ndarray, phase: Phase) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of presses, their features (B, C, F) where they were, and the masks (B, K) of complete windows."""
    sampler = PressSampler(presses, table, 0, np.random.default_rng(0), phase, ())
    rows = sampler.sample_rows(BATCH)
    x = sampler.inputs(rows, sampler.targets[rows], 0.0)[0]
    assert x.shape[1] == sampler.n_inputs
    features, mask, seen = np.split(x, [FIBRES * N_FEATURES, FIBRES * (N_FEATURES + 1)], axis=1)
    assert (mask == 1).all()
    return rows, features.reshape(BATCH, FIBRES, N_FEATURES), seen == 1


noiseless = with_constants((press_sampler, {"LATEST_NOISE": 0.0}))


@pytest.mark.parametrize("name", PHASES[N_TIMED])
def test_moments_are_those_of_the_phase(name: str) -> None:
    phase = PHASES[N_TIMED][name]
    _, features, seen = draw(*make_presses(waves(), 1.0, 0.1), phase)
    counts = seen.sum(axis=1)
    assert (seen == (np.arange(N_TIMED) < counts[:, None])).all()
    assert sorted(set(counts.tolist())) == [count for count in range(N_TIMED + 1) if count in phase]
    share = [(counts == phase.first + k).mean() for k in range(len(phase.shares))]
    assert share == pytest.approx(phase.shares, abs=4 * 0.5 / BATCH**0.5)
    assert not features[:, :, :N_TIMED][~np.broadcast_to(seen[:, None], (BATCH, FIBRES, N_TIMED))].any()


@pytest.mark.parametrize("count", [1, 8, N_PRESS_WINDOWS, N_PRESS_WINDOWS + 1, N_TIMED])
def test_windows_yet_to_come_have_no_influence(count: int) -> None:
    """Of the window that has begun, a reading may be the latest one."""
    presses, table = make_presses(waves(), 1.0, 0.1)
    spoilt = presses.inputs.copy()
    spoilt[:, :, count + 1 : N_TIMED] = np.nan
    _, before, _ = draw(presses, table, Phase(count, (1.0,)))
    _, after, _ = draw(replace(presses, inputs=spoilt), table, Phase(count, (1.0,)))
    assert np.array_equal(after, before)


@pytest.mark.parametrize("count", [1, 5, N_PRESS_WINDOWS])
def test_a_resting_finger_is_where_its_latest_windows_were(count: int) -> None:
    presses, table = make_presses(waves(), 1.0, 0.1)
    rng = np.random.default_rng(2)
    factor, offset = rng.standard_normal((2, FIBRES, len(LATEST_WINDOWS), N_PRESS_WINDOWS)).astype(np.float32)
    presses = replace(presses, latest_factor=factor, latest_offset=offset)
    rows, features, _ = draw(presses, table, Phase(count, (1.0,)))
    np.testing.assert_allclose(features[:, :, :count], presses.inputs[rows][:, :, :count], atol=1e-5)
    scaled = factor * presses.inputs[rows][:, :, None, :N_PRESS_WINDOWS] + offset
    latest = range(PRESS_WINDOWS[count - 1][1] - 1, PRESS_WINDOWS[min(count, N_PRESS_WINDOWS - 1)][1] - 1)
    window_of = [
        max(k for k, (first, _) in enumerate(PRESS_WINDOWS) if first <= max(reading, 1)) for reading in range(20)
    ]
    allowed = {(window_of[reading], window_of[reading - 1]) for reading in latest or [19]}
    found = np.zeros(BATCH, bool)
    for windows in allowed:
        expected = np.stack([scaled[:, :, back, window] for back, window in enumerate(windows)], axis=2)
        found |= np.isclose(features[:, :, OF_NOW], expected, atol=1e-4).all(axis=(1, 2))
    assert found.all()


@pytest.mark.parametrize("name", PHASES[N_TIMED])
@pytest.mark.parametrize("kind", ["speed 0", "response alike everywhere"])
def test_a_stroke_may_be_a_press_at_rest(monkeypatch: pytest.MonkeyPatch, name: str, kind: str) -> None:
    """If it goes nowhere, or where the response is the same."""
    if kind == "speed 0":
        monkeypatch.setattr(press_sampler, "SPEEDS_MM_S", (1e-9, 2e-9))
        presses, table = make_presses(waves(), 1.0, 0.1)
    else:
        presses, table = make_presses(0 * waves(), 1.0, 0.0)
    phase = PHASES[N_TIMED][name]
    found = [draw(presses, table, replace(phase, sliding=share))[1] for share in (0.0, 1.0)]
    np.testing.assert_allclose(found[1], found[0], atol=1e-4)


@pytest.mark.parametrize("count", [3, N_PRESS_WINDOWS, N_TIMED])
def test_a_stroke_goes_at_its_speed(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """All windows respond alike to where the finger is, so they tell where it was; it ends at the target."""
    monkeypatch.setattr(press_sampler, "SPEEDS_MM_S", (1.0, 2.0))
    presses, table = make_presses(np.eye(2)[:, :, None] * np.ones(N_FEATURES), 0.0, 0.0)
    rows, features, _ = draw(presses, table, Phase(count, (1.0,), sliding=1.0))
    times = np.array([(first + end - 1) / 2 for first, end in PRESS_WINDOWS])[1:count]
    step = np.diff(features[:, :, 1 : min(count, N_PRESS_WINDOWS)], axis=2) / np.diff(times[: N_PRESS_WINDOWS - 1])
    np.testing.assert_allclose(step, np.broadcast_to(step[:, :, :1], step.shape), atol=1e-4)
    speed = np.hypot(*step[:, :, 0].T) / SPEED
    assert (speed > 0.99).all()
    assert (speed < 2.01).all()
    np.testing.assert_allclose(features[:, :, N_TIMED], presses.targets[rows], atol=1e-4)
    latest = features[:, :, N_TIMED] - features[:, :, N_TIMED + 1]
    np.testing.assert_allclose(latest, step[:, :, 0], atol=1e-4)


def test_windows_of_a_press_become_windows_of_now() -> None:
    """What has the same voltage in both, each scaled by its own mean and deviation."""
    rng = np.random.default_rng(0)
    mean_v, scale_v = rng.standard_normal((FIBRES, N_FEATURES)), rng.uniform(0.5, 2, (FIBRES, N_FEATURES))
    history = np.zeros((FIBRES, 0, N_FEATURES)), np.zeros((FIBRES, 0))
    scaler = FeatureScaler(mean_v, scale_v, *history, np.zeros(2), 20.0, np.ones(2))
    volts = rng.standard_normal((FIBRES, N_PRESS_WINDOWS, 1))
    down = scaler.scale(np.broadcast_to(volts, (FIBRES, N_PRESS_WINDOWS, N_FEATURES)).swapaxes(0, 1))  # (windows, C, F)
    factor, offset = scaler.latest_window_map(N_TIMED)
    for window, scaled in enumerate(down):
        now = factor[:, :, window] * scaled[:, window, None] + offset[:, :, window]
        np.testing.assert_allclose(now, scaled[:, OF_NOW], atol=1e-5)
