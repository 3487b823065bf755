"""Run time against error of the published objective: plainly, compiled, and from exact signals."""

from collections.abc import Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from padforge.benchmarks.contact import KNOTS, PUBLISHED, SAMPLES, plain_signals
from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.objectives.published import (
    disorder_area,
    joint_entropy,
    published_objective,
    published_presses,
    published_sharpness,
    quantize,
)
from padforge.design.settings import PUBLISHED_CONTACT


def trials() -> Iterator[BenchTrial]:
    """The objective of random pads; C grows with the samples, so its weight is scaled to what it is at 2000."""
    for knots in KNOTS:
        pad, case = Morphology.random(4, knots, seed=knots), f"N={knots}"
        true = cache(partial(exact_objective, pad))

        def judge(found: float, true: Any = true) -> Mapping[str, float]:
            return {"error": abs(found - true()) / true(), "visited": 1.0}

        for samples in SAMPLES:
            gamma = 5e-6 * (PUBLISHED - 1) / (samples - 1)
            weights = (1.0, 1e-7, gamma)
            yield BenchTrial(case, "plain", samples, partial(plain_objective, pad, samples, gamma), judge)
            compiled = partial(published_objective, pad, samples=samples, weights=weights)
            yield BenchTrial(case, "compiled", samples, compiled, judge)
        yield BenchTrial(case, "exact", 0, partial(exact_objective, pad))  # what the errors are of


def exact_objective(pad: Morphology) -> float:
    """The published objective from exact signals and the exact area of disorder."""
    levels = quantize(signals(pad, published_presses(pad.grid), PUBLISHED_CONTACT))
    entropy = joint_entropy(levels[:, : pad.grid]) + joint_entropy(levels[:, pad.grid :])
    disorder = disorder_area(pad) * (PUBLISHED - 1) / (pad.grid + 1)
    return 1 / (1 + entropy) + 1e-7 * published_sharpness(levels) + 5e-6 * disorder


def plain_objective(pad: Morphology, samples: int = PUBLISHED, gamma: float = 5e-6) -> float:
    """The published objective from `plain_signals` and numpy alone."""
    found = plain_signals(pad, published_presses(pad.grid), PUBLISHED_CONTACT, samples)
    span = np.ptp(found, axis=0)
    levels = np.ceil((found - found.min(axis=0)) / np.where(span > 0, span, 1) * 4096)
    entropy = 0.0
    for family in (levels[:, : pad.grid], levels[:, pad.grid :]):
        share = np.unique(family, axis=0, return_counts=True)[1] / len(family)
        entropy -= (share * np.log2(share)).sum()
    at = np.linspace(0, pad.grid + 1, samples)
    disorder = 0.0
    for travel in (0, 1):
        fibres = pad.knots[travel * pad.grid : (travel + 1) * pad.grid]
        curves = [PchipInterpolator(k[:, travel], k[:, 1 - travel])(at) for k in fibres]
        for i, lower in enumerate(curves):
            disorder -= sum(np.minimum(upper - lower, 0).sum() for upper in curves[i + 1 :])
    return float(1 / (1 + entropy) + 1e-7 * np.abs(np.diff(levels, 2, axis=0)).sum() + gamma * disorder)


BENCH = Bench("objective", trials, "relative error", ("plain", PUBLISHED), ("compiled", PUBLISHED), plain=("plain",))
