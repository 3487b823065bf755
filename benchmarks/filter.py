"""What filters make of a signal that is known, and how near to the minimum they come, against the time they take."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import linprog

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.sense.recordings.processing.filters import running_median, total_variation
from padforge.sense.recordings.processing.limits import Array

READINGS = 10_000
LONG = (100_000, 1_000_000)
PUBLISHED = 4.0
"""The published lam."""
LAMS = (1.0, 2.0, 4.0, 6.0, 8.0)
LAMS_V = (0.001, 0.003, 0.01, 0.03, 0.1)
WIDTHS = (3, 5, 9, 15, 21)
STEPS = (10, 30, 100, 300, 1000)

_CYCLE = 40  # readings from press to press, half of them pressed
_STEP_V = 3.3 / 1023  # of the converter


def trials() -> Iterator[BenchTrial]:
    """Filters of a made-up fibre of READINGS, the published one by other means too, and of LONG.

    The error is the rms deviation from the clean signal as a share of that of the readings; "excess" is the share by
    which the robust objective at the published lam exceeds its minimum.
    """
    clean, noisy = fibre(READINGS, np.random.default_rng(0))

    @cache
    def least() -> float:
        return objective(noisy, linear_program(noisy, PUBLISHED), PUBLISHED)

    def error(found: Array) -> float:
        return float(np.sqrt(((found - clean) ** 2).mean() / ((noisy - clean) ** 2).mean()))

    def filtered(found: Array) -> Mapping[str, float | None]:
        return {"error": error(found), "excess": None}

    def minimised(found: Array) -> Mapping[str, float | None]:
        return {"error": error(found), "excess": objective(noisy, found, PUBLISHED) / least() - 1}

    case = f"{READINGS} readings"
    for lam in LAMS:
        judge = minimised if lam == PUBLISHED else filtered
        yield BenchTrial(case, "robust", lam, partial(total_variation, noisy, lam), judge)
    for lam in LAMS_V:
        yield BenchTrial(case, "squares", lam, partial(total_variation, noisy, lam, "squares"), filtered)
    for width in WIDTHS:
        yield BenchTrial(case, "median", width, partial(running_median, noisy, width), filtered)
    yield BenchTrial(case, "LP (HiGHS)", PUBLISHED, partial(linear_program, noisy, PUBLISHED), minimised)
    for steps in STEPS:
        yield BenchTrial(case, "iterative", steps, partial(iterated, noisy, PUBLISHED, steps), minimised)
    for count in LONG:
        long = fibre(count, np.random.default_rng(0))[1]
        ways: dict[tuple[str, float], Callable[[], Array]] = {
            ("robust", PUBLISHED): partial(total_variation, long, PUBLISHED),
            ("robust", 1000): partial(total_variation, long, 1000),
            ("squares", LAMS_V[2]): partial(total_variation, long, LAMS_V[2], "squares"),
            ("median", WIDTHS[3]): partial(running_median, long, WIDTHS[3]),
        }
        for (way, size), work in ways.items():
            yield BenchTrial(f"{count} readings", way, size, work, lambda found: {"excess": None})


def fibre(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """A made-up fibre under one press after the other: (R,) clean volts, and as a noisy 10-bit converter reads them.

    A press stretches the fibre by up to 0.1 V, or not at all; the silicone creeps while pressed and recovers slowly.
    The noise has 1.5 converter steps, and one reading in a hundred is off by up to 60.
    """
    presses = -(-count // _CYCLE)
    phase = np.arange(_CYCLE // 2)
    height = rng.uniform(0.01, 0.1, presses) * (rng.random(presses) < 0.5)
    pressed = 1 - 0.2 * (1 - np.exp(-phase / 8))
    released = -0.1 * np.exp(-phase / 5)
    clean = 2 + (height[:, None] * np.concatenate([pressed, released])).ravel()[:count]
    noise = 1.5 * rng.normal(size=count) + (rng.random(count) < 0.01) * rng.uniform(-60, 60, count)
    return clean, np.round(clean / _STEP_V + noise) * _STEP_V


def objective(readings: Array, filtered: Array, lam: float) -> float:
    """What robust total variation minimises."""
    return float(np.abs(readings - filtered).sum() + lam * np.abs(np.diff(filtered)).sum())


def linear_program(readings: Array, lam: float) -> Array:
    """The minimiser by scipy's HiGHS, from the dual linear program, which it solves several times faster.

    The dual: greatest y.s over s = D'z with |s_i| <= 1 and |z_i| <= lam; the minimiser is what s = D'z costs.
    """
    count = len(readings)
    links = count - 1
    difference = sparse.eye_array(links, count, k=1) - sparse.eye_array(links, count)
    solved = linprog(
        np.concatenate([-readings, np.zeros(links)]),
        A_eq=sparse.hstack([sparse.eye_array(count), -difference.T], format="csc"),
        b_eq=np.zeros(count),
        bounds=[(-1, 1)] * count + [(-lam, lam)] * links,
        method="highs",
    )
    return -solved.eqlin.marginals


def iterated(readings: Array, lam: float, steps: int) -> Array:
    """The minimiser approached by the alternating direction method of multipliers (Boyd et al. 2011).

    Residuals and differences are split from x; each step solves one tridiagonal system, factorised once.
    """
    count = len(readings)
    bands = np.full((2, count), 3.0)  # of I + D'D
    bands[0], bands[1, [0, -1]] = -1, 2
    factor = cholesky_banded(bands)
    tight = 0.3 * _STEP_V  # threshold of residuals: by trial, what comes nearest in 1000 steps
    x, multiplier, coupled = readings, np.zeros(count), np.zeros(count - 1)
    residual, difference = np.zeros(count), np.diff(readings)
    for _ in range(steps):
        rise = difference - coupled
        target = readings - residual + multiplier
        target[1:] += rise
        target[:-1] -= rise
        x = cho_solve_banded((factor, False), target)
        residual = _shrunk(readings - x + multiplier, tight)
        difference = _shrunk(np.diff(x) + coupled, lam * tight)
        multiplier += readings - x - residual
        coupled += np.diff(x) - difference
    return x


def _shrunk(values: Array, threshold: float) -> Array:
    return np.sign(values) * np.maximum(np.abs(values) - threshold, 0)


BENCH = Bench(
    "filter",
    trials,
    "rms error (share of the noise)",
    ("LP (HiGHS)", PUBLISHED),
    ("robust", PUBLISHED),
    plain=("LP (HiGHS)", "iterative"),
)
