"""Run time against error of the published objective: plain, compiled, and from exact signals."""

from collections.abc import Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from padforge.benchmarks.contact import KNOTS, PUBLISHED, SAMPLES, plain_signals
from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.objectives import published
from padforge.design.settings import PUBLISHED_CONTACT

BETA, GAMMA = 1e-7, 5e-6
"""Published weights of sharpness and disorder."""


def trials() -> Iterator[BenchTrial]:
    """Yield the objective of random pads by all ways and sample counts."""
    for knots in KNOTS:
        pad, case = Morphology.random(4, knots, seed=knots), f"N={knots}"
        exact = cache(partial(exact_objective, pad))

        def evaluate(objective: float, exact: Any = exact) -> Mapping[str, float]:
            return {"error": abs(objective - exact()) / exact(), "visited": 1.0}

        for samples in SAMPLES:
            gamma = GAMMA * (PUBLISHED - 1) / (samples - 1)  # disorder is a sum over samples
            yield BenchTrial(case, "plain", samples, partial(plain_objective, pad, samples, gamma), evaluate)
            compiled = partial(published.published_objective, pad, samples=samples, weights=(1.0, BETA, gamma))
            yield BenchTrial(case, "compiled", samples, compiled, evaluate)
        yield BenchTrial(case, "exact", 0, partial(exact_objective, pad))  # the reference of the errors


def exact_objective(pad: Morphology) -> float:
    """Compute the published objective from exact signals and the exact area of disorder."""
    levels = published.quantize(signals(pad, published.published_presses(pad.grid), PUBLISHED_CONTACT))
    entropy = published.joint_entropy(levels[:, : pad.grid]) + published.joint_entropy(levels[:, pad.grid :])
    disorder = published.disorder_area(pad) * (PUBLISHED - 1) / (pad.grid + 1)
    return 1 / (1 + entropy) + BETA * published.published_sharpness(levels) + GAMMA * disorder


def plain_objective(pad: Morphology, samples: int = PUBLISHED, gamma: float = GAMMA) -> float:
    """Compute the published objective from `plain_signals` by NumPy alone."""
    responses = plain_signals(pad, published.published_presses(pad.grid), PUBLISHED_CONTACT, samples)
    span = np.ptp(responses, axis=0)
    levels = np.ceil((responses - responses.min(axis=0)) / np.where(span > 0, span, 1) * 4096)
    entropy = disorder = 0.0
    for family in (levels[:, : pad.grid], levels[:, pad.grid :]):
        share = np.unique(family, axis=0, return_counts=True)[1] / len(family)
        entropy -= (share * np.log2(share)).sum()
    along = np.linspace(0, pad.grid + 1, samples)
    for axis in (0, 1):
        fibres = pad.knots[axis * pad.grid : (axis + 1) * pad.grid]
        curves = [PchipInterpolator(knots[:, axis], knots[:, 1 - axis])(along) for knots in fibres]
        for i, lower in enumerate(curves):
            disorder -= sum(np.minimum(upper - lower, 0).sum() for upper in curves[i + 1 :])
    return float(1 / (1 + entropy) + BETA * np.abs(np.diff(levels, 2, axis=0)).sum() + gamma * disorder)


BENCH = Bench(
    "objective",
    trials,
    "relative error",
    reference=("plain", PUBLISHED),
    default=("compiled", PUBLISHED),
    baselines=("plain",),
)
