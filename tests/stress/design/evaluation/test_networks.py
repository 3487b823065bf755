"""Networks that learn from degenerate samples."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from design.evaluation.levenberg_marquardt import fit_many
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.values import LAX, seeds


@settings(few(15), suppress_health_check=LAX)
@given(
    seeds(),
    st.sampled_from([3, 4, 30]),
    st.sampled_from([1, 3]),
    st.sampled_from([1e-12, 1e-300, 0.0, 1.0, 1e12]),
    st.sampled_from(["random", "equal", "two", "zero column", "line"]),
)
def test_networks_learn_something_finite_or_say_why_not(seed, samples, networks, scale, kind):
    rng = np.random.default_rng(seed)
    inputs, targets = rng.normal(size=(samples, 2)) * scale, rng.normal(size=(samples, 2)) * scale
    if kind == "equal":
        inputs[:] = inputs[0]
    elif kind == "two":
        inputs = np.where(inputs > 0, 1.0, 0.0)
    elif kind == "zero column":
        inputs[:, 0] = 0
    elif kind == "line":
        targets = inputs @ rng.normal(size=(2, 2))
    rngs = [np.random.default_rng(i) for i in range(networks)]
    with ends_in_time():
        found = fit_many(inputs, targets, rngs, hidden=4, epochs=20)
    assert len(found) == networks
    for network in found:
        assert np.isfinite(network(inputs)).all()
