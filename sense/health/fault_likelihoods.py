"""How much likelier a press makes each fault of each fibre, and how much of that healthy presses bring together.
A fault hypothesis says what a fibre's readings would look like; a press gives the logarithm of how much likelier they
are under it than under health. Sums of these over presses that begin whenever they are worth it (CUSUM: E. S. Page,
"Continuous inspection schemes", Biometrika 41, 1954) rise steadily under the fault. How high they climb by chance is
measured on presses that the prediction was not fitted on: the heights of healthy climbs have an exponential tail
(D. Siegmund, "Sequential Analysis", 1985, chapter X), which leads from a rate of false alarms to a threshold.

How high likelihood ratios climb on healthy presses by chance, and so what height names a fibre.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from padforge.sense.arrays import MIN_SCALE_V, Array, Mask
from padforge.sense.health.trace_model import COMPONENTS, FREEDOM, RELEASED, REST, SUNK, TRACE

OFFSETS = (2.0, -2.0, 4.0, -4.0, 12.0, -12.0)
"""Offsets of the rest that are looked for, in spreads of the residual of the rest."""
HYPOTHESES = ("stuck", "silent", "weak", "odd", "noisy", *(f"offset {size:+g}" for size in OFFSETS))
"""Reads one value; answers nothing; answers by half; answers as to another press; is five times as noisy; and has a
rest that was moved by one of `OFFSETS`."""
GAINS = (0.0, 0.5)
NOISIER = 5.0
WIDER = 4.0
"""What is odd is either as another press would be, or off by this many times what is usual."""
MOST, MOST_OF_STEP = 6.0, 12.0
"""Most that one press adds, either way: no mishap in a single press names a fibre. A step within a trace may add more
where an offset begins, yet is worth less than the threshold until the rest has moved as well."""
STEPS = np.arange(3, TRACE - 2)
"""Readings of a trace at which a step is looked for; one nearer to an end could as well be a spike."""
LIBRARY = 64
"""Other presses that an odd answer is held against."""
SCALES = np.geomspace(0.5, 2.0, 9)
EXTRAS = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""Factors on predicted spreads, and what is added to them, among which the likeliest is chosen."""
LEAST_SCALE = 1e-3
"""Least spread of what is new in a rest: where nothing is, nothing is divided by it."""
MEDIAN_T = 0.7267
_FAR_T = 6.869
"""Median, and what one in a thousand lies beyond, of the absolute value of Student's t with `FREEDOM` degrees."""


@dataclass(frozen=True)
class FaultLikelihoods:
    """What healthy presses look like, beside what the network predicts.

    Attributes:
        scale, extra: (C, T) a predicted spread s means hypot(scale s, extra).
        floor: (C, D) noise of an answer's components.
        other_mean, other_spread: (L, C, D) predictions for other presses, to tell an answer to one of them.
        noise: (C,) usual noise, V. noise_centre, noise_spread: (C,) of the logarithm of the noise over the usual.
        constant: (C,) share of presses in which the fibre reads one value throughout.
        filters: (C, S, TRACE) matched filters of a step, 1/V.
        persistence: (1,) correlation of the rest's residual with that of the press before, of all fibres together.
            innovation: (1,) spread of what is new in it.
    """

    scale: Array
    extra: Array
    floor: Array
    other_mean: Array
    other_spread: Array
    noise: Array
    noise_centre: Array
    noise_spread: Array
    constant: Array
    filters: Array
    persistence: Array
    innovation: Array

    @classmethod
    def fit(
        cls, traces: Array, targets: Array, mean: Array, spread: Array, size: Array, rng: np.random.Generator
    ) -> "FaultLikelihoods":
        """From (Q, C, TRACE) healthy traces, their targets and predictions (Q, C, T) by members that did not learn
        from them, and `size` (C, T), V, of a target of 1."""
        scale, extra = _calibrated(targets - mean, spread)
        usual = np.median(noise_of(traces), axis=0)
        usual = np.where(usual > MIN_SCALE_V, usual, 1e-3 * size[:, 0])
        logs = _log_noise(traces, usual)
        centre = np.median(logs, axis=0)
        honest = np.hypot(spread * scale, extra)
        rest = ((targets - mean) / honest)[:, :, -1]
        persistence = np.clip([(rest[1:] * rest[:-1]).mean() / (rest**2).mean()], 0.0, 0.95)
        new = np.array([np.median(np.abs(rest[1:] - persistence * rest[:-1])) / MEDIAN_T])
        library = rng.choice(len(traces), LIBRARY)
        return cls(
            scale=scale,
            extra=extra,
            floor=usual[:, None] / size[:, :COMPONENTS],
            other_mean=mean[library, :, :COMPONENTS],
            other_spread=honest[library, :, :COMPONENTS],
            noise=usual,
            noise_centre=centre,
            noise_spread=np.maximum(np.median(np.abs(logs - centre), axis=0) / 0.6745, 0.1),
            constant=(_constant(traces).sum(axis=0) + 1) / (len(traces) + 2),
            filters=step_filters(traces, usual),
            persistence=persistence,
            innovation=np.maximum(new, LEAST_SCALE),
        )

    def answer_fit(self, targets: Array, mean: Array, spread: Array) -> Array:
        """(..., C, T) each to (..., C): log-likelihood of the answers of healthy fibres, up to a constant."""
        own = slice(0, COMPONENTS)
        return _log_t(targets[..., own], mean[..., own], self._honest(spread)[..., own]).sum(axis=-1)

    def _honest(self, spread: Array) -> Array:
        """Predicted spreads as they turned out on presses never seen."""
        return np.hypot(spread * self.scale, self.extra)

    def steps(self, traces: Array) -> Array:
        """(Q, C, TRACE) to (Q, C): the likeliest step within the trace, signed, in spreads of a healthy one."""
        answers = traces - traces[..., :REST].mean(axis=-1, keepdims=True)
        found = np.einsum("csw,qcw->qcs", self.filters, answers)
        return np.take_along_axis(found, np.abs(found).argmax(axis=-1)[..., None], axis=-1)[..., 0]

    def ratios(self, traces: Array, targets: Array, mean: Array, spread: Array) -> tuple[Array, Array]:
        """Log-likelihood ratios of all hypotheses against health, for presses that followed one another.

        Args:
            traces: (Q, C, TRACE) V. targets, mean, spread: (Q, C, T) what was measured and predicted. The first press
                counts as one that followed its like.

        Returns:
            (Q, C, H) if the fault was there at the press before, and (Q, C, H) if it began since. What is missing
            (NaN) speaks neither for nor against.
        """
        constant = np.where(_constant(traces), -np.log(self.constant), -MOST)
        silent, weak, odd = self._answers(targets, mean, spread)
        loud = np.log(NOISIER) / self.noise_spread
        noisy = _shift_ratio((_log_noise(traces, self.noise) - self.noise_centre) / self.noise_spread, loud)
        common = [constant, silent, weak, odd, noisy]
        # The residual of the rest fades slowly by itself: what a press tells of an offset is only what is new in it.
        rest = ((targets - mean) / self._honest(spread))[..., -1]
        new = (rest - self.persistence * _before(rest)) / self.innovation
        step = self.steps(traces)
        step = np.stack([step, _before(step)])
        staying, beginning = list(common), list(common)
        for offset in OFFSETS:
            sign, size = np.sign(offset), abs(offset) / self.innovation
            staying.append(_shift_ratio(sign * new, (1 - self.persistence) * size))
            jump = np.maximum(sign * step, 0.0).max(axis=0)
            # A step may have any size up to some hundred spreads: the logarithm of its density is about -4.
            stepped = np.clip(-_log_t(jump, 0.0, 1.0) - 4.0, 0.0, MOST_OF_STEP)
            beginning.append(_capped(_shift_ratio(sign * new, size)) + stepped)
        present = np.isfinite(traces).all(axis=-1, keepdims=True)
        stay, begin = np.stack(staying, axis=-1), np.stack(beginning, axis=-1)
        begin[..., : len(common)] = _capped(begin[..., : len(common)])
        return np.where(present, np.nan_to_num(_capped(stay)), 0.0), np.where(present, np.nan_to_num(begin), 0.0)

    def _answers(self, targets: Array, mean: Array, spread: Array) -> list[Array]:
        """Ratios (Q, C) of silent, weak and odd."""
        targets = np.nan_to_num(targets)
        healthy = self.answer_fit(targets, mean, spread)
        answer, mean = targets[..., :COMPONENTS], mean[..., :COMPONENTS]
        spread = self._honest(spread)[..., :COMPONENTS]
        gains = [_log_t(answer, gain * mean, np.hypot(gain * spread, self.floor)).sum(axis=-1) for gain in GAINS]
        others = _log_t(answer[..., None, :, :], self.other_mean, self.other_spread).sum(axis=-1)
        other = np.logaddexp.reduce(others, axis=-2) - np.log(LIBRARY)
        odd = np.logaddexp(other, _log_t(answer, mean, WIDER * spread).sum(axis=-1)) - np.log(2)
        return [hypothesis - healthy for hypothesis in (*gains, odd)]


def _capped(ratios: Array) -> Array:
    return np.clip(ratios, -MOST, MOST)


def _calibrated(error: Array, spread: Array) -> tuple[Array, Array]:
    """Scale and extra (C, T) that make the errors (Q, C, T) of predictions most likely.

    A network that learnt from few presses is too sure where it should be least in doubt; `extra` takes that back.
    """
    choices = [(scale, extra) for scale in SCALES for extra in EXTRAS]
    fits = np.stack([_log_t(error, 0.0, np.hypot(scale * spread, extra)).sum(axis=0) for scale, extra in choices])
    best = np.array(choices)[fits.argmax(axis=0)]
    return best[..., 0], best[..., 1]


def _before(values: Array) -> Array:
    """(Q, ...) values of the press before each; the first has none, and stands for it."""
    return np.concatenate([values[:1], values[:-1]])


def noise_of(traces: Array) -> Array:
    """(..., TRACE) to (...): mean difference of successive readings in the quiet thirds, V.

    The greatest quarter of the differences is left out: a spike is a spike, not noise.
    """
    quiet = (slice(0, REST), slice(REST + SUNK - 10, REST + SUNK), slice(TRACE - RELEASED + 10, TRACE))
    steps = np.sort(np.concatenate([np.abs(np.diff(traces[..., part], axis=-1)) for part in quiet], axis=-1), axis=-1)
    return steps[..., : steps.shape[-1] * 3 // 4].mean(axis=-1)


def _log_noise(traces: Array, usual: Array) -> Array:
    # A quarter keeps a press that happens to be without noise from standing out.
    return np.log(noise_of(traces) / usual + 0.25)


def _constant(traces: Array) -> Mask:
    return np.ptp(traces, axis=-1) == 0


def step_filters(traces: Array, noise: Array) -> Array:
    """Filters that answer 1 to the spread of a healthy trace and most to a step: step' S^-1 / sqrt(step' S^-1 step).

    S is the second moment of healthy answers (D. O. North, 1943). What lies out further, where the probe touches, is
    scaled down until its far quantile is that of Student's t.
    """
    step = (np.arange(TRACE) >= STEPS[:, None]).astype(float)
    step -= step[:, :REST].mean(axis=1, keepdims=True)
    answers = traces - traces[:, :, :REST].mean(axis=2, keepdims=True)
    filters = np.empty((traces.shape[1], len(STEPS), TRACE))
    for fibre, own in enumerate(np.moveaxis(answers, 1, 0)):
        filters[fibre] = np.linalg.solve(own.T @ own / len(own) + noise[fibre] ** 2 * np.eye(TRACE), step.T).T
        filters[fibre] /= np.sqrt((filters[fibre] * step).sum(axis=1, keepdims=True))
        far = np.quantile(np.abs(own @ filters[fibre].T), 0.999, axis=0)
        filters[fibre] /= np.maximum(far / _FAR_T, 1.0)[:, None]
    return filters


def _log_t(value: Array, mean: Array | float, spread: Array | float) -> Array:
    """Logarithm of the density of Student's t, up to a constant."""
    return -(FREEDOM + 1) / 2 * np.log1p(((value - mean) / spread) ** 2 / FREEDOM) - np.log(spread)


def _shift_ratio(value: Array, shift: Array | float) -> Array:
    """Log-likelihood ratio of a mean of at least `shift` > 0 against 0."""
    value = np.minimum(value, shift)
    return _log_t(value, shift, 1.0) - _log_t(value, 0.0, 1.0)


NEVER = 1e5
"""A height that no climb reaches."""
_LEAST_PEAKS = 30


def climb(height: Array, stay: Array, begin: Array) -> Array:
    """One press of CUSUM: the fault was there before, or begins now, or there is none (0)."""
    return np.maximum(np.maximum(height + stay, begin), 0.0)


@dataclass(frozen=True)
class Tail:
    """How rarely healthy presses climb high, by how many fibres are left out: the fewer tell, the more is chance.

    Attributes:
        level, slope: (K, H) a height h is passed exp(-(h - level) / slope) times a press, all fibres together, with
            0 .. K - 1 fibres left out.
    """

    level: Array
    slope: Array

    @classmethod
    def fit(cls, ratios: Sequence[tuple[Array, Array]]) -> "Tail":
        """From the ratios (Q, C, H) of healthy presses in their order, for each number of fibres left out.

        The slope is the mean excess of the highest tenth of the climbs. The level makes the highest climb of all no
        rarer than once in these Q presses. No slope is below 1, which exact likelihoods have (A. Wald).
        """
        rows = [_tail(stay, begin) for stay, begin in ratios]
        return cls(np.stack([level for level, _ in rows]), np.stack([slope for _, slope in rows]))

    def without(self, hypothesis: str) -> "Tail":
        """One by which no height of a hypothesis is rare."""
        level = self.level.copy()
        level[:, HYPOTHESES.index(hypothesis)] = NEVER
        return replace(self, level=level)

    def rarity(self, heights: Array, lost: int) -> Array:
        """(..., H) heights to minus the logarithm of how often a healthy pad passes them, a press, without `lost`
        fibres."""
        row = min(lost, len(self.level) - 1)
        return (heights - self.level[row]) / self.slope[row]


def _tail(stay: Array, begin: Array) -> tuple[Array, Array]:
    heights = np.empty_like(stay)
    height = np.zeros(stay.shape[1:])
    for press in range(len(stay)):
        height = heights[press] = climb(height, stay[press], begin[press])
    level, slope = np.empty(stay.shape[2]), np.empty(stay.shape[2])
    for hypothesis in range(stay.shape[2]):
        peaks = np.sort(np.concatenate([_peaks(series) for series in heights[:, :, hypothesis].T]))
        # Few climbs are a tail by themselves; zeros stand for the ones that were not worth beginning.
        peaks = np.concatenate([np.zeros(max(_LEAST_PEAKS + 1 - len(peaks), 0)), peaks])
        top = int(np.clip(len(peaks) // 10, _LEAST_PEAKS, 300))
        base = peaks[-top - 1]
        slope[hypothesis] = max((peaks[-top:] - base).mean(), 1.0)
        rates = np.log([top / len(stay), 1 / len(stay)])
        level[hypothesis] = (np.array([base, peaks[-1]]) + slope[hypothesis] * rates).max()
    return level, slope


def _peaks(heights: Array) -> Array:
    """Greatest height of every climb from 0."""
    up = heights > 0
    begins = np.flatnonzero(up & ~np.concatenate([[False], up[:-1]]))
    return np.maximum.reduceat(heights, begins) if len(begins) else np.empty(0)
