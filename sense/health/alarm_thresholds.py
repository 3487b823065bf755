"""How high likelihood ratios climb on healthy presses by chance, and so what height names a fibre."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from padforge.sense.recordings.processing.limits import Array

from padforge.sense.health.fault_likelihoods import HYPOTHESES

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
