"""The published localizer: its derivatives, what it learns, and inputs that break such code."""

import numpy as np
import pytest
import torch

from design.errors import InputError
from design.levenberg_marquardt import first_weights, fit, forward, normal_equations


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def rms(difference):
    return float(np.sqrt((difference**2).mean()))


def waves(presses):
    """Three smooth outputs of two inputs."""
    x, y = presses.T
    return np.column_stack([np.sin(2 * x) * y, np.exp(-(x**2) - y**2), 30 + x * y])


@pytest.mark.parametrize(("inputs", "hidden", "outputs"), [(3, 7, 2), (1, 1, 1), (9, 20, 3)])
def test_normal_equations_are_those_of_the_whole_jacobian(inputs, hidden, outputs):
    rng = np.random.default_rng(inputs)
    x = torch.from_numpy(np.column_stack([rng.uniform(-1, 1, (40, inputs)), np.ones(40)]))
    y = torch.from_numpy(rng.uniform(-1, 1, (40, outputs)))
    weights = first_weights(np.ones(inputs, bool), hidden, outputs, rng)

    def errors(*weights):
        neurons = torch.tanh(x @ weights[0].T)
        return neurons @ weights[1][:, :-1].T + weights[1][:, -1] - y

    parts = torch.autograd.functional.jacobian(errors, weights)
    jacobian = torch.cat([part.reshape(y.numel(), -1) for part in parts], dim=1)
    neurons, error = forward(weights, x, y)
    torch.testing.assert_close(error, errors(*weights))
    curvature, slope = normal_equations(x, neurons, weights[1], error)
    torch.testing.assert_close(curvature.triu(), (jacobian.T @ jacobian).triu())
    torch.testing.assert_close(slope, jacobian.T @ error.ravel())


def test_a_curved_map_is_learned_on_samples_never_seen():
    rng = np.random.default_rng(0)
    known, fresh = rng.uniform(-1, 1, (400, 2)), rng.uniform(-1, 1, (400, 2))
    network = fit(known, waves(known), rng, hidden=15, epochs=200)
    constant = rms(waves(fresh) - waves(known).mean(axis=0))
    assert rms(network(fresh) - waves(fresh)) < constant / 100


def test_a_linear_map_in_any_units_is_learned_almost_exactly():
    rng = np.random.default_rng(1)
    inputs = rng.uniform([2000, -1e-6], [2001, 1e-6], (300, 2))
    targets = inputs @ np.array([[1.0, 3.0], [1e6, -1e6]]) + 7
    network = fit(inputs, targets, rng, hidden=8)
    assert rms(network(inputs) - targets) < 1e-4 * targets.std()


def test_noise_is_not_learned_by_heart():
    rng = np.random.default_rng(2)
    inputs, noise = rng.uniform(-1, 1, (200, 3)), rng.normal(size=(200, 1))
    network = fit(inputs, noise, rng)
    assert network.epochs < 50
    assert rms(network(rng.uniform(-1, 1, (200, 3)))) < 2


def test_the_same_seed_gives_the_same_network():
    inputs = np.random.default_rng(0).uniform(-1, 1, (150, 2))
    first, again, other = (fit(inputs, waves(inputs), np.random.default_rng(s), 10) for s in (3, 3, 4))
    np.testing.assert_array_equal(first(inputs), again(inputs))
    assert not np.array_equal(first(inputs), other(inputs))


def test_a_constant_input_is_as_if_it_were_not_there():
    rng = np.random.default_rng(5)
    inputs = rng.uniform(-1, 1, (300, 2))
    with_constant = np.column_stack([np.full(300, 3.0), inputs])
    network = fit(with_constant, waves(inputs), rng, hidden=15)
    assert rms(network(with_constant) - waves(inputs)) < 0.02
    moved = with_constant + np.array([5.0, 0, 0])
    np.testing.assert_array_equal(network(moved), network(with_constant))


@pytest.mark.parametrize("columns", [1, 4])
def test_constant_inputs_alone_give_the_best_constant(columns):
    rng = np.random.default_rng(6)
    targets = rng.normal(5, 0.1, (100, 2))
    found = fit(np.zeros((100, columns)), targets, rng, hidden=5)(np.zeros((3, columns)))
    np.testing.assert_allclose(found, np.tile(targets.mean(axis=0), (3, 1)), atol=0.1)


def test_constant_targets_are_found():
    rng = np.random.default_rng(7)
    inputs, targets = rng.uniform(-1, 1, (50, 2)), np.tile([4.0, -2.0], (50, 1))
    np.testing.assert_allclose(fit(inputs, targets, rng, hidden=5)(inputs), targets, atol=1e-12)


@pytest.mark.parametrize("count", [3, 4, 10])
def test_fewer_samples_than_weights_still_give_a_network(count):
    rng = np.random.default_rng(count)
    inputs = rng.uniform(-1, 1, (count, 2))
    assert np.isfinite(fit(inputs, inputs, rng, hidden=50)(inputs)).all()


@pytest.mark.parametrize(("inputs", "targets"), [(2, 2), (10, 9), (0, 0)])
def test_samples_that_do_not_fit_are_refused(inputs, targets):
    with pytest.raises(InputError, match="at least 3"):
        fit(np.zeros((inputs, 2)), np.zeros((targets, 2)), np.random.default_rng(0))
