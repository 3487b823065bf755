"""The network: NumPy says what torch says, and members add to what they expect."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sense import settings as sense_settings
from sense.localizer import network
from sense.localizer.calibration.networks import masked_network
from sense.localizer.network import pooled


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), layers=st.integers(1, 4))
def test_numpy_and_torch_agree(seed: int, layers: int) -> None:
    options = sense_settings.LocalizerSettings(layers=layers, hidden=24)
    generator = torch.Generator().manual_seed(seed)
    weights = masked_network.initial(3 * 5 + 3, options, generator)
    inputs = torch.randn(7, 3, 5, generator=generator)
    alive = torch.rand(7, 3, generator=generator) < 0.6
    expected = masked_network.forward(weights, masked_network.masked(inputs, alive)[None]).detach().numpy()
    plain = {name: weight.detach().numpy() for name, weight in weights.items()}
    found = network.forward(plain, network.masked(inputs.numpy(), alive.numpy()))
    assert found.dtype == np.float32
    assert np.allclose(found, expected, atol=2e-5)


def test_the_spread_of_members_adds_to_what_they_expect() -> None:
    outputs = np.zeros((2, 1, 4), dtype=np.float32)
    outputs[:, 0, 0] = [-0.3, 0.5]
    outputs[:, 0, 2:] = np.log(0.2)
    place, sd = pooled(outputs)
    assert place[0].tolist() == pytest.approx([0.1, 0.0])
    assert sd[0].tolist() == pytest.approx([np.sqrt(2 * 0.04 + 0.16), np.sqrt(2 * 0.04)])
