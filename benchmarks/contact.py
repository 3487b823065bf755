"""Run time against error of the contact kernel and of the published objective, beside plain and compiled ways."""

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numba import njit
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.contact import signals, signals_quantized
from padforge.design.kernels.pchip import pchip_sample
from padforge.design.morphology import Array, Morphology
from padforge.design.published import objective as published
from padforge.design.settings import PUBLISHED_CONTACT, Contact

SAMPLES = (250, 500, 1000, 2000, 4000, 8000, 16000)
KNOTS = (1, 5, 20)
GRIDS = (4, 8, 16, 32, 64, 128)
PUBLISHED = 2000  # samples of a fibre in the published program
BETA = 1e-7  # published weight of sharpness
GAMMA = 5e-6  # published weight of disorder


def plain_signals(pad: Morphology, presses: Array, contact: Contact, samples: int) -> Array:
    """Compute the published signals by NumPy and matplotlib: every sample of every fibre against every press."""
    along = np.linspace(0, pad.grid + 1, samples)
    angle = np.linspace(0, 2 * np.pi, (contact.sides or 256) + 1)
    corners = contact.radius * np.column_stack([np.cos(angle), np.sin(angle)])
    fibres = []
    for fibre, knots in enumerate(pad.knots):
        axis = fibre // pad.grid
        points = np.empty((samples, 2))
        points[:, axis] = along
        points[:, 1 - axis] = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])(along)
        fibres.append((points[:-1], np.abs(np.diff(points, axis=0)).sum(axis=1)))
    signals = np.empty((len(presses), len(fibres)))
    for q, press in enumerate(presses):
        outline = Outline(corners + press)
        signals[q] = [length[outline.contains_points(points)].sum() for points, length in fibres]
    return signals


@njit(error_model="numpy")  # not cached: changes of the kernel it calls would go unnoticed
def scanned_signals(knots: Any, presses: Any, radius: float, sides: int, samples: int) -> Any:
    """Compute the published signals by a compiled full scan: a circle test, then every edge of the polygon."""
    fibres = len(knots)
    step = (fibres // 2 + 1) / (samples - 1)
    apothem = radius * np.cos(np.pi / sides)
    normal = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    nx, ny = np.cos(normal), np.sin(normal)
    signals = np.zeros((len(presses), fibres))
    curve = np.empty(samples)
    for f in range(fibres):
        axis = 0 if f < fibres // 2 else 1
        pchip_sample(knots[f, :, axis].copy(), knots[f, :, 1 - axis].copy(), step, curve)
        for q in range(len(presses)):
            for i in range(samples - 1):
                along, across = i * step - presses[q, axis], curve[i] - presses[q, 1 - axis]
                if along * along + across * across > radius * radius:
                    continue
                dx, dy = (along, across) if axis == 0 else (across, along)
                inside = True
                for k in range(sides):
                    if dx * nx[k] + dy * ny[k] > apothem:
                        inside = False
                        break
                if inside:
                    signals[q, f] += step + abs(curve[i + 1] - curve[i])
    return signals


def reference_signals(pad: Morphology, presses: Array, contact: Contact) -> Array:
    """Compute signals by root finding on a dense sample, which shares no code with the exact kernel."""
    sides = contact.sides or 1
    normal = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    apothem = contact.radius * np.cos(np.pi / sides)
    signals = np.zeros((len(presses), len(pad.knots)))
    for fibre, knots in enumerate(pad.knots):
        axis = fibre // pad.grid
        curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
        normals = (np.cos(normal), np.sin(normal))[:: 1 if axis == 0 else -1]

        def outside(t: Any, press: Array, axis: int = axis, curve: Any = curve, normals: Any = normals) -> Any:
            """Signed distance from the polygon, negative inside."""
            along, across = t - press[axis], curve(t) - press[1 - axis]
            return np.max(np.multiply.outer(along, normals[0]) + np.multiply.outer(across, normals[1]), -1) - apothem

        for q, press in enumerate(presses):
            for begin, end in pairwise(knots[:, axis]):
                low, high = max(begin, press[axis] - contact.radius), min(end, press[axis] + contact.radius)
                if high <= low:
                    continue
                t = np.linspace(low, high, 400)
                sign = np.sign(outside(t, press))
                changes = np.flatnonzero(sign[:-1] * sign[1:] < 0)
                roots: list[Any] = [brentq(outside, t[i], t[i + 1], args=(press,), xtol=1e-15) for i in changes]
                for a, b in pairwise([low, *roots, high]):
                    if outside((a + b) / 2, press) <= 0:
                        signals[q, fibre] += b - a + abs(curve(b) - curve(a))
    return signals


def contact_trials() -> Iterator[BenchTrial]:
    """Yield the signals of random pads by all ways and sample counts, and the time per press for pads of GRIDS."""
    rng = np.random.default_rng(0)
    for knots in KNOTS:
        yield from _ways(Morphology.random(4, knots, seed=knots), rng.uniform(1, 4, (49, 2)), PUBLISHED_CONTACT)
    for grid in GRIDS:
        pad, presses = Morphology.straight(grid), rng.uniform(1, grid, (2000, 2))
        work = partial(signals, pad, presses, PUBLISHED_CONTACT)
        yield BenchTrial(f"grid {grid}, a press", "exact", 0, work, items=len(presses))


def _ways(pad: Morphology, presses: Array, contact: Contact) -> Iterator[BenchTrial]:
    case, work = f"N={pad.knots.shape[1] - 2}", partial(signals, pad, presses, contact)
    exact = cache(work)

    def evaluate(result: Array, truth: Callable[[], Array] = exact) -> dict[str, float]:
        return {"error": float(np.sqrt(((result - truth()) ** 2).mean() / (truth() ** 2).mean()))}

    for samples in SAMPLES:
        plain = partial(plain_signals, pad, presses, contact, samples)
        scan = partial(scanned_signals, pad.knots, presses, contact.radius, contact.sides or 0, samples)
        culled = partial(signals_quantized, pad, presses, contact, samples)
        yield BenchTrial(case, "plain", samples, plain, evaluate)
        yield BenchTrial(case, "scanned", samples, scan, evaluate)
        yield BenchTrial(case, "culled", samples, culled, evaluate)
    reference = cache(partial(reference_signals, pad, presses, contact))
    yield BenchTrial(case, "exact", 0, work, lambda result: evaluate(result, reference))


def objective_trials() -> Iterator[BenchTrial]:
    """Yield the objective of random pads by all ways and sample counts."""
    for knots in KNOTS:
        pad, case = Morphology.random(4, knots, seed=knots), f"N={knots}"
        exact = cache(partial(exact_objective, pad))

        def evaluate(objective: float, exact: Callable[[], float] = exact) -> dict[str, float]:
            return {"error": abs(objective - exact()) / exact()}

        for samples in SAMPLES:
            gamma = GAMMA * (PUBLISHED - 1) / (samples - 1)  # disorder is a sum over samples
            yield BenchTrial(case, "plain", samples, partial(plain_objective, pad, samples, gamma), evaluate)
            compiled = partial(published.published_objective, pad, samples=samples, weights=(1.0, BETA, gamma))
            yield BenchTrial(case, "compiled", samples, compiled, evaluate)


def exact_objective(pad: Morphology) -> float:
    """Compute the published objective from exact signals, and the disorder from a hundred times as many samples."""
    levels = published.quantize(signals(pad, published.published_presses(pad.grid), PUBLISHED_CONTACT))
    entropy = published.joint_entropy(levels[:, : pad.grid]) + published.joint_entropy(levels[:, pad.grid :])
    many = 100 * PUBLISHED
    disorder = published.published_terms(pad, samples=many)[0].disorder * (PUBLISHED - 1) / (many - 1)
    return float(1 / (1 + entropy) + BETA * np.abs(np.diff(levels, 2, axis=0)).sum() + GAMMA * disorder)


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


CONTACT = Bench(
    "contact",
    contact_trials,
    "relative error (rms)",
    reference=("scanned", PUBLISHED),
    default=("exact", 0),
    baselines=("plain", "scanned"),
    prepare=lambda: scanned_signals(Morphology.straight(1).knots, np.ones((1, 2)), 0.6, 30, 2),
)
OBJECTIVE = Bench(
    "objective",
    objective_trials,
    "relative error",
    reference=("plain", PUBLISHED),
    default=("compiled", PUBLISHED),
    baselines=("plain",),
)
