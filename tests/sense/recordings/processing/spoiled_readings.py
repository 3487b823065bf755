"""Ways in which readings are spoilt, each for some of the fibres."""

import numpy as np


def dead(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[:, 1] = 1.5


def missing(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[:, 1] = np.nan


def saturating(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[len(readings) // 2 :, 1] = 3.3


def breaking(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[len(readings) // 2 :, 1] = 0.0


def jumping(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[len(readings) // 2 :, 1] += 0.2


def noisy(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[:, 1] += 0.1 * rng.standard_normal(len(readings))


def growing_noisy(readings: np.ndarray, rng: np.random.Generator) -> None:
    half = len(readings) // 2
    readings[half:, 1] += 0.1 * rng.standard_normal(len(readings) - half)


def swapped(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[:, [0, 1]] = readings[:, [1, 0]]


def spiky(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[rng.random(readings.shape) < 2e-3] += 0.5


def holed(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[rng.random(readings.shape) < 0.05] = np.nan


def torn(readings: np.ndarray, rng: np.random.Generator) -> None:
    readings[rng.random(len(readings)) < 0.1] = np.nan
