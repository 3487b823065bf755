"""Run time against error of the contact kernel, beside the published rule, plainly and compiled."""

from collections.abc import Iterator, Mapping
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numba import njit
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.contact import quantized_signals_and_samples, signals_and_spans, signals_sparse
from padforge.design.kernels.pchip import pchip_sample
from padforge.design.morphology import Array, Morphology
from padforge.design.settings import PUBLISHED_CONTACT, Contact

SAMPLES = (250, 500, 1000, 2000, 4000, 8000, 16000)
KNOTS = (1, 5, 20)
GRIDS = (4, 8, 16, 32, 64, 128)
PUBLISHED = 2000
"""Samples of a fibre in the published program."""


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


def trials() -> Iterator[BenchTrial]:
    """Yield the signals of random pads by all ways and sample counts, and the time per press for pads of GRIDS."""
    rng = np.random.default_rng(0)
    for knots in KNOTS:
        yield from _ways(Morphology.random(4, knots, seed=knots), rng.uniform(1, 4, (49, 2)), PUBLISHED_CONTACT)
    for grid in GRIDS:
        pad, presses = Morphology.straight(grid), rng.uniform(1, grid, (2000, 2))

        def visited(result: object, pad: Morphology = pad, presses: Array = presses) -> Mapping[str, float]:
            spans = signals_and_spans(pad, presses[:100], PUBLISHED_CONTACT)[1]
            return {"visited": spans / (100 * len(pad.knots))}

        work = partial(signals_sparse, pad, presses, PUBLISHED_CONTACT)
        yield BenchTrial(f"grid {grid}, a press", "exact", 0, work, visited, items=len(presses))


def _ways(pad: Morphology, presses: Array, contact: Contact) -> Iterator[BenchTrial]:
    case, pairs = f"N={pad.knots.shape[1] - 2}", len(presses) * len(pad.knots)
    exact = cache(lambda: signals_and_spans(pad, presses, contact)[0])

    def evaluate(signals: Array, visited: float = 1.0, truth: Any = exact) -> Mapping[str, float]:
        return {"error": float(np.sqrt(((signals - truth()) ** 2).mean() / (truth() ** 2).mean())), "visited": visited}

    for samples in SAMPLES:
        plain = partial(plain_signals, pad, presses, contact, samples)
        scan = partial(scanned_signals, pad.knots, presses, contact.radius, contact.sides or 0, samples)
        cull = partial(quantized_signals_and_samples, pad, presses, contact, samples)
        yield BenchTrial(case, "plain", samples, plain, evaluate)
        yield BenchTrial(case, "scanned", samples, scan, evaluate)
        yield BenchTrial(
            case, "culled", samples, cull, lambda result, n=pairs * samples: evaluate(result[0], result[1] / n)
        )
    reference = cache(partial(reference_signals, pad, presses, contact))
    spans = pairs * (pad.knots.shape[1] - 1)
    work = partial(signals_and_spans, pad, presses, contact)
    yield BenchTrial(case, "exact", 0, work, lambda result: evaluate(result[0], result[1] / spans, reference))


BENCH = Bench(
    "contact",
    trials,
    "relative error (rms)",
    reference=("scanned", PUBLISHED),
    default=("exact", 0),
    baselines=("plain", "scanned"),
    prepare=lambda: scanned_signals(Morphology.straight(1).knots, np.ones((1, 2)), 0.6, 30, 2),
)
