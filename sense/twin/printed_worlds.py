"""Printed pads whose truth is known: what identification is measured against."""

import numpy as np

from design import Morphology
from design.pad.twin import Frame, Twin, TwinChannel
from sense.recordings.processing.limits import Array

from .plan import Plan

REACHES = ("gaussian", "disc", "skirted")
WIDTH = 0.55
"""Standard deviation of the Gaussian reach, grid units; the others are about as wide."""
GAIN_V, UNEVEN_GAIN = -0.06, 0.2
"""V a grid unit, and how far channels differ in it: standard deviation of its logarithm."""
SMOOTH = 1.5
"""Length over which the way beside the plan changes, grid units."""


def reach_of(kind: str) -> tuple[Array, Array]:
    """Distances (n,), grid units, and weights (n,) of one of `REACHES`."""
    distance = np.linspace(0, 3.2 * WIDTH, 17)
    if kind == "disc":
        weight = np.clip((1.0 - distance) / 0.2 + 0.5, 0, 1)
    else:
        weight = np.exp(-0.5 * (distance / WIDTH) ** 2)
        if kind == "skirted":
            weight -= 0.15 * np.exp(-0.5 * ((distance - 1.3) / 0.2) ** 2)
    weight[-1] = 0.0
    return distance, weight / np.abs(weight).max()


def printed_pad(
    plan: Morphology,
    rng: np.random.Generator,
    *,
    reach: str = "gaussian",
    laid_mm: float = 0.5,
    dead: int = 1,
    noise: float = 0.015,
) -> Twin:
    """A pad as it might come off the bench: turned over, wired in any order, laid beside its plan.

    Args:
        reach: one of `REACHES`. laid_mm: standard deviation of fibres beside their plan. dead: channels that read
            nothing. noise: of a response, share of full scale.
    """
    fibres, pitch = len(plan.knots), plan.pitch_mm
    distance, weight = reach_of(reach)
    turn, shift = rng.choice([-3.0, 3.0]), rng.uniform(2, 3, 2) * rng.choice([-1, 1], 2)
    wired, lost = rng.permutation(fibres), set(rng.choice(fibres, dead, replace=False).tolist())
    gains = GAIN_V * np.exp(UNEVEN_GAIN * rng.standard_normal(fibres))
    laid = [plan.to_mm(line) for line in _laid(Plan.of(plan), laid_mm / pitch, rng)]
    read = [None if channel in lost else int(fibre) for channel, fibre in enumerate(wired)]
    sensed = (plan.grid * pitch, plan.grid * pitch)

    def twin(noise_v: float) -> Twin:
        channels = [
            TwinChannel(
                channel, fibre, 0.0 if fibre is None else float(gains[channel]), noise_v, float(fibre is not None)
            )
            for channel, fibre in enumerate(read)
        ]
        courses = tuple(line if fibre in read else None for fibre, line in enumerate(laid))
        frame = Frame(True, float(turn), (float(shift[0]), float(shift[1])))
        return Twin(plan, tuple(channels), frame, distance * pitch, weight, courses, noise, sensed, presses=1)

    silent = twin(0.0)
    places = rng.uniform(-0.5, 0.5, (400, 2)) * sensed
    signals = silent.laid_signals(places)
    largest = [abs(gains[c]) * signals[:, fibre].max() for c, fibre in enumerate(read) if fibre is not None]
    return twin(noise * float(np.mean(largest)))


def _laid(plan: Plan, aside: float, rng: np.random.Generator) -> list[Array]:
    """Courses (F, 2), grid units, beside their plan by smooth curves of standard deviation `aside`."""
    out = []
    for course, length in zip(plan.course, plan.length, strict=True):
        run = np.cumsum(length) - length / 2
        at = np.linspace(0, run[-1], 24)
        alike = np.exp(-0.5 * ((at[:, None] - at) / SMOOTH) ** 2) + 1e-9 * np.eye(len(at))
        curves = aside * np.linalg.cholesky(alike) @ rng.standard_normal((len(at), 2))
        line = course + np.column_stack([np.interp(run, at, curve) for curve in curves.T])
        out.append(np.vstack([1.5 * line[0] - 0.5 * line[1], line, 1.5 * line[-1] - 0.5 * line[-2]]))
    return out
