"""Networks and their training: NumPy agrees with torch, masks are bounded, positions are augmented."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.benchmarks import localizer as bench
from padforge.common.progress import ignore_progress
from padforge.sense.localizer import network, optimizer, training
from padforge.sense.localizer.features import N_FEATURES
from padforge.sense.localizer.moments import N_PRESS_WINDOWS, N_TIMED, PHASES, RESIDUAL_PHASE
from padforge.sense.localizer.press_sampler import PressSampler, sample_fibre_dropout
from padforge.sense.localizer.response_model import grid_positions, interpolate_grid
from padforge.sense.localizer.torch_network import EnsembleMlp
from padforge.sense.settings import LocalizerSettings as Options
from tests.helpers.presses import training_presses


def parameters(ensemble: EnsembleMlp) -> dict[str, np.ndarray]:
    return {name: weight.detach().numpy() for name, weight in ensemble.named_parameters()}


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1), layers=st.integers(1, 4), n_timed=st.integers(0, 5))
def test_forward_agrees_with_torch(seed: int, layers: int, n_timed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    ensemble = EnsembleMlp.random(3 * 5 + 3 + n_timed, 4, Options(layers=layers, hidden=24), generator)
    features = torch.randn(7, 3, 5, generator=generator)
    fibre_mask = torch.rand(7, 3, generator=generator) < 0.6
    seen = torch.rand(7, n_timed, generator=generator) < 0.6
    x = network.network_inputs(features, fibre_mask, seen, torch)
    expected = ensemble(x[None]).detach().numpy()
    weights = EnsembleMlp.join(parameters(ensemble))
    inputs = network.network_inputs(features.numpy(), fibre_mask.numpy(), seen.numpy())
    np.testing.assert_array_equal(inputs, x.numpy())
    outputs = network.forward(weights, inputs)
    assert outputs.dtype == np.float32
    np.testing.assert_allclose(outputs, expected, atol=2e-5)
    torch.testing.assert_close(EnsembleMlp.from_numpy(weights)(x[None]), ensemble(x[None]))


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
    torch.manual_seed(0)
    reports: list[int] = []
    w = torch.zeros(200, requires_grad=True)
    weights = optimizer.fit_network(
        {"w": w},
        lambda: ((w - 1 + 0.5 * torch.randn(200)) ** 2).mean(),
        1000,
        0.05,
        weight_decay=0.0,
        on_progress=lambda done, total, what: reports.append(done),
    )
    average, last = (np.square(each - 1).mean() for each in (weights["w"], w.detach().numpy()))
    assert average < 0.8 * last < 0.05
    assert np.float64(5e-324) * 1.0 > 0  # denormal numbers are there again after a training
    assert reports == list(range(1, optimizer.REPORTS + 1))
    assert [optimizer.one_cycle(share) for share in (0.0, 0.05, 0.1, 0.55, 1.0)] == pytest.approx([0, 0.5, 1, 0.5, 0])


def test_fit_network_takes_the_steps_of_cautious_adamw() -> None:
    """Also for weights whose gradients come in another order in memory, and for several of them."""
    goal, share = torch.arange(15.0).reshape(5, 3), torch.linspace(0, 1, 51)[1:].tolist()

    def loss(w: torch.Tensor) -> torch.Tensor:
        return torch.einsum("ij,jk->ik", w.mT, torch.eye(3)).sub(goal).square().mean()

    w, v = torch.ones(3, 5, requires_grad=True), torch.full((2,), 9.0, requires_grad=True)
    parameters = {"w": w, "v": v}
    fitted = optimizer.fit_network(parameters, lambda: loss(w) + v.square().sum(), 50, 0.1, weight_decay=0.1)
    expected, (first, second) = np.concatenate([np.ones(15), np.full(2, 9.0)]), optimizer.BETAS
    mean, square, average, resting = np.zeros(17), np.zeros(17), expected.copy(), 0
    for step, each in enumerate(share, 1):
        rate = 0.1 * optimizer.one_cycle(each)
        gradient = np.concatenate([2 * (expected[:15] - goal.numpy().T.ravel()) / 15, 2 * expected[15:]])
        mean = first * mean + (1 - first) * gradient  # Loshchilov and Hutter 2019, algorithm 2
        square = second * square + (1 - second) * gradient**2
        moves = mean * gradient > 0  # Liang et al. 2024, algorithm 2
        resting += (~moves).sum()
        expected -= rate * 0.1 * expected
        change = mean / (1 - first**step) / (np.sqrt(square / (1 - second**step)) + 1e-8)
        expected -= rate * change * moves / max(moves.mean(), 1e-3)
        average += 9 / (step + 9) * (expected - average)
    assert resting
    np.testing.assert_allclose(w.detach().numpy(), expected[:15].reshape(3, 5), rtol=1e-4)
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
    x = torch.from_numpy(np.concatenate([trained.sample_batch()[0] for _ in range(20)], axis=1))
    scaled = trained.scale_down(x)
    squares = torch.linalg.eigvalsh(scaled[0].T @ scaled[0] / x.shape[1])
    assert torch.linalg.eigvalsh(x[0].T @ x[0] / x.shape[1])[-1] > 500
    assert squares[-1] < 1.1
    small = torch.linalg.eigvalsh(x[0].T @ x[0] / x.shape[1])[:50]
    torch.testing.assert_close(squares[:50], small / training.COMMON_SQUARE, rtol=1e-2, atol=1e-4)
    weights = parameters(trained.network)
    expected = trained.network(scaled).detach().numpy()
    np.testing.assert_allclose(network.forward(trained.weights(weights), x[0].numpy()), expected, atol=1e-4)
    # A training from these weights starts with a network that answers alike.
    further = training.Training(presses, table, replace(task, start=trained.weights(weights)), 1)
    answers = further.network(further.scale_down(x)).detach().numpy()
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
    old = network.stack_members([each.weights(parameters(each.network)) for each in members])
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


@pytest.mark.parametrize(("capabilities", "tolerance"), [({"avx512_bf16": True}, 0.05), ({"avx512_bf16": False}, 0.0)])
def test_forward_bfloat16_is_near_single_precision(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool], tolerance: float
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    generator = torch.Generator().manual_seed(0)
    ensemble = EnsembleMlp.random(30, 4, Options(), generator)
    x = torch.randn(1, 64, 30, generator=generator)
    results = []
    for outputs in (ensemble(x), ensemble.forward_bfloat16(x)):
        results.append([outputs, *torch.autograd.grad(outputs.square().sum(), list(ensemble.parameters()))])
    for exact, fast in zip(*results, strict=True):
        assert fast.dtype == torch.float32
        assert torch.linalg.vector_norm(exact - fast) <= tolerance * torch.linalg.vector_norm(exact)
    assert all(map(torch.equal, *results)) == (not tolerance)


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
