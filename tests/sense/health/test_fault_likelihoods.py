"""Likelihood ratios of every fault, against SciPy's densities in plain loops, and the thresholds of alarms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.stats import t as student

from padforge.sense.health import fault_likelihoods
from padforge.sense.health.fault_likelihoods import HYPOTHESES, LIBRARY, FaultLikelihoods, Tail, climb, noise_of
from padforge.sense.health.trace_model import COMPONENTS, REST, TARGETS, TRACE
from tests.sense.health.pads import Array

PRESSES, FIBRES = 5, 3
OFFSETS = (2.0, -2.0, 4.0, -4.0, 12.0, -12.0)


def log_density(value: ArrayLike, mean: ArrayLike = 0.0, spread: ArrayLike = 1.0) -> float:
    """Of Student's t with 5 degrees of freedom, summed over values."""
    return float(student.logpdf(value, 5, mean, spread).sum())


def shift_ratio(value: float, shift: float) -> float:
    """Of a mean of at least `shift` against 0."""
    value = min(value, shift)
    return log_density(value, shift) - log_density(value)


def by_hand(seed: int) -> tuple[FaultLikelihoods, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Evidence of drawn numbers, and traces, targets, means and spreads of some presses."""
    rng = np.random.default_rng(seed)
    model = FaultLikelihoods(
        scale=rng.uniform(0.8, 1.5, (FIBRES, TARGETS)),
        extra=rng.uniform(0.0, 0.3, (FIBRES, TARGETS)),
        floor=rng.uniform(0.05, 0.2, (FIBRES, COMPONENTS)),
        other_mean=rng.normal(0, 1, (LIBRARY, FIBRES, COMPONENTS)),
        other_spread=rng.uniform(0.2, 0.6, (LIBRARY, FIBRES, COMPONENTS)),
        noise=rng.uniform(0.5, 1.5, FIBRES),
        noise_centre=rng.uniform(-0.2, 0.4, FIBRES),
        noise_spread=rng.uniform(0.2, 0.5, FIBRES),
        constant=rng.uniform(0.001, 0.2, FIBRES),
        filters=rng.normal(0, 0.1, (FIBRES, len(fault_likelihoods.STEPS), TRACE)),
        persistence=np.array([0.6]),
        innovation=np.array([0.7]),
    )
    traces = rng.normal(0, 1, (PRESSES, FIBRES, TRACE))
    traces[1, 0] = 0.25  # stuck
    mean, spread = rng.normal(0, 1, (PRESSES, FIBRES, TARGETS)), rng.uniform(0.2, 0.5, (PRESSES, FIBRES, TARGETS))
    targets = mean + spread * rng.standard_t(5, mean.shape)
    targets[2, 1, :COMPONENTS] *= 0.05  # nearly silent
    targets[3, 2, :COMPONENTS] += 3.0  # odd
    targets[3:, 0, -1] += 4.0  # its rest has moved
    return model, traces, targets, mean, spread


@pytest.mark.parametrize("seed", [0, 1])
def test_ratios_are_those_of_densities(seed: int) -> None:
    model, traces, targets, mean, spread = by_hand(seed)
    stay, begin = model.ratios(traces, targets, mean, spread)
    assert stay.shape == begin.shape == (PRESSES, FIBRES, len(HYPOTHESES))
    steps, persistence, innovation = model.steps(traces), 0.6, 0.7
    for q, c in np.ndindex(PRESSES, FIBRES):
        honest = np.hypot(spread[q, c] * model.scale[c], model.extra[c])
        y, m, s = targets[q, c, :COMPONENTS], mean[q, c, :COMPONENTS], honest[:COMPONENTS]

        healthy, floor = log_density(y, m, s), model.floor[c]
        library = zip(model.other_mean[:, c], model.other_spread[:, c], strict=True)
        others = [math.exp(log_density(y, *each)) for each in library]
        odd = (sum(others) / LIBRARY + math.exp(log_density(y, m, 4 * s))) / 2
        log_noise = math.log(noise_of(traces[q, c]) / model.noise[c] + 0.25)
        loud = (log_noise - model.noise_centre[c]) / model.noise_spread[c]
        common = [
            -math.log(model.constant[c]) if np.ptp(traces[q, c]) == 0 else -6.0,
            log_density(y, 0 * m, floor) - healthy,
            log_density(y, 0.5 * m, np.hypot(0.5 * s, floor)) - healthy,
            math.log(odd) - healthy,
            shift_ratio(float(loud), float(math.log(5) / model.noise_spread[c])),
        ]

        def rest(press: int, c: int = c) -> float:
            own = np.hypot(spread[press, c, -1] * model.scale[c, -1], model.extra[c, -1])
            return float((targets[press, c, -1] - mean[press, c, -1]) / own)

        new = (rest(q) - persistence * rest(max(q - 1, 0))) / innovation
        staying, beginning = list(common), [float(np.clip(ratio, -6, 6)) for ratio in common]
        for offset in OFFSETS:
            sign, size = math.copysign(1, offset), abs(offset) / innovation
            staying.append(shift_ratio(sign * new, (1 - persistence) * size))
            jump = max(sign * steps[q, c], sign * steps[max(q - 1, 0), c], 0.0)
            stepped = float(np.clip(3 * math.log1p(jump**2 / 5) - 4, 0, 12))
            beginning.append(float(np.clip(shift_ratio(sign * new, size), -6, 6)) + stepped)
        np.testing.assert_allclose(stay[q, c], np.clip(staying, -6, 6), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(begin[q, c], beginning, rtol=1e-9, atol=1e-9)


def test_the_likeliest_step_is_that_of_the_loudest_filter_and_what_is_missing_says_nothing() -> None:
    model, traces, targets, mean, spread = by_hand(0)
    traces[2, 1, 7] = targets[2, 1, 0] = np.nan
    stay, begin = model.ratios(traces, targets, mean, spread)
    assert not stay[2, 1].any()
    assert not begin[2, 1].any()
    assert stay[2, 0].any()
    model, traces, *_ = by_hand(1)
    answers = traces - traces[..., :REST].mean(axis=-1, keepdims=True)
    for q, c in np.ndindex(PRESSES, FIBRES):
        found = model.filters[c] @ answers[q, c]
        assert model.steps(traces)[q, c] == pytest.approx(found[np.abs(found).argmax()])


def healthy(rng: np.random.Generator, presses: int) -> dict[str, np.ndarray]:
    """Traces of noise alone, and targets whose rest hangs together from press to press by 0.5."""
    error = rng.standard_t(5, (presses, FIBRES, TARGETS))
    for press in range(1, presses):
        error[press, :, -1] = 0.5 * error[press - 1, :, -1] + error[press, :, -1]
    spread = np.full((presses, FIBRES, TARGETS), 0.1)
    mean = rng.normal(0, 1, spread.shape)
    traces = np.array([0.1, 0.2, 0.3])[:, None] * rng.standard_normal((presses, FIBRES, TRACE))
    return {"traces": traces, "targets": mean + 0.2 * error, "mean": mean, "spread": spread}


def test_evidence_is_learnt_from_healthy_presses() -> None:
    """Errors are twice as wide as predicted, and rests are correlated by 0.5 with those before."""
    rng = np.random.default_rng(5)
    parts = healthy(rng, 1500)
    parts["traces"][:3, 1] = 0.5
    size = np.full((FIBRES, TARGETS), 2.0)
    model = FaultLikelihoods.fit(**parts, size=size, rng=rng)
    honest = np.hypot(0.1 * model.scale, model.extra)
    np.testing.assert_allclose(honest[:, :COMPONENTS], 0.2, rtol=0.15)
    assert model.persistence == pytest.approx([0.5], abs=0.1)
    whole = np.hypot(0.1 * model.scale[:, -1], model.extra[:, -1]).mean()
    assert model.innovation == pytest.approx([0.2 / whole], rel=0.15)  # the rest is 0.2 wide but for what stays
    noise = [np.median([noise_of(trace) for trace in parts["traces"][:, c]]) for c in range(FIBRES)]
    np.testing.assert_allclose(model.noise, noise)
    np.testing.assert_allclose(model.floor, np.repeat(np.array(noise)[:, None] / 2, COMPONENTS, axis=1))
    logs = np.log(np.array([[noise_of(trace) for trace in press] for press in parts["traces"]]) / noise + 0.25)
    np.testing.assert_allclose(model.noise_centre, np.median(logs, axis=0))
    np.testing.assert_allclose(model.noise_centre, math.log(1.25), atol=0.01)
    width = np.median(np.abs(logs - np.median(logs, axis=0)), axis=0) / 0.6745
    np.testing.assert_allclose(model.noise_spread, np.maximum(width, 0.1))
    np.testing.assert_allclose(model.constant, np.array([1, 4, 1]) / 1502)
    assert model.other_mean.shape == model.other_spread.shape == (LIBRARY, FIBRES, COMPONENTS)


def test_step_filters_answer_a_step_of_healthy_noise_by_its_spread() -> None:
    """White noise: the filter answers 1 to the spread of what is healthy, or its far quantile that of Student's t."""
    rng = np.random.default_rng(2)
    traces = rng.standard_normal((4000, 1, TRACE))
    (filters,) = fault_likelihoods.step_filters(traces, np.array([0.01]))
    answers = (traces - traces[:, :, :REST].mean(axis=2, keepdims=True))[:, 0] @ filters.T
    np.testing.assert_allclose(answers.std(axis=0), 1, rtol=0.05)
    for number, at in enumerate(fault_likelihoods.STEPS):
        step = (np.arange(TRACE) >= at).astype(float)
        step -= step[:REST].mean()
        assert np.argmax(np.abs(filters @ step) / 1) in range(max(number - 2, 0), number + 3)
    wild = traces * np.where(rng.random(4000) < 0.01, 30.0, 1.0)[:, None, None]
    (filters,) = fault_likelihoods.step_filters(wild, np.array([0.01]))
    answers = (wild - wild[:, :, :REST].mean(axis=2, keepdims=True))[:, 0] @ filters.T
    np.testing.assert_allclose(np.quantile(np.abs(answers), 0.999, axis=0), student.ppf(0.9995, 5), rtol=1e-3)
    assert pytest.approx(student.ppf(0.75, 5), abs=1e-4) == fault_likelihoods.MEDIAN_T


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-3, 10))
def test_noise_is_that_of_the_quiet_thirds_and_spikes_are_none(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    traces = size * rng.standard_normal((2, 3, TRACE))
    found = noise_of(traces)
    for index in np.ndindex(2, 3):
        own = traces[index]
        steps = sorted(abs(np.concatenate([np.diff(own[:10]), np.diff(own[20:30]), np.diff(own[40:])])))
        assert found[index] == pytest.approx(np.mean(steps[:20]))
    spiked = traces.copy()
    spiked[:, :, 5] += 1000 * size
    assert (noise_of(spiked) < 2 * found).all()
    steep = traces.copy()
    steep[:, :, 10:20] += 1000 * size * np.arange(10)
    assert (noise_of(steep) == found).all()


def test_a_tail_has_the_mean_excess_of_the_highest_tenth_and_is_read_by_the_fibres_lost() -> None:
    """400 climbs of one press each to known heights, of which the level makes the highest no rarer than once."""
    tail = Tail(level=np.array([[1.0, 2.0], [3.0, 4.0]]), slope=np.array([[1.0, 2.0], [2.0, 4.0]]))
    heights = np.array([[5.0, 8.0]])
    np.testing.assert_allclose(tail.rarity(heights, 0), [[4.0, 3.0]])
    np.testing.assert_allclose(tail.rarity(heights, 1), [[1.0, 1.0]])
    np.testing.assert_allclose(tail.rarity(heights, 7), [[1.0, 1.0]])
    heights = np.random.default_rng(0).permutation(np.linspace(0.1, 40, 400))
    ratios = np.full((1000, 1, 1), -100.0)
    ratios[: 2 * 400 : 2, 0, 0] = heights
    tail = Tail.fit([(ratios, ratios)])
    top = np.sort(heights)
    slope = (top[-40:] - top[-41]).mean()
    assert tail.slope[0, 0] == pytest.approx(slope)
    levels = [top[-41] + slope * math.log(40 / 1000), top[-1] + slope * math.log(1 / 1000)]
    assert tail.level[0, 0] == pytest.approx(max(levels))
    assert Tail.fit([(-ratios * 0 - 1, -ratios * 0 - 1)]).slope[0, 0] == 1


def test_a_climb_is_the_best_sum_over_all_beginnings_and_its_tail_leads_to_the_rate_of_false_alarms() -> None:
    rng = np.random.default_rng(3)
    stay, begin = rng.normal(-0.3, 1, (2, 40))
    height = np.zeros(())
    for press in range(40):
        height = climb(height, stay[press], begin[press])
        sums = [begin[first] + stay[first + 1 : press + 1].sum() for first in range(press + 1)]
        # Having begun worth nothing before the first press is as good as any beginning.
        none = [stay[first : press + 1].sum() for first in range(press + 2)]
        assert height == pytest.approx(max(0.0, *sums, *none))

    def ratios(presses: int, seed: int) -> Array:
        """Of a mean of 1 against 0, for numbers of mean 0."""
        return np.random.default_rng(seed).standard_normal((presses, 3, 1)) - 0.5

    learnt = ratios(10_000, 0)
    tail = Tail.fit([(learnt, learnt)])
    # Exact likelihood ratios climb to h with a chance of about exp(-h) (Wald).
    assert tail.slope[0, 0] == pytest.approx(1, abs=0.15)
    threshold = tail.level[0] + tail.slope[0] * np.log(1 / 2e-3)
    height, alarms = np.zeros((3, 1)), 0
    for press in ratios(40_000, 1):
        height = climb(height, press, press)
        alarms += int((height > threshold).sum())
        height = np.where(height > threshold, 0.0, height)
    # Eighty are allowed; the level is on the safe side by a factor of ten at most.
    assert 8 <= alarms <= 80
