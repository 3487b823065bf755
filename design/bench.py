"""Run time against error of the contact kernel and of the objective, beside plain ways of doing the same.

All figures of a table come from one run on one machine, so their ratios mean something and their seconds little.
"""

import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from .bench_table import Row, write_bench
from .contact import exact, quantized, signals, signals_sparse
from .information import disorder_area, joint_entropy, quantize, sharpness
from .kernels.pchip import pchip_sample
from .morphology import Morphology
from .objective import published_objective, published_presses
from .settings import Contact

Array = NDArray[np.float64]

SAMPLES = (250, 500, 1000, 2000, 4000, 8000, 16000)
KNOTS = (1, 5, 20)
GRIDS = (4, 8, 16, 32, 64, 128)
PUBLISHED = 2000


def seconds(work: Callable[[], object], least: int = 5, budget_s: float = 0.4) -> float:
    """Median wall time of `work`, called once before the clock, then at least `least` times or for `budget_s`."""
    work()
    times: list[float] = []
    while len(times) < least or (sum(times) < budget_s and len(times) < 200):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


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


@njit(cache=True, error_model="numpy")
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


def bench_contact(out: Path, report: Callable[[str], None]) -> dict[str, Any]:
    """Signals of random pads: error against run time for N of KNOTS, and time per press for GRIDS; files in `out`."""
    contact = Contact()
    rng = np.random.default_rng(0)
    rows = []
    for knots in KNOTS:
        report(f"contact, N = {knots}")
        rows += _contact_rows(Morphology.random(4, knots, seed=knots), rng.uniform(1, 4, (49, 2)), contact)
    for grid in GRIDS:
        report(f"contact, grid {grid}")
        pad, presses = Morphology.straight(grid), rng.uniform(1, grid, (2000, 2))
        spans = exact(pad, presses[:100], contact)[1]
        time_s = seconds(partial(signals_sparse, pad, presses, contact)) / len(presses)
        rows.append(Row(f"grid {grid}, a press", "exact", 0, None, time_s, spans / (100 * 2 * grid)))
    return write_bench("contact", rows, out, "relative error (rms)", reference=("scanned", PUBLISHED))


def _contact_rows(pad: Morphology, presses: Array, contact: Contact) -> list[Row]:
    """Every way of computing the signals of one pad, its error against the exact ones."""
    case = f"N={pad.knots.shape[1] - 2}"
    true, spans = exact(pad, presses, contact)
    pairs = len(presses) * len(pad.knots)

    def error(found: Array) -> float:
        return float(np.sqrt(((found - true) ** 2).mean() / (true**2).mean()))

    rows = []
    for samples in SAMPLES:
        plain = partial(plain_signals, pad, presses, contact, samples)
        scan = partial(scanned_signals, pad.knots, presses, contact.radius, contact.sides or 0, samples)
        cull = partial(quantized, pad, presses, contact, samples)
        found, looked_at = cull()
        rows += [
            Row(case, "plain", samples, error(plain()), seconds(plain, 3, 0.1), 1.0),
            Row(case, "scanned", samples, error(scan()), seconds(scan), 1.0),
            Row(case, "culled", samples, error(found), seconds(cull), looked_at / (pairs * samples)),
        ]
    visited = spans / (pairs * (pad.knots.shape[1] - 1))
    time_s = seconds(partial(exact, pad, presses, contact))
    return [*rows, Row(case, "exact", 0, error(_oracle(pad, presses, contact)), time_s, visited)]


def bench_objective(out: Path, report: Callable[[str], None]) -> dict[str, Any]:
    """The published objective of random pads, plainly, compiled and from exact signals; files in `out`.

    C grows with the samples, so its weight is scaled to what it is at the published 2000.
    """
    rows = []
    for knots in KNOTS:
        report(f"objective, N = {knots}")
        pad, case = Morphology.random(4, knots, seed=knots), f"N={knots}"
        true = exact_objective(pad)
        for samples in SAMPLES:
            gamma = 5e-6 * (PUBLISHED - 1) / (samples - 1)
            plain = partial(plain_objective, pad, samples, gamma)
            compiled = partial(published_objective, pad, samples=samples, weights=(1.0, 1e-7, gamma))
            rows += [
                Row(case, "plain", samples, abs(plain() - true) / true, seconds(plain, 3, 0.1), 1.0),
                Row(case, "compiled", samples, abs(compiled() - true) / true, seconds(compiled), 1.0),
            ]
        rows.append(Row(case, "exact", 0, None, seconds(partial(exact_objective, pad)), 1.0))  # the reference
    return write_bench("objective", rows, out, "relative error", reference=("plain", PUBLISHED))


def exact_objective(pad: Morphology) -> float:
    """The published objective from exact signals and the exact area of disorder."""
    levels = quantize(signals(pad, published_presses(pad.grid)))
    entropy = joint_entropy(levels[:, : pad.grid]) + joint_entropy(levels[:, pad.grid :])
    disorder = disorder_area(pad) * (PUBLISHED - 1) / (pad.grid + 1)
    return 1 / (1 + entropy) + 1e-7 * sharpness(levels) + 5e-6 * disorder


def plain_objective(pad: Morphology, samples: int = PUBLISHED, gamma: float = 5e-6) -> float:
    """The published objective from `plain_signals` and numpy alone."""
    found = plain_signals(pad, published_presses(pad.grid), Contact(), samples)
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
