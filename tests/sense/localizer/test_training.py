"""What a training draws, and the networks that it trains: outputs and gradients agree with torch, masks are bounded."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock, call, patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from padforge.benchmarks import localizer as bench
from padforge.common.progress import ignore_progress
from padforge.sense.localizer import backpropagation, network, optimizer, press_sampler, training
from padforge.sense.localizer.features import N_FEATURES
from padforge.sense.localizer.moments import (
    LATEST_WINDOWS,
    N_PRESS_WINDOWS,
    N_TIMED,
    PHASES,
    PRESS_WINDOWS,
    RESIDUAL_PHASE,
    Phase,
)
from padforge.sense.localizer.press_sampler import PressSampler, sample_fibre_dropout
from padforge.sense.localizer.response_model import grid_positions, interpolate_grid
from padforge.sense.localizer.scaler import FeatureScaler, TrainingPresses
from padforge.sense.settings import LocalizerSettings as Options
from tests.helpers.constants import with_constants
from tests.helpers.presses import training_presses


def forward_in_torch(weights: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """An oracle of `network.forward`."""

    def activate(h: torch.Tensor) -> torch.Tensor:
        return functional.relu(functional.layer_norm(h, (h.shape[-1],), eps=network.EPSILON))

    h = torch.baddbmm(weights["first.b"], x[None], weights["first.w"])
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + torch.baddbmm(b, activate(h), w)
    return torch.baddbmm(weights["last.b"], activate(h), weights["last.w"])


@settings(max_examples=10)
@given(
    seed=st.integers(0, 2**32 - 1), layers=st.integers(1, 4), n_inputs=st.integers(1, 40), n_measures=st.integers(0, 2)
)
def test_outputs_and_gradients_agree_with_torch(seed: int, layers: int, n_inputs: int, n_measures: int) -> None:
    rng, n_targets = np.random.default_rng(seed), 2 + n_measures
    options = Options(layers=layers, hidden=24)
    weights = backpropagation.random_weights(n_inputs, 2 * n_targets, options, rng)
    weights = {name: weight + rng.normal(0, 0.1, weight.shape).astype(np.float32) for name, weight in weights.items()}
    weights["last.b"][:, :, -1] = rng.choice([-20, 0, 20])  # log errors of the last target may be clipped
    x = rng.standard_normal((7, n_inputs), np.float32)
    targets = rng.standard_normal((7, n_targets), np.float32)
    in_torch = {name: torch.from_numpy(weight).requires_grad_() for name, weight in weights.items()}
    outputs = forward_in_torch(in_torch, torch.from_numpy(x))
    predicted, log_error = outputs[0].chunk(2, dim=1)
    error, log_error = predicted - torch.from_numpy(targets), log_error.clamp(-9, 2)
    rounding = (training.ROUNDING * log_error.detach().exp()[:, :2]).square()
    loss = (error[:, :2].square() + rounding).sum(dim=1).sqrt() + 0.5 * error[:, 2:].abs().sum(dim=1)
    loss = loss + 0.1 * (error.detach().abs() * (-log_error).exp() + log_error).sum(dim=1)
    loss.mean().backward()

    mlp = backpropagation.TrainableMlp(weights, 7)
    for _ in range(2):  # nothing remains of a batch
        mlp.backward(training.loss_gradient(mlp.forward(x), targets))
    for each in (mlp.forward(x), network.forward(weights, x)[0]):
        assert each.dtype == np.float32
        np.testing.assert_allclose(each, outputs[0].detach(), atol=3e-5)
    torch.testing.assert_close(network.forward(in_torch, torch.from_numpy(x), torch), outputs, atol=3e-5, rtol=0)
    for name, gradient in mlp.parameters.gradient.items():
        expected = in_torch[name].grad
        assert expected is not None
        np.testing.assert_allclose(gradient, expected, atol=1e-5 + 1e-4 * float(expected.abs().max()))


def test_combine_members_weighs_by_variance_and_adds_disagreement() -> None:
    outputs = np.zeros((2, 1, 4), dtype=np.float32)
    outputs[:, 0, 0] = [-0.3, 0.5]
    outputs[:, 0, 2:] = np.log(0.2)
    position, std = network.combine_members(outputs)
    assert position[0].tolist() == pytest.approx([0.1, 0.0])
    assert std[0].tolist() == pytest.approx([np.sqrt(2 * 0.04 + 0.16), np.sqrt(2 * 0.04)])
    outputs[1, 0, 2:] = np.log(0.4)  # a member that expects twice the error weighs a quarter
    position, std = network.combine_members(outputs)
    assert position[0].tolist() == pytest.approx([-0.14, 0.0])
    assert std[0].tolist() == pytest.approx([np.sqrt(0.8 * 0.1056 + 0.2 * 0.7296), np.sqrt(0.8 * 0.08 + 0.2 * 0.32)])


def test_fit_network_takes_the_steps_of_cautious_adamw_and_returns_averages() -> None:
    goal, share, reported = np.arange(15.0), np.linspace(0, 1, 51)[1:].tolist(), Mock()
    parameters = optimizer.Parameters({"w": np.ones((3, 5), np.float32), "v": np.full(2, 9.0, np.float32)})
    w, v = parameters.weights.values()

    def gradient_at(weights: np.ndarray) -> np.ndarray:
        return np.concatenate([2 * (weights[:15] - goal) / 15, 2 * weights[15:]])

    def backpropagate() -> None:
        flat = gradient_at(np.concatenate([w.ravel(), v]))
        parameters.gradient["w"][:], parameters.gradient["v"][:] = flat[:15].reshape(3, 5), flat[15:]

    fitted = optimizer.fit_network(parameters, backpropagate, 50, 0.1, weight_decay=0.1, on_progress=reported)
    expected, (first, second) = np.concatenate([np.ones(15), np.full(2, 9.0)]), optimizer.BETAS
    mean, square, average, resting = np.zeros(17), np.zeros(17), expected.copy(), 0
    for step, each in enumerate(share, 1):
        rate, gradient = 0.1 * optimizer.one_cycle(each), gradient_at(expected)
        mean = first * mean + (1 - first) * gradient  # Loshchilov and Hutter 2019, algorithm 2
        square = second * square + (1 - second) * gradient**2
        moves = mean * gradient > 0  # Liang et al. 2024, algorithm 2
        resting += (~moves).sum()
        expected -= rate * 0.1 * expected
        change = mean / (1 - first**step) / (np.sqrt(square / (1 - second**step)) + 1e-8)
        expected -= rate * change * moves / max(moves.mean(), 1e-3)
        average += 9 / (step + 9) * (expected - average)
    assert resting
    np.testing.assert_allclose(w, expected[:15].reshape(3, 5), rtol=1e-4)
    np.testing.assert_allclose(fitted["w"], average[:15].reshape(3, 5), rtol=1e-4)
    np.testing.assert_allclose(fitted["v"], average[15:], rtol=1e-4)
    assert (reported.call_count, reported.call_args) == (50, call(200, 200, ""))
    assert [optimizer.one_cycle(part) for part in (0.0, 0.05, 0.1, 0.55, 1.0)] == pytest.approx([0, 0.5, 1, 0.5, 0])


@settings(max_examples=20)
@given(fibres=st.integers(1, 9), max_failures=st.integers(0, 4), seed=st.integers(0, 99))
def test_sample_fibre_dropout_masks_up_to_max_failures(fibres: int, max_failures: int, seed: int) -> None:
    max_failures = min(max_failures, fibres - 1)
    fibre_mask = sample_fibre_dropout(800, fibres, max_failures, np.random.default_rng(seed))
    n_failed = (~fibre_mask).sum(axis=1)
    assert set(n_failed.tolist()) == set(range(max_failures + 1))


def test_train_members_reflects_augmented_positions_at_the_edge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of presses at the corners, half of a normal distribution remains on either axis.

    Four positions share 1 x 1.2, and so are sqrt(1.2 / 4) apart.
    """
    corners = np.tile(np.array([[-0.5, -0.6], [-0.5, 0.6], [0.5, -0.6], [0.5, 0.6]], dtype=np.float32), (64, 1))
    presses = training_presses(np.zeros((256, 1, 1)), np.ones((256, 1), bool), corners)
    augmented: list[np.ndarray] = []
    inputs = PressSampler.inputs

    def spy(sampler: PressSampler, rows: np.ndarray, targets: np.ndarray, noise: float) -> tuple:
        augmented.append(targets)
        return inputs(sampler, rows, targets, noise)

    monkeypatch.setattr(PressSampler, "inputs", spy)
    monkeypatch.setattr(training, "AUGMENTATION", 0.1)
    options = Options(members=1, hidden=8, layers=1, max_failures=0, batch=256, epochs=1)
    table = np.zeros((3, 3, 1, 1), np.float32)
    training.train_members(presses, table, options, np.random.default_rng(0), ignore_progress)
    inwards = np.abs(corners[0]) - np.abs(np.concatenate(augmented))
    assert inwards.min() >= -1e-6
    assert np.sqrt(np.square(inwards).mean(axis=0)) == pytest.approx([0.1 * (1.2 / 4) ** 0.5] * 2, rel=0.06)


@pytest.mark.parametrize(("n_timed", "members"), [(N_TIMED, 2), (N_TIMED, 1), (N_PRESS_WINDOWS, 1), (0, 2)])
def test_train_members_trains_a_network_for_each_phase(n_timed: int, members: int) -> None:
    """And, as the last of several members, one that corrects the Bayesian localizers."""
    rng = np.random.default_rng(0)
    table = rng.standard_normal((5, 5, 2, N_FEATURES)).astype(np.float32)
    positions = rng.uniform(-1, 1, (40, 2))
    presses = training_presses(np.zeros((40, 2, N_FEATURES)), np.ones((40, 2), bool), positions, n_timed)
    options, show = Options(hidden=8, layers=1, epochs=3, batch=16, members=members), Mock()
    trained = training.train_members(presses, table, options, rng, show)
    phases = PHASES[n_timed]
    lengths = [phase.length for phase in phases.values()] + [RESIDUAL_PHASE.length] * (members > 1)
    assert show.call_args.args[1:] == (sum(round(3 * training.MIN_BATCHES * length) for length in lengths), "")
    assert list(trained.networks) == list(phases)
    for weights in trained.networks.values():
        assert weights["first.w"].shape == (max(1, members - 1), 2 * (N_FEATURES + 1) + n_timed, 8)
    assert bool(trained.bayes) == bool(trained.residual_network) == (members > 1)


def test_inputs_are_scaled_down_in_training_alone() -> None:
    """Most where they vary most; the weights that a training returns are for inputs as they are."""
    rng = np.random.default_rng(0)
    table = np.zeros((3, 3, 4, N_FEATURES), np.float32)
    common = 5 * rng.standard_normal((200, 1, 1)) + 0.1 * rng.standard_normal((200, 4, N_FEATURES))
    presses = training_presses(common, np.ones((200, 4), bool), rng.uniform(-1, 1, (200, 2)), N_TIMED)
    task = training.TrainingTask("pressed", PHASES[N_TIMED]["pressed"], Options(hidden=8, layers=1), 1)
    trained = training.Training(presses, table, task, 0)
    x = np.concatenate([trained.sample_batch()[0] for _ in range(20)])
    scaled = trained.scale_down(x)
    before, after = (np.linalg.eigvalsh(each.T @ each / len(x)) for each in (x, scaled))
    assert before[-1] > 500
    assert after[-1] < 1.1
    np.testing.assert_allclose(after[:50], before[:50] / training.COMMON_SQUARE, rtol=1e-2, atol=1e-4)
    assert not ((scaled != 0) & (np.abs(scaled) < np.finfo(np.float32).tiny)).any()  # denormal numbers are slow
    weights = trained.network.parameters.weights
    expected = network.forward(weights, scaled)
    np.testing.assert_allclose(network.forward(trained.weights(weights), x), expected, atol=1e-4)
    # A training from these weights starts with a network that answers alike.
    further = training.Training(presses, table, replace(task, start=trained.weights(weights)), 1)
    answers = network.forward(further.network.parameters.weights, further.scale_down(x))
    np.testing.assert_allclose(answers, expected, atol=1e-3)


def test_retrain_follows_another_response_from_where_networks_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks are left out, or stay, as asked; one that is retrained errs less on the response of now."""
    rng = np.random.default_rng(0)
    table = np.tile((grid_positions(21) @ rng.normal(0, 1, (2, 3)))[..., None], N_FEATURES).astype(np.float32)
    positions = rng.uniform(-1, 1, (60, 2))
    inputs = interpolate_grid(table, positions)
    presses = training_presses(inputs, np.ones((60, 3), bool), positions, N_TIMED)
    options = Options(hidden=16, layers=1, members=2)
    task = training.TrainingTask("pressed", PHASES[N_TIMED]["pressed"], options, 1)
    members = [training.Training(presses, table, task, seed) for seed in (0, 1)]
    old = network.stack_members([each.weights(each.network.parameters.weights) for each in members])
    assert len(network.unstack_members(old)) == 2
    for name, part in network.stack_members(network.unstack_members(old)).items():
        np.testing.assert_array_equal(part, old[name])
    monkeypatch.setattr(training, "RETRAINING_STEPS", 60)
    retrained, residual = training.retrain({"pressed": old}, {}, presses, table, 1, np.random.default_rng(3))
    assert (list(retrained), residual) == (["pressed"], {})
    mask = np.ones((60, 3), bool)
    x = network.network_inputs(inputs.astype(np.float32), mask, np.ones((60, N_TIMED), bool))
    found = (network.forward(each, x)[:, :, :2] for each in (old, retrained["pressed"]))
    before, after = (np.abs(each - positions).mean() for each in found)
    assert after < 0.5 * before


@pytest.mark.slow
@patch.multiple(bench, PRESSES=150, TEST=30, EPOCHS=(3,), ITERATIONS=(20,), PASSES=(1,), STEPS=(3,), HIDDEN=6)
@patch.object(bench, "FEATURES", ("published", "windows"))
def test_every_way_trains_and_has_an_error(taken: Any) -> None:
    bench.recorded.cache_clear()
    errors = {key[:3]: row["error"] for key, row in taken(bench.BENCH).items() if row}
    bench.recorded.cache_clear()
    assert len(errors) == 4 + 3  # LM learns from published inputs alone
    assert all(0 < error < 30 for error in errors.values())  # mm on a pad of 34


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
