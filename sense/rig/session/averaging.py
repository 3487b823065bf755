"""From the samples of a converter to the readings of a recording: means over a whole number of samples."""

import numpy as np

from padforge.sense.recordings.processing.limits import Array
from padforge.sense.rig.devices.protocols import ConverterSamples


class Averager:
    """Means over `ratio` samples by the converter's own count, so that a lost sample shifts nothing.

    A mean is over the samples of its stretch that came; where none came there is no reading.

    Attributes:
        lost: samples that never came.
    """

    def __init__(self, ratio: int, channels: int) -> None:
        self._ratio = ratio
        self._index = 0
        self._waiting = np.empty((0, 2 + channels))  # stretch, time, volts
        self.lost = 0

    def feed(self, samples: ConverterSamples) -> tuple[Array, Array]:
        """Times (n,) and volts (n, C) of the stretches that are complete now; the others wait for more samples."""
        if len(samples.times_s) == 0:
            return np.empty(0), np.empty((0, self._waiting.shape[1] - 2))
        counts = self._index + np.arange(len(samples.times_s)) + np.cumsum(samples.missing)
        self._index = int(counts[-1]) + 1
        self.lost += int(samples.missing.sum())
        fresh = np.column_stack([counts // self._ratio, samples.times_s, samples.volts])
        rows = np.vstack([self._waiting, fresh])
        complete = rows[:, 0] < self._index // self._ratio
        self._waiting = rows[~complete]
        rows = rows[complete]
        stretches, first, count = np.unique(rows[:, 0], return_index=True, return_counts=True)
        if len(stretches) == 0:
            return np.empty(0), np.empty((0, rows.shape[1] - 2))
        means = np.add.reduceat(rows[:, 1:], first) / count[:, None]
        return means[:, 0], means[:, 1:]
