"""Traces and the prediction of each fibre from the others; likelihood ratios against SciPy's densities, and sums."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.stats import t as student
from torch.nn import functional

from padforge.sense.health import fault_likelihoods, trace_model
from padforge.sense.health.fault_likelihoods import LIBRARY, STEPS, FaultLikelihoods
from padforge.sense.health.trace_model import COMPONENTS, INPUTS, LOG_STD, MEMBERS, RELEASED, TARGETS, TRACE
from padforge.sense.localizer import optimizer


def random_weights(fibres: int, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    hidden, outputs = 7, 2 * TARGETS
    shapes = {"first.w": (fibres, INPUTS, hidden), "first.mask": (fibres, hidden), "first.b": (hidden,)}
    shapes |= {"hidden.w": (hidden, hidden), "hidden.b": (hidden,)}
    shapes |= {"last.w": (fibres, hidden, outputs), "last.b": (fibres, outputs)}
    return {name: 0.5 * rng.standard_normal((MEMBERS, *shape), np.float32) for name, shape in shapes.items()}


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), fibres=st.integers(1, 5))
def test_predict_fibres_ignores_the_fibre_itself_and_masked_ones(seed: int, fibres: int) -> None:
    rng = np.random.default_rng(seed)
    weights = random_weights(fibres, rng)
    inputs = rng.standard_normal((3, fibres, INPUTS)).astype(np.float32)
    fibre_mask = rng.random((3, fibres)) < 0.7
    mean, std = trace_model.predict_fibres(weights, inputs, fibre_mask)
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


def test_traces_are_filled_within_the_press_and_nan_where_the_recording_ends() -> None:
    readings = np.arange(100.0)[:, None] * [1.0, 2.0]
    complete = trace_model.extract_trace(readings, down_command=30, up_command=55, first=0, end=100)
    assert complete.shape == (2, TRACE)
    assert complete[0].tolist() == [*range(20, 50), *range(55, 75)]
    short = trace_model.extract_trace(readings, down_command=30, up_command=34, first=28, end=36)
    assert short[0].tolist() == [28] * 9 + [29] + [30, 31, 32, 33] + [33] * 16 + [34, 35] + [35] * 18
    # The next press begins before a reading of the release was taken.
    unreleased = trace_model.extract_trace(readings, down_command=30, up_command=55, first=0, end=55)
    assert unreleased[0, :-RELEASED].tolist() == [*range(20, 50)]
    assert np.isnan(unreleased[:, -RELEASED:]).all()
    down_command, up_command = np.array([10, 50]), np.array([30, 70])
    for end in (70, 74, 90):
        first, last = trace_model.extract_traces(readings[:end], down_command, up_command)[:, 0]
        assert first[-RELEASED:].tolist() == [*range(30, 50)]
        assert np.array_equal(last, [*range(40, 70), *range(70, end), *[np.nan] * (90 - end)], equal_nan=True)
    # One that the next press cuts short is filled.
    first, _ = trace_model.extract_traces(readings, down_command, np.array([45, 70]))[:, 0]
    assert first[-RELEASED:].tolist() == [*range(45, 50), *[49] * 15]


PRESSES, FIBRES = 5, 3
OFFSETS = (2.0, -2.0, 4.0, -4.0, 12.0, -12.0)


def log_density(value: ArrayLike, mean: ArrayLike = 0.0, std: ArrayLike = 1.0) -> np.ndarray:
    """Of Student's t with 5 degrees of freedom."""
    return student.logpdf(value, 5, mean, std)


def shift_llr(value: np.ndarray, shift: ArrayLike) -> np.ndarray:
    """Of a mean of at least `shift` against 0."""
    value = np.minimum(value, shift)
    return log_density(value, shift) - log_density(value)


def random_case(seed: int) -> tuple[FaultLikelihoods, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random parameters; and traces, targets, means and deviations of some presses."""
    rng = np.random.default_rng(seed)
    model = FaultLikelihoods(
        std_scale=rng.uniform(0.8, 1.5, (FIBRES, TARGETS)),
        std_floor=rng.uniform(0.0, 0.3, (FIBRES, TARGETS)),
        noise_floor=rng.uniform(0.05, 0.2, (FIBRES, COMPONENTS)),
        library_mean=rng.normal(0, 1, (LIBRARY, FIBRES, COMPONENTS)),
        library_std=rng.uniform(0.2, 0.6, (LIBRARY, FIBRES, COMPONENTS)),
        noise_v=rng.uniform(0.5, 1.5, FIBRES),
        log_noise_mean=rng.uniform(-0.2, 0.4, FIBRES),
        log_noise_std=rng.uniform(0.2, 0.5, FIBRES),
        constant_share=rng.uniform(0.001, 0.2, FIBRES),
        step_filters=rng.normal(0, 0.1, (FIBRES, len(STEPS), TRACE)),
        rest_autocorr=np.array([0.6]),
        innovation_std=np.array([0.7]),
    )
    traces = rng.normal(0, 1, (PRESSES, FIBRES, TRACE))
    traces[1, 0] = 0.25  # stuck
    mean, std = rng.normal(0, 1, (PRESSES, FIBRES, TARGETS)), rng.uniform(0.2, 0.5, (PRESSES, FIBRES, TARGETS))
    targets = mean + std * rng.standard_t(5, mean.shape)
    targets[2, 1, :COMPONENTS] *= 0.05  # hardly a response
    targets[3, 2, :COMPONENTS] += 3.0  # inconsistent
    targets[3:, 0, -1] += 4.0  # offset
    return model, traces, targets, mean, std


@pytest.mark.parametrize("seed", [0, 1])
def test_log_likelihood_ratios_are_those_of_densities_and_0_for_missing_readings(seed: int) -> None:
    model, traces, targets, mean, std = random_case(seed)
    llr_continuing, llr_onset = model.log_likelihood_ratios(traces, targets, mean, std)
    calibrated = np.hypot(std * model.std_scale, model.std_floor)
    # 1. Hypotheses of a single press
    y, m, s = (part[..., :COMPONENTS] for part in (targets, mean, calibrated))
    healthy = log_density(y, m, s).sum(axis=2)
    gains = [log_density(y, gain * m, np.hypot(gain * s, model.noise_floor)).sum(axis=2) for gain in (0, 0.5, -1)]
    others = np.exp(log_density(y[:, None], model.library_mean, model.library_std).sum(axis=3)).mean(axis=1)
    inconsistent = np.log((others + np.exp(log_density(y, m, 4 * s).sum(axis=2))) / 2)
    log_noise = np.log(fault_likelihoods.estimate_noise(traces) / model.noise_v + 0.25) - model.log_noise_mean
    noisy = shift_llr(log_noise / model.log_noise_std, np.log(5) / model.log_noise_std)
    constant = np.where(np.ptp(traces, axis=2) == 0, -np.log(model.constant_share), -6.0)
    common = [constant, *(each - healthy for each in (*gains, inconsistent)), noisy]
    # 2. Offsets, by the innovation of rests and by the steps of a press and the one before
    previous, rest = [0, *range(PRESSES - 1)], ((targets - mean) / calibrated)[..., -1]
    innovation, steps = (rest - 0.6 * rest[previous]) / 0.7, model.largest_step(traces)
    continuing, onset = list(common), [np.clip(llr, -6, 6) for llr in common]
    for offset in OFFSETS:
        sign, size = math.copysign(1, offset), abs(offset) / 0.7
        continuing.append(shift_llr(sign * innovation, (1 - 0.6) * size))
        jump = np.maximum(np.maximum(sign * steps, sign * steps[previous]), 0.0)
        step = np.clip(3 * np.log1p(jump**2 / 5) - 4, 0, 12)
        onset.append(np.clip(shift_llr(sign * innovation, size), -6, 6) + step)
    expected = np.clip(np.stack(continuing, axis=2), -6, 6), np.stack(onset, axis=2)
    np.testing.assert_allclose((llr_continuing, llr_onset), expected, rtol=1e-9, atol=1e-9)
    # they are 0 for missing readings
    traces[2, 1, 7] = targets[2, 1, 0] = np.nan
    llr_continuing, llr_onset = model.log_likelihood_ratios(traces, targets, mean, std)
    assert not llr_continuing[2, 1].any()
    assert not llr_onset[2, 1].any()
    assert llr_continuing[2, 0].any()


def test_cusum_is_the_best_sum_over_all_onsets() -> None:
    llr_continuing, llr_onset = np.random.default_rng(3).normal(-0.3, 1, (2, 40))
    height = np.zeros(())
    for press in range(40):
        height = fault_likelihoods.cusum_update(height, llr_continuing[press], llr_onset[press])
        sums = [llr_onset[first] + llr_continuing[first + 1 : press + 1].sum() for first in range(press + 1)]
        # A fault that was present before the first press is as good as any onset.
        earlier = [llr_continuing[first : press + 1].sum() for first in range(press + 2)]
        assert height == pytest.approx(max(0.0, *sums, *earlier))


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
