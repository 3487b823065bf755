import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.kernels.leave_one_out import leave_one_out_errors

RIDGE = 1e-2


def closed_form(responses, positions, masks, count):
    """Errors (L,) of tensors: alpha / c_aa, from an inverse."""
    difference = responses[:, :, None] - responses[:, None]
    kernel = torch.exp(-torch.einsum("lf,fab->lab", masks, difference**2) / 2)
    inverse = torch.linalg.inv(kernel + RIDGE * torch.eye(kernel.shape[1]))
    lengths = torch.linalg.norm(inverse @ positions, dim=2)
    return (lengths / torch.diagonal(inverse, dim1=1, dim2=2))[:, :count].mean(dim=1)


@given(st.integers(1, 40), st.integers(1, 6), st.floats(0.01, 100.0), st.integers(0, 99))
@settings(max_examples=25)
def test_errors_and_gradients_are_those_of_double_precision(n, fibres, spread, seed):
    rng = np.random.default_rng(seed)
    responses, positions = (spread * rng.standard_normal((fibres, n))).astype(np.float32), rng.uniform(-3, 3, (n, 2))
    masks = np.vstack([np.ones(fibres), rng.integers(0, 2, (2, fibres))]).astype(float)
    count, gradient = int(rng.integers(1, n + 1)), np.empty((3, fibres, n))
    x = torch.tensor(responses, dtype=torch.float64, requires_grad=True)
    expected = closed_form(x, torch.tensor(positions), torch.tensor(masks), count)
    place = positions.astype(np.float32)
    found = leave_one_out_errors(responses, place, masks, count, RIDGE, gradient)
    np.testing.assert_allclose(found, expected.detach(), rtol=2e-3)
    for k in range(3):
        (by_responses,) = torch.autograd.grad(expected[k], x, retain_graph=True)
        np.testing.assert_allclose(gradient[k], by_responses, atol=5e-3 * float(by_responses.abs().max()) + 1e-5)
    without = leave_one_out_errors(responses, place, masks, count, RIDGE, np.empty((3, 0, n)))
    assert without == pytest.approx(found, rel=1e-6)
