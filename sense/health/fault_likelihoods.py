"""Log-likelihood ratios of every fault of every fibre, their cumulative sums, and how high these rise by chance.

A press gives the log-likelihood ratio (llr) of a fault hypothesis against health. Their cumulative sums (CUSUM: E. S.
Page, "Continuous inspection schemes", Biometrika 41, 1954) rise steadily under the fault. How high they rise by chance
is measured on presses that the prediction was not trained on: peaks of healthy sums have an exponential tail (D.
Siegmund, "Sequential Analysis", 1985, chapter X), which converts a rate of false alarms into a threshold.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from padforge.sense.arrays import MIN_SCALE_V, Array
from padforge.sense.health.trace_model import COMPONENTS, HELD, REST, T_DEGREES, TRACE

OFFSETS = (2.0, -2.0, 4.0, -4.0, 12.0, -12.0)  # of the rest, in standard deviations of its residual
GAINS = {"no_response": 0.0, "reduced_gain": 0.5, "inverted": -1.0}
HYPOTHESES = ("stuck", *GAINS, "inconsistent", "noisy", *(f"offset {o:+g}" for o in OFFSETS))
"""Constant readings; a gain of `GAINS`; the response to another press; five times the noise; and a rest that has
shifted by one of `OFFSETS`."""
NOISE_FACTOR = 5.0  # increase of the noise of a noisy fibre
STD_FACTOR = 4.0  # an inconsistent response is that to another press, or has this many times the predicted deviation
MAX_LLR = 6.0  # largest contribution of one press, so that an accident in a single press is no fault
MAX_STEP_LLR = 12.0  # the same of a step within a trace; below the threshold until the rest has shifted as well
STEPS = np.arange(3, TRACE - 2)  # readings of a trace where a step is tested; nearer to an end it may be a spike
LIBRARY = 64  # other presses that an inconsistent response is compared with
MAX_HEIGHT = 1e5  # a height that no sum reaches
MIN_PEAKS = 30  # a tail is fitted to the highest tenth of the peaks, but to at least so many
MAX_PEAKS = 300  # and at most so many
MEDIAN_T = 0.7267  # median of |Student's t| with `T_DEGREES` degrees of freedom
FAR_T = 6.869  # 0.999 quantile of the same
MEDIAN_NORMAL = 0.6745  # median of |standard normal|
QUIET = 10  # last readings of the hold and of the release that show the noise alone
MIN_RELATIVE_NOISE = 1e-3  # noise of a fibre that reads without any, relative to its response
LOG_STEP_DENSITY = -4.0  # logarithm of the density of a step of any size, up to some hundred deviations
_CHUNK = 64  # presses that are compared with the library at once


@dataclass(frozen=True)
class FaultLikelihoods:
    """Distribution of healthy presses about the predictions of the networks."""

    std_scale: Array  # a predicted deviation s is calibrated to hypot(std_scale s, std_floor); shape (L, T)
    std_floor: Array
    noise_floor: Array  # noise of the components of a response; shape (L, D)
    library_mean: Array  # predictions for other presses; shape (LIBRARY, L, D)
    library_std: Array
    noise_v: Array  # median noise; shape (L,), V
    log_noise_mean: Array  # median and deviation of the logarithm of the noise over its median; shape (L,)
    log_noise_std: Array
    constant_share: Array  # share of presses in which the fibre is constant; shape (L,)
    step_filters: Array  # matched filters of a step; shape (L, S, TRACE), 1/V
    rest_autocorr: Array  # correlation of the rest's residual with that of the press before, of all fibres; shape (1,)
    innovation_std: Array  # standard deviation of the uncorrelated part of that residual; shape (1,)

    @classmethod
    def fit(
        cls, traces: Array, targets: Array, mean: Array, std: Array, target_scale_v: Array, rng: np.random.Generator
    ) -> "FaultLikelihoods":
        """Fit to healthy traces, targets, and predictions (Q, L, T) by members that were not trained on the press."""
        std_scale, std_floor = _calibrate_std(targets - mean, std)
        noise_v = np.median(estimate_noise(traces), axis=0)
        noise_v = np.where(noise_v > MIN_SCALE_V, noise_v, MIN_RELATIVE_NOISE * target_scale_v[:, 0])
        log_noise = _log_noise(traces, noise_v)
        log_noise_mean = np.median(log_noise, axis=0)
        log_noise_std = np.median(np.abs(log_noise - log_noise_mean), axis=0) / MEDIAN_NORMAL
        calibrated = np.hypot(std * std_scale, std_floor)
        offset_residual = ((targets - mean) / calibrated)[:, :, -1]
        autocov = (offset_residual[1:] * offset_residual[:-1]).mean()
        autocorr = np.clip([autocov / (offset_residual**2).mean()], 0.0, 0.95)
        innovation_std = np.array([np.median(np.abs(offset_residual[1:] - autocorr * offset_residual[:-1])) / MEDIAN_T])
        library = rng.choice(len(traces), LIBRARY)
        return cls(
            std_scale=std_scale,
            std_floor=std_floor,
            noise_floor=noise_v[:, None] / target_scale_v[:, :COMPONENTS],
            library_mean=mean[library, :, :COMPONENTS],
            library_std=calibrated[library, :, :COMPONENTS],
            noise_v=noise_v,
            log_noise_mean=log_noise_mean,
            log_noise_std=np.maximum(log_noise_std, 0.1),
            constant_share=((np.ptp(traces, axis=-1) == 0).sum(axis=0) + 1) / (len(traces) + 2),
            step_filters=fit_step_filters(traces, noise_v),
            rest_autocorr=autocorr,
            innovation_std=np.maximum(innovation_std, 1e-3),  # it is divided by
        )

    def log_likelihood_healthy(self, targets: Array, mean: Array, std: Array) -> Array:
        """Compute the log-likelihood (..., L) of the responses (..., L, T) of healthy fibres, up to a constant."""
        part = slice(0, COMPONENTS)
        return _joint_log_t(targets[..., part], mean[..., part], self._calibrated(std)[..., part])

    def largest_step(self, traces: Array) -> Array:
        """Compute the likeliest step (Q, L) within traces (Q, L, TRACE), signed, in deviations of healthy ones."""
        responses = traces - traces[..., :REST].mean(axis=-1, keepdims=True)
        steps = responses.swapaxes(0, 1) @ self.step_filters.mT  # (L, Q, S), by BLAS
        return np.take_along_axis(steps, np.abs(steps).argmax(axis=-1)[..., None], axis=-1)[..., 0].T

    def log_likelihood_ratios(self, traces: Array, targets: Array, mean: Array, std: Array) -> tuple[Array, Array]:
        """Compute the log-likelihood ratios (Q, L, H) of all hypotheses against health, for successive presses.

        Traces (Q, L, TRACE) are in V; targets, their predicted mean and std are (Q, L, T). The first press is its own
        predecessor. Returns `llr_continuing` if the fault was present at the press before, and `llr_onset` if it
        has begun since; 0 for a fibre that misses readings.
        """
        constant = np.where(np.ptp(traces, axis=-1) == 0, -np.log(self.constant_share), -MAX_LLR)
        noise_shift = np.log(NOISE_FACTOR) / self.log_noise_std
        log_noise = (_log_noise(traces, self.noise_v) - self.log_noise_mean) / self.log_noise_std
        common = [constant, *self._response_llrs(targets, mean, std), _shift_llr(log_noise, noise_shift)]
        # The residual of the rest decays slowly also without a fault: only its innovation is evidence of an offset.
        offset_residual = ((targets - mean) / self._calibrated(std))[..., -1]
        innovation = (offset_residual - self.rest_autocorr * _previous(offset_residual)) / self.innovation_std
        step = self.largest_step(traces)
        step = np.stack([step, _previous(step)])
        continuing, onset = list(common), [np.clip(llr, -MAX_LLR, MAX_LLR) for llr in common]
        for offset in OFFSETS:
            sign, size = np.sign(offset), abs(offset) / self.innovation_std
            continuing.append(_shift_llr(sign * innovation, (1 - self.rest_autocorr) * size))
            jump = np.maximum(sign * step, 0.0).max(axis=0)
            step_llr = np.clip(LOG_STEP_DENSITY - _log_t(jump, 0.0, 1.0), 0.0, MAX_STEP_LLR)
            onset.append(np.clip(_shift_llr(sign * innovation, size), -MAX_LLR, MAX_LLR) + step_llr)
        valid = np.isfinite(traces).all(axis=-1, keepdims=True)
        llrs = np.clip(np.stack(continuing, axis=-1), -MAX_LLR, MAX_LLR), np.stack(onset, axis=-1)
        llr_continuing, llr_onset = (np.where(valid, np.nan_to_num(llr), 0.0) for llr in llrs)
        return llr_continuing, llr_onset

    def _response_llrs(self, targets: Array, mean: Array, std: Array) -> list[Array]:
        """Return the ratios (Q, L) of `GAINS`, and of an inconsistent response."""
        targets = np.nan_to_num(targets)
        healthy = self.log_likelihood_healthy(targets, mean, std)
        response, mean = targets[..., :COMPONENTS], mean[..., :COMPONENTS]
        std = self._calibrated(std)[..., :COMPONENTS]
        gains = [_joint_log_t(response, gain * mean, np.hypot(gain * std, self.noise_floor)) for gain in GAINS.values()]
        # In chunks, since the comparison of a press with the library takes kilobytes a fibre.
        parts = (response[first : first + _CHUNK, None] for first in range(0, len(response), _CHUNK))
        others = (_joint_log_t(part, self.library_mean, self.library_std) for part in parts)
        other = np.concatenate([np.logaddexp.reduce(each, axis=1) for each in others]) - np.log(LIBRARY)
        inconsistent = np.logaddexp(other, _joint_log_t(response, mean, STD_FACTOR * std)) - np.log(2)
        return [hypothesis - healthy for hypothesis in (*gains, inconsistent)]

    def _calibrated(self, std: Array) -> Array:
        return np.hypot(std * self.std_scale, self.std_floor)


def _calibrate_std(residual: Array, std: Array) -> tuple[Array, Array]:
    """Choose the scale and floor (L, T) that make residuals (Q, L, T) of predictions most likely.

    A network trained on few presses is overconfident where it should be least certain; the floor corrects that.
    """
    floors = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
    choices = [(scale, floor) for scale in np.geomspace(0.5, 2.0, 9) for floor in floors]
    fits = np.stack([_log_t(residual, 0.0, np.hypot(scale * std, floor)).sum(axis=0) for scale, floor in choices])
    best = np.array(choices)[fits.argmax(axis=0)]
    return best[..., 0], best[..., 1]


def _previous(values: Array) -> Array:
    """Return the values (Q, ...) of the press before each; the first stands for its own."""
    return np.concatenate([values[:1], values[:-1]])


def estimate_noise(traces: Array) -> Array:
    """Estimate the noise (...), V, of traces (..., TRACE): mean step in quiet parts, without the largest quarter."""
    quiet = (slice(0, REST), slice(REST + HELD - QUIET, REST + HELD), slice(TRACE - QUIET, TRACE))
    steps = np.sort(np.concatenate([np.abs(np.diff(traces[..., part], axis=-1)) for part in quiet], axis=-1), axis=-1)
    return steps[..., : steps.shape[-1] * 3 // 4].mean(axis=-1)


def _log_noise(traces: Array, noise_v: Array) -> Array:
    # 0.25 is added so that a press that happens to have no noise is not an outlier.
    return np.log(estimate_noise(traces) / noise_v + 0.25)


def fit_step_filters(traces: Array, noise_v: Array) -> Array:
    """Fit matched filters of steps: step' S^-1 / sqrt(step' S^-1 step), 1 for a standard deviation of healthy traces.

    S is the second moment of healthy responses (D. O. North, 1943). Filters with heavier tails, where the probe
    touches, are scaled down until their far quantile is that of Student's t.
    """
    step = (np.arange(TRACE) >= STEPS[:, None]).astype(float)
    step -= step[:, :REST].mean(axis=1, keepdims=True)
    responses = traces - traces[:, :, :REST].mean(axis=2, keepdims=True)
    filters = np.empty((traces.shape[1], len(STEPS), TRACE))
    for fibre, response in enumerate(np.moveaxis(responses, 1, 0)):
        covariance = response.T @ response / len(response) + noise_v[fibre] ** 2 * np.eye(TRACE)
        filters[fibre] = np.linalg.solve(covariance, step.T).T
        filters[fibre] /= np.sqrt((filters[fibre] * step).sum(axis=1, keepdims=True))
        far = np.quantile(np.abs(response @ filters[fibre].T), 0.999, axis=0)
        filters[fibre] /= np.maximum(far / FAR_T, 1.0)[:, None]
    return filters


def _log_t(value: Array, mean: Array | float, std: Array | float) -> Array:
    """Return the logarithm of the density of Student's t, up to a constant."""
    return -(T_DEGREES + 1) / 2 * np.log1p(((value - mean) / std) ** 2 / T_DEGREES) - np.log(std)


def _joint_log_t(value: Array, mean: Array, std: Array) -> Array:
    """Return the sum of `_log_t` over the last axis: the logarithm of a product, in place of one for each factor."""
    factors = 1 + ((value - mean) / std) ** 2 / T_DEGREES
    return -(T_DEGREES + 1) / 2 * np.log(factors.prod(axis=-1)) - np.log(std.prod(axis=-1))


def _shift_llr(value: Array, shift: Array | float) -> Array:
    """Return the log-likelihood ratio of a mean of at least `shift` > 0 against 0."""
    value = np.minimum(value, shift)
    return _log_t(value, shift, 1.0) - _log_t(value, 0.0, 1.0)


def cusum_update(height: Array, llr_continuing: Array, llr_onset: Array) -> Array:
    """Update cumulative sums by a press, at which the fault was present before, begins, or is absent (0)."""
    return np.maximum(np.maximum(height + llr_continuing, llr_onset), 0.0)


@dataclass(frozen=True)
class ExceedanceModel:
    """Exponential tail of the peaks of healthy sums: a height h is exceeded exp(-(h - level) / slope) times a press."""

    level: Array  # for all fibres together, and 0 .. K - 1 failed ones; shape (K, H)
    slope: Array  # shape (K, H)

    @classmethod
    def fit(cls, llrs: Sequence[tuple[Array, Array]]) -> "ExceedanceModel":
        """Fit to the ratios (Q, L, H), continuing and onset, of successive healthy presses, by the number of failures.

        The presses are repeated for several sets of failed fibres, and the sums continue from one set to the next.

        The slope is the mean excess of the highest tenth of the peaks, but at least 1, which exact likelihoods have
        (A. Wald). The level is so high that the model expects the highest peak at least once in Q presses.
        """
        levels, slopes = zip(*[_fit_tail(*each) for each in llrs], strict=True)
        return cls(np.stack(levels), np.stack(slopes))

    def neg_log_p(self, heights: Array, n_failed: int) -> Array:
        """Return minus the logarithm of how often a press of a healthy pad exceeds heights (..., H)."""
        row = min(n_failed, len(self.level) - 1)
        return (heights - self.level[row]) / self.slope[row]


def _fit_tail(llr_continuing: Array, llr_onset: Array) -> tuple[Array, Array]:
    heights = np.empty_like(llr_continuing)
    height = np.zeros(llr_continuing.shape[1:])
    for press in range(len(heights)):
        height = heights[press] = cusum_update(height, llr_continuing[press], llr_onset[press])
    level, slope = np.empty(heights.shape[2]), np.empty(heights.shape[2])
    for hypothesis in range(heights.shape[2]):
        peaks = np.sort(np.concatenate([_peaks(series) for series in heights[:, :, hypothesis].T]))
        # Zeros, the peaks of sums that never left 0, are added if there are too few peaks for a tail.
        peaks = np.concatenate([np.zeros(max(MIN_PEAKS + 1 - len(peaks), 0)), peaks])
        top = int(np.clip(len(peaks) // 10, MIN_PEAKS, MAX_PEAKS))
        base = peaks[-top - 1]
        slope[hypothesis] = max((peaks[-top:] - base).mean(), 1.0)
        rates = np.log([top / len(heights), 1 / len(heights)])
        level[hypothesis] = (np.array([base, peaks[-1]]) + slope[hypothesis] * rates).max()
    return level, slope


def _peaks(heights: Array) -> Array:
    """Return the largest height of every excursion from 0."""
    above = heights > 0
    starts = np.flatnonzero(above & ~np.concatenate([[False], above[:-1]]))
    return np.maximum.reduceat(heights, starts) if len(starts) else np.empty(0)
