"""Networks and their training: outputs and gradients agree with torch, masks are bounded, positions are augmented."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from padforge.benchmarks import localizer as bench
from padforge.common.progress import ignore_progress
from padforge.sense.localizer import backpropagation, network, optimizer, training
from padforge.sense.localizer.features import N_FEATURES
from padforge.sense.localizer.moments import N_PRESS_WINDOWS, N_TIMED, PHASES, RESIDUAL_PHASE
from padforge.sense.localizer.press_sampler import PressSampler, sample_fibre_dropout
from padforge.sense.localizer.response_model import grid_positions, interpolate_grid
from padforge.sense.settings import LocalizerSettings as Options
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


def test_fit_network_returns_the_average_of_the_last_weights() -> None:
    """Of a quadratic with noisy gradients, the average is nearer to the minimum than single weights are."""
    rng, reports = np.random.default_rng(0), list[int]()
    parameters = optimizer.Parameters({"w": np.zeros(200, np.float32)})

    def backpropagate() -> None:
        parameters.gradient["w"][:] = (parameters.weights["w"] - 1 + 0.5 * rng.standard_normal(200)) / 100

    weights = optimizer.fit_network(
        parameters,
        backpropagate,
        1000,
        0.2,
        weight_decay=0.0,
        on_progress=lambda done, total, what: reports.append(done),
    )
    average, last = (np.square(each - 1).mean() for each in (weights["w"], parameters.weights["w"]))
    assert average < 0.7 * last < 0.05
    assert reports == list(range(1, optimizer.REPORTS + 1))
    assert [optimizer.one_cycle(share) for share in (0.0, 0.05, 0.1, 0.55, 1.0)] == pytest.approx([0, 0.5, 1, 0.5, 0])


def test_fit_network_takes_the_steps_of_cautious_adamw() -> None:
    goal, share = np.arange(15.0), np.linspace(0, 1, 51)[1:].tolist()
    parameters = optimizer.Parameters({"w": np.ones((3, 5), np.float32), "v": np.full(2, 9.0, np.float32)})
    w, v = parameters.weights.values()

    def gradient_at(weights: np.ndarray) -> np.ndarray:
        return np.concatenate([2 * (weights[:15] - goal) / 15, 2 * weights[15:]])

    def backpropagate() -> None:
        flat = gradient_at(np.concatenate([w.ravel(), v]))
        parameters.gradient["w"][:], parameters.gradient["v"][:] = flat[:15].reshape(3, 5), flat[15:]

    fitted = optimizer.fit_network(parameters, backpropagate, 50, 0.1, weight_decay=0.1)
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
    options = Options(hidden=8, layers=1, epochs=3, batch=16, members=members)
    totals: dict[str, set[int]] = {}

    def show(done: int, total: int, what: str) -> None:
        totals.setdefault(what, set()).add(total)

    trained = training.train_members(presses, table, options, rng, show)
    phases = PHASES[n_timed]
    lengths = [phase.length for phase in phases.values()] + [RESIDUAL_PHASE.length] * (members > 1)
    assert totals.pop("") == {sum(round(3 * training.MIN_BATCHES * length) for length in lengths)}
    assert list(totals) == ["Bayesian localizer"] * (members > 1)
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
    task = training.TrainingTask("released", PHASES[N_TIMED]["released"], Options(hidden=8, layers=1), 1)
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
    task = training.TrainingTask("released", PHASES[N_TIMED]["released"], options, 1)
    members = [training.Training(presses, table, task, seed) for seed in (0, 1)]
    old = network.stack_members([each.weights(each.network.parameters.weights) for each in members])
    assert len(network.unstack_members(old)) == 2
    for name, part in network.stack_members(network.unstack_members(old)).items():
        np.testing.assert_array_equal(part, old[name])
    monkeypatch.setattr(training, "RETRAINING_STEPS", 60)
    retrained, residual = training.retrain({"released": old}, {}, presses, table, 1, np.random.default_rng(3))
    assert (list(retrained), residual) == (["released"], {})
    mask = np.ones((60, 3), bool)
    x = network.network_inputs(inputs.astype(np.float32), mask, np.ones((60, N_TIMED), bool))
    before, after = (
        np.abs(network.forward(each, x)[:, :, :2] - positions).mean() for each in (old, retrained["released"])
    )
    assert after < 0.5 * before


@pytest.mark.slow
def test_every_way_trains_and_has_an_error(monkeypatch: pytest.MonkeyPatch, taken: Any) -> None:
    small = {"PRESSES": 150, "TEST": 30, "EPOCHS": (3,), "ITERATIONS": (20,), "PASSES": (1,), "STEPS": (3,)}
    for name, value in (small | {"HIDDEN": 6, "FEATURES": ("published", "windows")}).items():
        monkeypatch.setattr(bench, name, value)
    bench.recorded.cache_clear()
    errors = {key[:3]: row["error"] for key, row in taken(bench.BENCH).items() if row}
    bench.recorded.cache_clear()
    assert len(errors) == 4 + 3  # LM learns from published inputs alone
    assert all(0 < error < 30 for error in errors.values())  # mm on a pad of 34
