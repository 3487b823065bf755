"""Traces, their principal components and scales, and the prediction of each fibre from the others."""

import math

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch.nn import functional

from padforge.sense.health import trace_model
from padforge.sense.health.trace_model import (
    COMPONENTS,
    INPUTS,
    LOG_STD,
    MEMBERS,
    RELEASED,
    REST,
    TARGETS,
    TRACE,
    TraceHistory,
    TracePCA,
    extract_trace,
    extract_traces,
    predict_fibres,
)
from padforge.sense.localizer import optimizer

FIBRES = 2


def test_project_follows_response_rest_and_history() -> None:
    rng = np.random.default_rng(0)
    traces = rng.normal(0, 1, (120, FIBRES, TRACE)) + np.linspace(0, 3, 120)[:, None, None]
    traces[5, 1, 3] = np.nan
    components = rng.normal(0, 1, (FIBRES, TRACE, COMPONENTS))
    pca = TracePCA(components, np.ones((FIBRES, INPUTS)), np.ones((FIBRES, TARGETS)))
    history = TraceHistory.initial(FIBRES)
    levels, residue, count = [math.nan] * FIBRES, np.zeros((FIBRES, COMPONENTS)), [0] * FIBRES
    for trace in traces:
        inputs, targets = pca.project(trace, history)
        for fibre in range(FIBRES):
            if np.isnan(trace[fibre]).any():
                assert np.isnan(inputs[fibre, : COMPONENTS + 1]).all()
                assert np.isnan(targets[fibre]).all()
                continue
            rest = trace[fibre, :REST].mean()
            response = (trace[fibre] - rest) @ components[fibre]
            level = rest if math.isnan(levels[fibre]) else levels[fibre]
            np.testing.assert_allclose(inputs[fibre], [*response, rest - level, *residue[fibre]], atol=1e-9)
            np.testing.assert_allclose(targets[fibre], [*response, rest - level], atol=1e-9)
            count[fibre] += 1
            levels[fibre] = level + max(1 / 50, 1 / count[fibre]) * (rest - level)
            residue[fibre] = 0.7 * (residue[fibre] + response)
        np.testing.assert_allclose(history.level, levels, atol=1e-9)
        np.testing.assert_array_equal(history.n_presses, count)


def test_fit_transform_finds_principal_directions_and_scales() -> None:
    rng = np.random.default_rng(1)
    patterns = np.linalg.qr(rng.normal(0, 1, (TRACE - REST, 3)))[0].T
    amplitudes = np.array([5.0, 2.0, 0.5]) * rng.normal(0, 1, (400, FIBRES, 3))
    traces = np.zeros((400, FIBRES, TRACE))
    traces[:, :, REST:] = np.einsum("qck,kw->qcw", amplitudes, patterns)
    pca, inputs, targets = TracePCA.fit_transform(traces)
    for fibre in range(FIBRES):
        for component, pattern in enumerate(patterns):
            assert abs(pca.components[fibre, REST:, component] @ pattern) > 0.98
        rms = np.sqrt(((traces[:, fibre] @ pca.components[fibre]) ** 2).mean(axis=0))
        largest = max(rms.max(), pca.input_scale_v[fibre].max())
        np.testing.assert_allclose(pca.input_scale_v[fibre, :3], np.sqrt(rms[:3] * largest), rtol=1e-6)
        np.testing.assert_allclose(pca.target_scale_v[fibre, :3], rms[:3])
    assert inputs.shape == (400, FIBRES, INPUTS)
    np.testing.assert_allclose(np.sqrt((targets[:, :, :3] ** 2).mean(axis=0)), 1)


def random_weights(fibres: int, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    hidden, outputs = 7, 2 * TARGETS
    shapes = {
        "first.w": (MEMBERS, fibres, INPUTS, hidden),
        "first.mask": (MEMBERS, fibres, hidden),
        "first.b": (MEMBERS, hidden),
        "hidden.w": (MEMBERS, hidden, hidden),
        "hidden.b": (MEMBERS, hidden),
        "last.w": (MEMBERS, fibres, hidden, outputs),
        "last.b": (MEMBERS, fibres, outputs),
    }
    return {name: (0.5 * rng.standard_normal(shape)).astype(np.float32) for name, shape in shapes.items()}


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), fibres=st.integers(1, 5))
def test_predict_fibres_ignores_the_fibre_itself_and_masked_ones(seed: int, fibres: int) -> None:
    rng = np.random.default_rng(seed)
    weights = random_weights(fibres, rng)
    inputs = rng.standard_normal((3, fibres, INPUTS)).astype(np.float32)
    fibre_mask = rng.random((3, fibres)) < 0.7
    mean, std = predict_fibres(weights, inputs, fibre_mask)
    for press, fibre in np.ndindex(3, fibres):
        means, variances = [], []
        for e in range(MEMBERS):
            h = weights["first.b"][e].astype(float)
            for c in range(fibres):
                if c != fibre and fibre_mask[press, c]:
                    h = h + inputs[press, c] @ weights["first.w"][e, c] + weights["first.mask"][e, c]
            h = h / (1 + np.exp(-h))
            h = h @ weights["hidden.w"][e] + weights["hidden.b"][e]
            h = h / (1 + np.exp(-h))
            out = h @ weights["last.w"][e, fibre] + weights["last.b"][e, fibre]
            means.append(out[:TARGETS])
            variances.append(np.exp(2 * np.clip(out[TARGETS:], *LOG_STD)))
        assert np.allclose(mean[press, fibre], np.mean(means, axis=0), atol=1e-4)
        total = np.mean(variances, axis=0) + np.var(means, axis=0)
        assert np.allclose(std[press, fibre], np.sqrt(total), rtol=1e-3, atol=1e-4)


def test_extract_trace_fills_within_the_press() -> None:
    readings = np.arange(100.0)[:, None] * [1.0, 2.0]
    complete = extract_trace(readings, down_command=30, up_command=55, first=0, end=100)
    assert complete.shape == (2, TRACE)
    assert complete[0].tolist() == [*range(20, 50), *range(55, 75)]
    short = extract_trace(readings, down_command=30, up_command=34, first=28, end=36)
    assert short[0].tolist() == [28] * 9 + [29] + [30, 31, 32, 33] + [33] * 16 + [34, 35] + [35] * 18
    # The next press begins before a reading of the release was taken.
    unreleased = extract_trace(readings, down_command=30, up_command=55, first=0, end=55)
    assert unreleased[0, :-RELEASED].tolist() == [*range(20, 50)]
    assert np.isnan(unreleased[:, -RELEASED:]).all()


def test_extract_traces_has_nan_where_the_recording_ends() -> None:
    readings = np.arange(100.0)[:, None] * [1.0, 2.0]
    down_command, up_command = np.array([10, 50]), np.array([30, 70])
    for end in (70, 74, 90):
        first, last = extract_traces(readings[:end], down_command, up_command)[:, 0]
        assert first[-RELEASED:].tolist() == [*range(30, 50)]
        assert np.array_equal(last, [*range(40, 70), *range(70, end), *[np.nan] * (90 - end)], equal_nan=True)
    # One that the next press cuts short is filled.
    first, _ = extract_traces(readings, down_command, np.array([45, 70]))[:, 0]
    assert first[-RELEASED:].tolist() == [*range(45, 50), *[49] * 15]


def test_backpropagation_agrees_with_torch() -> None:
    """Standard deviations are clipped for some targets, and one fibre or more of each press is dropped."""
    rng, (members, batch, fibres, n_inputs, n_targets, hidden) = np.random.default_rng(0), (2, 5, 3, 4, 2, 6)

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape, np.float32)

    n_outputs = 2 * n_targets
    weights = {
        "first.w": normal(members, fibres * n_inputs, hidden),
        "first.mask": normal(members, fibres, hidden),
        "first.b": normal(members, 1, hidden),
        "hidden.w": normal(members, hidden, hidden),
        "hidden.b": normal(members, 1, hidden),
        "last.w": normal(members, hidden, fibres * n_outputs),
        "last.b": 3 * normal(members, 1, fibres * n_outputs),
    }
    inputs, targets = normal(members, batch, fibres, n_inputs), normal(members, batch, fibres, n_targets)
    dropped = (normal(members, batch, fibres).argsort(axis=2) < rng.integers(1, 3, (members, batch, 1))).astype("f4")
    parameters = optimizer.Parameters(weights)
    for _ in range(2):  # nothing remains of a batch
        trace_model.backpropagate(parameters, inputs, targets, dropped)

    w = {name: torch.from_numpy(weight).requires_grad_() for name, weight in weights.items()}
    x, y, masked = map(torch.from_numpy, (inputs, targets, dropped))
    h = torch.einsum("ebcn,ecnh->ebh", x * (1 - masked)[..., None], w["first.w"].view(members, fibres, -1, hidden))
    h = functional.silu(h + torch.einsum("ebc,ech->ebh", 1 - masked, w["first.mask"]) + w["first.b"])
    h = functional.silu(torch.baddbmm(w["hidden.b"], h, w["hidden.w"]))
    mean, log_std = torch.baddbmm(w["last.b"], h, w["last.w"]).view(members, batch, fibres, -1).chunk(2, dim=3)
    assert ((log_std < -4) | (log_std > 2)).any()
    std = log_std.clamp(-4, 2).exp()
    t = torch.distributions.StudentT(trace_model.T_DEGREES, mean, std)
    constant = torch.distributions.StudentT(trace_model.T_DEGREES).log_prob(torch.zeros(()))
    loss = (constant - t.log_prob(y) + (y - mean) ** 2 / 4) * masked[..., None]
    (loss.sum(dim=(1, 2, 3)) / masked.sum(dim=(1, 2))).sum().backward()
    for name, gradient in parameters.gradient.items():
        expected = w[name].grad
        assert expected is not None
        np.testing.assert_allclose(gradient, expected, atol=1e-4 * float(expected.abs().max()))
