"""Log-likelihood ratios against SciPy's densities, cumulative sums, and the tail of their peaks."""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.stats import t as student

from padforge.sense.health.fault_likelihoods import (
    LIBRARY,
    MEDIAN_T,
    STEPS,
    ExceedanceModel,
    FaultLikelihoods,
    cusum_update,
    estimate_noise,
    fit_step_filters,
)
from padforge.sense.health.trace_model import COMPONENTS, REST, TARGETS, TRACE

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
    log_noise = np.log(estimate_noise(traces) / model.noise_v + 0.25) - model.log_noise_mean
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


def test_fit_calibrates_deviations_noise_and_rests() -> None:
    """Errors are twice as large as predicted; rests correlate by 0.5 with those before; traces are noise alone."""
    rng = np.random.default_rng(5)
    error = rng.standard_t(5, (1500, FIBRES, TARGETS))
    for press in range(1, 1500):
        error[press, :, -1] = 0.5 * error[press - 1, :, -1] + error[press, :, -1]
    std = np.full(error.shape, 0.1)
    mean = rng.normal(0, 1, std.shape)
    traces = np.array([0.1, 0.2, 0.3])[:, None] * rng.standard_normal((1500, FIBRES, TRACE))
    traces[:3, 1] = 0.5
    model = FaultLikelihoods.fit(traces, mean + 0.2 * error, mean, std, np.full((FIBRES, TARGETS), 2.0), rng)
    calibrated = np.hypot(0.1 * model.std_scale, model.std_floor)
    np.testing.assert_allclose(calibrated[:, :COMPONENTS], 0.2, rtol=0.15)
    assert model.rest_autocorr == pytest.approx([0.5], abs=0.1)
    assert model.innovation_std == pytest.approx([0.2 / calibrated[:, -1].mean()], rel=0.15)
    noise = np.median([[estimate_noise(trace) for trace in press] for press in traces], axis=0)
    np.testing.assert_allclose(model.noise_v, noise)
    np.testing.assert_allclose(model.noise_floor, np.repeat(noise[:, None] / 2, COMPONENTS, axis=1))
    np.testing.assert_allclose(model.log_noise_mean, math.log(1.25), atol=0.01)
    np.testing.assert_allclose(model.constant_share, np.array([1, 4, 1]) / 1502)
    assert model.library_mean.shape == model.library_std.shape == (LIBRARY, FIBRES, COMPONENTS)


def test_step_filters_are_matched_and_scaled_for_heavy_tails() -> None:
    """On white noise a filter gives 1 for a standard deviation, or its far quantile is that of Student's t."""
    rng = np.random.default_rng(2)
    traces = rng.standard_normal((4000, 1, TRACE))
    (filters,) = fit_step_filters(traces, np.array([0.01]))
    outputs = (traces - traces[:, :, :REST].mean(axis=2, keepdims=True))[:, 0] @ filters.T
    np.testing.assert_allclose(outputs.std(axis=0), 1, rtol=0.05)
    for number, at in enumerate(STEPS):
        step = (np.arange(TRACE) >= at).astype(float)
        step -= step[:REST].mean()
        assert abs(np.argmax(np.abs(filters @ step)) - number) <= 2
    heavy = traces * np.where(rng.random(4000) < 0.01, 30.0, 1.0)[:, None, None]
    (filters,) = fit_step_filters(heavy, np.array([0.01]))
    outputs = (heavy - heavy[:, :, :REST].mean(axis=2, keepdims=True))[:, 0] @ filters.T
    np.testing.assert_allclose(np.quantile(np.abs(outputs), 0.999, axis=0), student.ppf(0.9995, 5), rtol=1e-3)
    assert pytest.approx(student.ppf(0.75, 5), abs=1e-4) == MEDIAN_T


def test_noise_is_the_mean_step_of_quiet_readings_but_for_the_largest_quarter() -> None:
    """Of the rest, and of the last ten readings held and released: 27 steps, of which 20 count."""
    quiet = np.concatenate([np.arange(10), np.arange(20, 30), np.arange(40, 50)])
    trace = np.full(TRACE, 7.0)
    trace[quiet] = 0.01 * (quiet % 2)
    assert estimate_noise(trace) == pytest.approx(0.01)
    trace[[5, 25, 45]] = 3.0  # 6 steps beside them, all of a quarter
    assert estimate_noise(np.stack([trace, 2 * trace])[:, None]) == pytest.approx(np.array([[0.01], [0.02]]))
    trace[[3, 23]] = 3.0
    assert estimate_noise(trace) > 0.1


def test_exceedance_fit_has_the_mean_excess_of_the_highest_tenth() -> None:
    """400 peaks of one press each with known heights; the level makes the highest no rarer than once."""
    heights = np.random.default_rng(0).permutation(np.linspace(0.1, 40, 400))
    llrs = np.full((1000, 1, 1), -100.0)
    llrs[: 2 * 400 : 2, 0, 0] = heights
    model = ExceedanceModel.fit([(llrs, llrs)])
    top = np.sort(heights)
    slope = (top[-40:] - top[-41]).mean()
    assert model.slope[0, 0] == pytest.approx(slope)
    levels = [top[-41] + slope * math.log(40 / 1000), top[-1] + slope * math.log(1 / 1000)]
    assert model.level[0, 0] == pytest.approx(max(levels))
    assert ExceedanceModel.fit([(-llrs * 0 - 1, -llrs * 0 - 1)]).slope[0, 0] == 1


def test_cusum_is_the_best_sum_over_all_onsets() -> None:
    llr_continuing, llr_onset = np.random.default_rng(3).normal(-0.3, 1, (2, 40))
    height = np.zeros(())
    for press in range(40):
        height = cusum_update(height, llr_continuing[press], llr_onset[press])
        sums = [llr_onset[first] + llr_continuing[first + 1 : press + 1].sum() for first in range(press + 1)]
        # A fault that was present before the first press is as good as any onset.
        earlier = [llr_continuing[first : press + 1].sum() for first in range(press + 2)]
        assert height == pytest.approx(max(0.0, *sums, *earlier))
