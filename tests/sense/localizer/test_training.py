"""Networks and their training: NumPy says what torch says, masks lose no more than they may, presses are moved."""

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.localizer import network, training
from padforge.sense.localizer import training as masked_network
from padforge.sense.localizer.features import TrainingPresses, interpolate_grid
from padforge.sense.localizer.training import sample_fibre_dropout
from padforge.sense.settings import Features
from padforge.sense.settings import LocalizerSettings as Options


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1), layers=st.integers(1, 4))
def test_numpy_and_torch_agree(seed: int, layers: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    weights = masked_network.initial(3 * 5 + 3, Options(layers=layers, hidden=24), generator)
    inputs = torch.randn(7, 3, 5, generator=generator)
    fibre_mask = torch.rand(7, 3, generator=generator) < 0.6
    expected = masked_network.forward(weights, masked_network.masked(inputs, fibre_mask)[None]).detach().numpy()
    plain = {name: weight.detach().numpy() for name, weight in weights.items()}
    found = network.forward(plain, network.masked(inputs.numpy(), fibre_mask.numpy()))
    assert found.dtype == np.float32
    assert np.allclose(found, expected, atol=2e-5)


def test_the_spread_of_members_adds_to_what_they_expect() -> None:
    outputs = np.zeros((2, 1, 4), dtype=np.float32)
    outputs[:, 0, 0] = [-0.3, 0.5]
    outputs[:, 0, 2:] = np.log(0.2)
    place, sd = network.pooled(outputs)
    assert place[0].tolist() == pytest.approx([0.1, 0.0])
    assert sd[0].tolist() == pytest.approx([np.sqrt(2 * 0.04 + 0.16), np.sqrt(2 * 0.04)])
    outputs[1, 0, 2:] = np.log(0.4)  # a member that is half as sure counts for a quarter
    place, sd = network.pooled(outputs)
    assert place[0].tolist() == pytest.approx([-0.14, 0.0])
    assert sd[0].tolist() == pytest.approx([np.sqrt(0.8 * 0.1056 + 0.2 * 0.7296), np.sqrt(0.8 * 0.08 + 0.2 * 0.32)])


@settings(max_examples=20)
@given(fibres=st.integers(1, 9), lost=st.integers(0, 4), seed=st.integers(0, 99))
def test_training_masks_lose_no_more_than_they_may(fibres: int, lost: int, seed: int) -> None:
    lost = min(lost, fibres - 1)
    fibre_mask = sample_fibre_dropout(800, fibres, lost, torch.Generator().manual_seed(seed))
    gone = (~fibre_mask).sum(dim=1)
    assert gone.max() <= lost
    assert set(gone.unique().tolist()) == set(range(lost + 1))


def test_presses_moved_over_the_edge_are_sent_back_by_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of presses at the corners of the known places, half of a normal distribution remains on either axis.

    Four places have 1 x 1.2 to share, and so are sqrt(1.2 / 4) apart.
    """
    corners = np.tile(np.array([[-0.5, -0.6], [-0.5, 0.6], [0.5, -0.6], [0.5, 0.6]], dtype=np.float32), (64, 1))
    samples = TrainingPresses(np.zeros((256, 1, 1), np.float32), np.ones((256, 1), bool), corners)
    seen: list[torch.Tensor] = []

    def spy(table: torch.Tensor, places: torch.Tensor, xp: ModuleType) -> torch.Tensor:
        seen.append(places)
        return interpolate_grid(table, places, xp)

    monkeypatch.setattr(masked_network, "interpolate_grid", spy)
    options = Options(members=1, hidden=8, layers=1, max_failures=0, batch=256, epochs=1)
    monkeypatch.setattr(training, "MOVED", 0.1)
    table = np.zeros((3, 3, 1, 1), np.float32)
    training.train_members(samples, table, options, np.random.default_rng(0), lambda done, total: None)
    inwards = np.abs(corners[0]) - torch.cat(seen[1:]).abs().cpu().numpy()
    assert inwards.min() >= -1e-6
    assert np.sqrt(np.square(inwards).mean(axis=0)) == pytest.approx([0.1 * (1.2 / 4) ** 0.5] * 2, rel=0.06)


@pytest.mark.parametrize(("features", "longer"), [("press_and_release", 1), ("causal", 2), ("onset", 2)])
def test_without_the_release_networks_learn_for_twice_as_many_steps(features: Features, longer: int) -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (40, 2)).astype(np.float32)
    table = rng.standard_normal((5, 5, 2, 3)).astype(np.float32)
    samples = TrainingPresses(np.zeros((40, 2, 3), np.float32), np.ones((40, 2), bool), places)
    options = Options(features=features, hidden=8, layers=1, epochs=3, batch=16)
    totals: list[int] = []
    training.train_members(samples, table, options, rng, lambda done, total: totals.append(total))
    assert set(totals) == {longer * options.members * 3 * training.LEAST_BATCHES}


@pytest.mark.parametrize(("capabilities", "off"), [({"avx512_bf16": True}, 0.03), ({"avx512_bf16": False}, 0.0)])
def test_training_is_as_fine_as_the_processor_is_fast(monkeypatch, capabilities: dict[str, bool], off: float) -> None:
    """Outputs and slopes are single, and up to a few per cent those of single precision, or exactly these."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    generator = torch.Generator().manual_seed(0)
    weights = masked_network.initial(30, Options(), generator)
    x = torch.randn(1, 64, 30, generator=generator)

    def outputs_and_slopes(forward: Callable[..., torch.Tensor]) -> list[torch.Tensor]:
        found = forward(weights, x)
        return [found, *torch.autograd.grad(found.square().sum(), list(weights.values()))]

    exact, fast = map(outputs_and_slopes, (masked_network.forward, masked_network.forward_fast))
    for one, other in zip(exact, fast, strict=True):
        assert other.dtype == torch.float32
        assert torch.linalg.vector_norm(one - other) <= off * torch.linalg.vector_norm(one)
    assert all(torch.equal(one, other) for one, other in zip(exact, fast, strict=True)) == (not off)
