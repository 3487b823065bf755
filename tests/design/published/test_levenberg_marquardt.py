import numpy as np
import pytest
import torch

from padforge.benchmarks import networks as benchmark
from padforge.common.parallel import one_thread
from padforge.design.published import levenberg_marquardt as lm
from padforge.design.published.networks import fit_batch, initial_weights


@pytest.fixture(autouse=True)
def _one_thread():
    """As in a search: several that wait for a busy machine take many times as long."""
    with one_thread():
        yield


def rms(difference):
    return float(np.sqrt((difference**2).mean()))


def waves(presses):
    x, y = presses.T
    return np.column_stack([np.sin(2 * x) * y, np.exp(-(x**2) - y**2), 30 + x * y])


def jacobians(x, fit):
    """J and R J of one network, every column by automatic differentiation, and the output weights held."""

    hidden = fit.hidden[0].clone().requires_grad_()
    outputs = lm.activations(hidden[None], x[None])[0] @ fit.output[0]
    rows = [torch.autograd.grad(each, hidden, retain_graph=True)[0].ravel() for each in outputs.ravel()]
    jacobian = torch.stack(rows).unflatten(0, outputs.shape)
    gram = fit.neurons[0].mT @ fit.neurons[0]
    gram.diagonal().add_(lm.RIDGE * len(x))
    projection = torch.eye(len(x)) - fit.neurons[0] @ torch.linalg.solve(gram, fit.neurons[0].mT)
    return jacobian.flatten(0, 1), torch.einsum("qr,rkp->qkp", projection, jacobian).flatten(0, 1)


@pytest.mark.parametrize(("inputs", "hidden", "outputs"), [(3, 7, 2), (1, 1, 1)])
def test_primal_and_dual_equations_match_the_jacobian(inputs, hidden, outputs):
    rng = np.random.default_rng(inputs)
    x = lm.append_ones(torch.from_numpy(rng.uniform(-1, 1, (2, 40, inputs))))
    y = torch.from_numpy(rng.uniform(-1, 1, (2, 40, outputs)))
    weights = np.stack([initial_weights(np.ones(inputs, bool), hidden, rng).T for _ in range(2)])
    fit = lm.ProjectedFit.solve(torch.from_numpy(weights), x, y)
    slope, primal, dual = lm.jacobian_product(x, fit, fit.error), lm.gauss_newton_matrix(x, fit), lm.dual_matrix(x, fit)
    for network in range(2):
        alone = fit.rows(torch.tensor([network]))
        jacobian, projected = jacobians(x[network], alone)
        torch.testing.assert_close(slope[network], jacobian.mT @ alone.error.ravel())
        torch.testing.assert_close(primal[network].tril(), (jacobian.mT @ projected).tril())
        torch.testing.assert_close(dual[network], projected @ projected.mT)
        # The residual is what the projection leaves of the targets, so that both forms take the same step.
        torch.testing.assert_close(projected.mT @ alone.targets.ravel(), -slope[network], atol=1e-6, rtol=1e-6)


def test_fit_batch_counts_the_nearest_alternative_target():
    """Square roots have two signs; a network that may choose finds one, a network told either at random finds 0."""
    rng = np.random.default_rng(9)
    inputs = rng.uniform(0.1, 1, (400, 1))
    root = np.sqrt(inputs) * rng.choice([-1, 1], (400, 1))
    told = fit_batch(inputs, root, [np.random.default_rng(0)], hidden=8)[0](inputs)
    free = fit_batch(inputs, root, [np.random.default_rng(0)], hidden=8, alternatives=-root[None])[0](inputs)
    assert rms(np.abs(free) - np.sqrt(inputs)) < 0.1
    assert rms(np.abs(told) - np.sqrt(inputs)) > 0.3


def test_networks_bench_errs_as_plain_numpy(monkeypatch, taken):
    for name, value in {"SETS": 2, "HIDDEN": 4, "EPOCHS": 20}.items():
        monkeypatch.setattr(benchmark, name, value)
    rounds = taken(benchmark.BENCH)
    for case in ("square", "random N=5"):
        batched, plain = (rounds[case, way, 0, 0]["error"] for way in ("batched", "plain numpy"))
        assert 0.01 < batched == pytest.approx(plain, rel=0.3)


def test_fit_batch_trains_networks_independently_and_ignores_constant_inputs():
    rng = np.random.default_rng(5)
    inputs = rng.uniform(-1, 1, (2, 200, 3))
    inputs[..., 0] = 3.0
    targets = waves(inputs[0, :, 1:])
    rngs = [np.random.default_rng(seed) for seed in (1, 2)]
    together = fit_batch(inputs, targets, rngs, hidden=8, epochs=30)
    alone = fit_batch(inputs[1:], targets, [np.random.default_rng(2)], hidden=8, epochs=30)[0]
    np.testing.assert_allclose(together[1](inputs[1]), alone(inputs[1]), atol=0.05 * targets.std())
    assert rms(together[0](inputs[0]) - targets) < 0.2 * targets.std()
    shifted = inputs[0] + np.array([5.0, 0, 0])
    np.testing.assert_array_equal(together[0](shifted), together[0](inputs[0]))


def test_fit_batch_does_not_overfit_noise():
    rng = np.random.default_rng(2)
    inputs, noise = rng.uniform(-1, 1, (200, 3)), rng.normal(size=(200, 1))
    [network] = fit_batch(inputs, noise, [rng])
    assert rms(network(rng.uniform(-1, 1, (200, 3)))) < 1
    assert rms(network(inputs) - noise) > 0.7


def test_initial_weights_follow_nguyen_and_widrow():
    """Slopes of one length, 0.7 H^(1 / D) by the inputs that vary, and biases evenly over it, of either sign."""
    weights, length = initial_weights(np.array([True, True, False]), 16, np.random.default_rng(0)), 0.7 * 4
    assert not weights[:, 2].any()
    np.testing.assert_allclose(np.linalg.norm(weights[:, :-1], axis=1), length)
    np.testing.assert_allclose(np.abs(weights[:, -1]), np.abs(length * np.linspace(-1, 1, 16)))
    assert 0 < (weights[:, -1] * np.linspace(-1, 1, 16) < 0).sum() < 16
    assert np.ptp(np.sign(weights[:, 0])) == 2
