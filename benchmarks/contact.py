"""Run time against error of the contact kernel, beside the published rule and a plain way of writing it."""

from collections.abc import Iterator, Mapping
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numba import njit
from scipy.interpolate import PchipInterpolator

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.contact import quantized_signals_and_samples, signals_and_spans, signals_sparse
from padforge.design.kernels.pchip import pchip_sample
from padforge.design.morphology import Array, Morphology
from padforge.design.settings import PUBLISHED_CONTACT, Contact

SAMPLES = (250, 500, 1000, 2000, 4000, 8000, 16000)
KNOTS = (1, 5, 20)
GRIDS = (4, 8, 16, 32, 64, 128)
PUBLISHED = 2000


def plain_signals(pad: Morphology, presses: Array, contact: Contact, samples: int) -> Array:
    """The published rule written plainly: every sample of every fibre against every press, numpy and matplotlib."""
    at = np.linspace(0, pad.grid + 1, samples)
    angle = np.linspace(0, 2 * np.pi, (contact.sides or 256) + 1)
    corners = contact.radius * np.column_stack([np.cos(angle), np.sin(angle)])
    fibres = []
    for fibre, knots in enumerate(pad.knots):
        travel = fibre // pad.grid
        points = np.empty((samples, 2))
        points[:, travel] = at
        points[:, 1 - travel] = PchipInterpolator(knots[:, travel], knots[:, 1 - travel])(at)
        fibres.append((points[:-1], np.abs(np.diff(points, axis=0)).sum(axis=1)))
    out = np.empty((len(presses), len(fibres)))
    for q, press in enumerate(presses):
        outline = Outline(corners + press)
        out[q] = [run[outline.contains_points(starts)].sum() for starts, run in fibres]
    return out


@njit(error_model="numpy")  # not kept: it calls a kernel of another folder, whose changes would go unseen
def scanned_signals(knots: Any, presses: Any, radius: float, sides: int, samples: int) -> Any:
    """The published rule compiled as it stands: a full scan, a circle test, then every edge of the polygon."""
    fibres = len(knots)
    step = (fibres // 2 + 1) / (samples - 1)
    apothem = radius * np.cos(np.pi / sides)
    normal = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    nx, ny = np.cos(normal), np.sin(normal)
    out = np.zeros((len(presses), fibres))
    curve = np.empty(samples)
    for f in range(fibres):
        travel = 0 if f < fibres // 2 else 1
        pchip_sample(knots[f, :, travel].copy(), knots[f, :, 1 - travel].copy(), step, curve)
        for q in range(len(presses)):
            for i in range(samples - 1):
                dt, dv = i * step - presses[q, travel], curve[i] - presses[q, 1 - travel]
                if dt * dt + dv * dv > radius * radius:
                    continue
                dx, dy = (dt, dv) if travel == 0 else (dv, dt)
                inside = True
                for k in range(sides):
                    if dx * nx[k] + dy * ny[k] > apothem:
                        inside = False
                        break
                if inside:
                    out[q, f] += step + abs(curve[i + 1] - curve[i])
    return out


def trials() -> Iterator[BenchTrial]:
    """Signals of random pads: error against run time for N of KNOTS, and time per press for GRIDS."""
    contact = PUBLISHED_CONTACT
    rng = np.random.default_rng(0)
    for knots in KNOTS:
        yield from _ways(Morphology.random(4, knots, seed=knots), rng.uniform(1, 4, (49, 2)), contact)
    for grid in GRIDS:
        pad, presses = Morphology.straight(grid), rng.uniform(1, grid, (2000, 2))

        def judge(result: object, pad: Morphology = pad, presses: Array = presses) -> Mapping[str, float]:
            return {"visited": signals_and_spans(pad, presses[:100], contact)[1] / (100 * len(pad.knots))}

        work = partial(signals_sparse, pad, presses, contact)
        yield BenchTrial(f"grid {grid}, a press", "exact", 0, work, judge, items=len(presses))


def _ways(pad: Morphology, presses: Array, contact: Contact) -> Iterator[BenchTrial]:
    """Every way of computing the signals of one pad, its error against the exact ones."""
    case = f"N={pad.knots.shape[1] - 2}"
    pairs = len(presses) * len(pad.knots)

    @cache
    def true() -> Array:
        return signals_and_spans(pad, presses, contact)[0]

    def error(found: Array, true: Array) -> float:
        return float(np.sqrt(((found - true) ** 2).mean() / (true**2).mean()))

    for samples in SAMPLES:
        plain = partial(plain_signals, pad, presses, contact, samples)
        scan = partial(scanned_signals, pad.knots, presses, contact.radius, contact.sides or 0, samples)
        cull = partial(quantized_signals_and_samples, pad, presses, contact, samples)

        def scanned(found: Array) -> Mapping[str, float]:
            return {"error": error(found, true()), "visited": 1.0}

        def culled(found: tuple[Array, int], samples: int = samples) -> Mapping[str, float]:
            return {"error": error(found[0], true()), "visited": found[1] / (pairs * samples)}

        yield BenchTrial(case, "plain", samples, plain, scanned)
        yield BenchTrial(case, "scanned", samples, scan, scanned)
        yield BenchTrial(case, "culled", samples, cull, culled)

    def exactly(found: tuple[Array, int]) -> Mapping[str, float]:
        spans = pairs * (pad.knots.shape[1] - 1)
        return {"error": error(found[0], _oracle(pad, presses, contact)), "visited": found[1] / spans}

    yield BenchTrial(case, "exact", 0, partial(signals_and_spans, pad, presses, contact), exactly)


def _oracle(pad: Morphology, presses: Array, contact: Contact) -> Array:
    """Signals by sign changes on a dense sample, each refined by bisection: nothing shared with the exact kernel."""
    from scipy.optimize import brentq

    normal = (np.arange(contact.sides or 0) + 0.5) * 2 * np.pi / (contact.sides or 1)
    apothem = contact.radius * np.cos(np.pi / (contact.sides or 1))
    out = np.zeros((len(presses), len(pad.knots)))
    for fibre, knots in enumerate(pad.knots):
        travel = fibre // pad.grid
        curve = PchipInterpolator(knots[:, travel], knots[:, 1 - travel])
        nt, nv = (np.cos(normal), np.sin(normal)) if travel == 0 else (np.sin(normal), np.cos(normal))
        for q, press in enumerate(presses):

            def outside(t: Any, press: Array = press) -> Any:
                away_t, away_v = t - press[travel], curve(t) - press[1 - travel]  # noqa: B023
                return np.max(np.multiply.outer(away_t, nt) + np.multiply.outer(away_v, nv), axis=-1) - apothem  # noqa: B023

            for begin, end in zip(knots[:-1, travel], knots[1:, travel], strict=True):
                low, high = max(begin, press[travel] - contact.radius), min(end, press[travel] + contact.radius)
                if high <= low:
                    continue
                at = np.linspace(low, high, 400)
                sign = np.sign(outside(at))
                turns = np.flatnonzero(sign[:-1] * sign[1:] < 0)
                cuts = [low, *(brentq(outside, at[i], at[i + 1], xtol=1e-15) for i in turns), high]
                for a, b in pairwise(cuts):
                    if outside((a + b) / 2) <= 0:
                        out[q, fibre] += b - a + abs(curve(b) - curve(a))
    return out


BENCH = Bench(
    "contact",
    trials,
    "relative error (rms)",
    ("scanned", PUBLISHED),
    ("exact", 0),
    plain=("plain", "scanned"),
    prepare=lambda: scanned_signals(Morphology.straight(1).knots, np.ones((1, 2)), 0.6, 30, 2),
)
