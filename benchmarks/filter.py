"""Error of filters on a simulated fibre against run time, and how near robust filters come to the optimum."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import linprog

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.sense.arrays import Array
from padforge.sense.signals.filters import running_median, total_variation

READINGS = 10_000
LONG = (100_000, 1_000_000)  # readings of long recordings
PUBLISHED = 4.0  # the published regularisation weight lam
LAMS = (1.0, 2.0, 4.0, 6.0, 8.0)  # weights of the robust filter, readings
LAMS_V = (0.001, 0.003, 0.01, 0.03, 0.1)  # weights of the filter of squares, V
WIDTHS = (3, 5, 9, 15, 21)  # of the running median, readings
STEPS = (10, 30, 100, 300, 1000)  # of the iterative solver

PERIOD = 40  # readings from press to press; half of them pressed
LSB_V = 3.3 / 1023  # step of a 10-bit converter, V


def trials() -> Iterator[BenchTrial]:
    """Yield all filters on a fibre of READINGS, other solvers of the published filter, and long recordings.

    The error is the rms deviation from the clean signal, relative to that of the readings; "excess" is the relative
    excess of the robust objective at the published lam over its minimum.
    """
    clean, noisy = fibre(READINGS, np.random.default_rng(0))
    minimum = cache(lambda: objective(noisy, linear_program(noisy, PUBLISHED), PUBLISHED))

    def evaluate(solves: bool, filtered: Array) -> Mapping[str, float | None]:
        error = np.sqrt(((filtered - clean) ** 2).mean() / ((noisy - clean) ** 2).mean())
        excess = objective(noisy, filtered, PUBLISHED) / minimum() - 1 if solves else None
        return {"error": float(error), "excess": excess}

    def trial(way: str, size: float, work: Callable[..., Array], *options: Any) -> BenchTrial:
        solves = way in ("LP (HiGHS)", "iterative") or (way, size) == ("robust", PUBLISHED)
        return BenchTrial(f"{READINGS} readings", way, size, partial(work, noisy, *options), partial(evaluate, solves))

    yield from (trial("robust", lam, total_variation, lam) for lam in LAMS)
    yield from (trial("squares", lam, total_variation, lam, "squares") for lam in LAMS_V)
    yield from (trial("median", width, running_median, width) for width in WIDTHS)
    yield trial("LP (HiGHS)", PUBLISHED, linear_program, PUBLISHED)
    yield from (trial("iterative", steps, admm, PUBLISHED, steps) for steps in STEPS)
    for count in LONG:
        readings = fibre(count, np.random.default_rng(0))[1]
        for way, size, work in (
            ("robust", PUBLISHED, partial(total_variation, readings, PUBLISHED)),
            ("robust", 1000, partial(total_variation, readings, 1000)),
            ("squares", LAMS_V[2], partial(total_variation, readings, LAMS_V[2], "squares")),
            ("median", WIDTHS[3], partial(running_median, readings, WIDTHS[3])),
        ):
            yield BenchTrial(f"{count} readings", way, size, work, lambda filtered: {"excess": None})


def fibre(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Simulate a fibre under periodic presses: clean volts, and readings of a noisy 10-bit converter.

    A press stretches the fibre by up to 0.1 V, or not at all; the silicone creeps while pressed and recovers slowly.
    The noise is 1.5 LSB; one reading in a hundred is an outlier of up to 60 LSB.
    """
    presses, phase = -(-count // PERIOD), np.arange(PERIOD // 2)
    height = rng.uniform(0.01, 0.1, presses) * (rng.random(presses) < 0.5)
    pressed = 1 - 0.2 * (1 - np.exp(-phase / 8))
    released = -0.1 * np.exp(-phase / 5)
    clean = 2 + (height[:, None] * np.concatenate([pressed, released])).ravel()[:count]
    noise = 1.5 * rng.normal(size=count) + (rng.random(count) < 0.01) * rng.uniform(-60, 60, count)
    return clean, np.round(clean / LSB_V + noise) * LSB_V


def objective(readings: Array, filtered: Array, lam: float) -> float:
    """Return the objective of robust total-variation denoising."""
    return float(np.abs(readings - filtered).sum() + lam * np.abs(np.diff(filtered)).sum())


def linear_program(readings: Array, lam: float) -> Array:
    """Minimise the objective by HiGHS on the dual linear program, which it solves several times faster.

    The dual maximises y.s over s = D'z with |s_i| <= 1 and |z_i| <= lam; its marginals of s = D'z are the minimiser.
    """
    count, links = len(readings), len(readings) - 1
    difference = sparse.eye_array(links, count, k=1) - sparse.eye_array(links, count)
    solution = linprog(
        np.concatenate([-readings, np.zeros(links)]),
        A_eq=sparse.hstack([sparse.eye_array(count), -difference.T], format="csc"),
        b_eq=np.zeros(count),
        bounds=[(-1, 1)] * count + [(-lam, lam)] * links,
        method="highs",
    )
    return -solution.eqlin.marginals


def admm(readings: Array, lam: float, steps: int) -> Array:
    """Approach the minimiser by the alternating direction method of multipliers (Boyd et al. 2011).

    Residuals and differences are split from x; every step solves one tridiagonal system, factorised once.
    """
    count = len(readings)
    bands = np.full((2, count), 3.0)  # I + D'D
    bands[0], bands[1, [0, -1]] = -1, 2
    factor = cholesky_banded(bands)
    threshold = 0.3 * LSB_V  # tuned: nearest to the minimum after 1000 steps
    x, residual_dual, difference_dual = readings, np.zeros(count), np.zeros(count - 1)
    residual, difference = np.zeros(count), np.diff(readings)
    for _ in range(steps):
        # 1. least squares of x
        change = difference - difference_dual
        target = readings - residual + residual_dual
        target[1:] += change
        target[:-1] -= change
        x = cho_solve_banded((factor, False), target)
        # 2. soft thresholds
        residual = _soft_threshold(readings - x + residual_dual, threshold)
        difference = _soft_threshold(np.diff(x) + difference_dual, lam * threshold)
        # 3. dual variables
        residual_dual += readings - x - residual
        difference_dual += np.diff(x) - difference
    return x


def _soft_threshold(values: Array, threshold: float) -> Array:
    return np.sign(values) * np.maximum(np.abs(values) - threshold, 0)


BENCH = Bench(
    "filter",
    trials,
    "rms error (share of the noise)",
    reference=("LP (HiGHS)", PUBLISHED),
    default=("robust", PUBLISHED),
    baselines=("LP (HiGHS)", "iterative"),
)
