"""What of an answer is a smooth function of place, whatever kind of function: a Gaussian process of two widths.

It says which channels answer at all, and what is left over as noise where neither a pad nor place explains it.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from padforge.sense.twin.responses import Responses

WIDTHS = (0.4, 0.8)
"""Standard deviations of the kernels that are tried, grid units."""
PRESSES = 800
"""Presses that are looked at, at most: the eigenvalues of a matrix of that size are found."""
RATIOS = np.append(0.0, np.geomspace(1e-2, 1e4, 61))
"""Variances of the function that are tried, as multiples of that of the noise."""


class Smooth(NamedTuple):
    """What a channel shows.

    Attributes:
        noise: (C,) standard deviation of what no smooth function of place explains, in units of the values.
        certainty: (C,) by how much a function of place is more probable than none, natural logarithm.
    """

    noise: np.ndarray
    certainty: np.ndarray


def smooth_function(values: Responses, unit_mm: float) -> Smooth:
    """The most probable smooth function of place of each channel; NaN and 0 for one with fewer than 10 answers."""
    places = values.places_mm[:PRESSES] / unit_mm
    squares = ((places[:, None, :] - places) ** 2).sum(axis=2)

    @cache
    def eigen(rows: bytes, width: float) -> tuple[np.ndarray, np.ndarray]:
        there = np.frombuffer(rows, bool)
        return np.linalg.eigh(np.exp(squares[np.ix_(there, there)] * (-0.5 / width**2)))

    noise, certainty = np.full(values.volts.shape[1], np.nan), np.zeros(values.volts.shape[1])
    for channel in range(values.volts.shape[1]):
        there = np.ascontiguousarray(values.there[:PRESSES, channel])
        if there.sum() < 10:
            continue
        volts = values.volts[:PRESSES, channel][there]
        found = [_likeliest(*eigen(there.tobytes(), width), volts - volts.mean()) for width in WIDTHS]
        noise[channel], certainty[channel] = max(found, key=lambda pair: pair[1])
    return Smooth(noise, certainty)


def _likeliest(sizes: np.ndarray, vectors: np.ndarray, volts: np.ndarray) -> tuple[float, float]:
    """Noise, and logarithm of the likelihood against that of no function, of the likeliest of `RATIOS`."""
    turned = (vectors.T @ volts) ** 2
    spread = 1 + RATIOS[:, None] * np.maximum(sizes, 0)
    noise = np.maximum((turned / spread).mean(axis=1), 1e-300)
    likelihood = -0.5 * (len(volts) * np.log(noise) + np.log(spread).sum(axis=1))
    best = int(np.argmax(likelihood))
    return float(np.sqrt(noise[best])), float(likelihood[best] - likelihood[0])
