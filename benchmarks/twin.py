"""What identification finds against the presses it is given, on printed pads whose truth is known.

The error is that of predicted responses at fresh places, against what the pad answers there without noise; beside it
stand the plan believed as it is, wired and framed as is true, and a smooth function of place alone.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial

import numpy as np

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design import Morphology
from padforge.design.contact import signals
from padforge.design.settings import Contact, sensed_rectangle
from padforge.design.twin import PlanTransform, Twin, TwinChannel
from padforge.sense.localizer.response.response_model import RIDGE_PLACE, bumps
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.recordings.recording import Recording
from padforge.sense.recordings.simulation.published_protocol import simulate
from padforge.sense.settings import RigSettings
from padforge.sense.twin.identification import identify
from padforge.sense.twin.identified_pad import Identification
from padforge.sense.twin.laid_pad import Plan
from padforge.sense.twin.responses import responses

PRESSES = (150, 300, 600, 1500, 3000)
FRESH = 400
GRID, KNOTS = 4, 5
WORLDS: Mapping[str, tuple[str, float, int]] = {
    "gaussian, 0.5 mm, 1 dead": ("gaussian", 0.5, 1),
    "disc, 1 mm, 2 dead": ("disc", 1.0, 2),
    "skirted, 2 mm, 3 dead": ("skirted", 2.0, 3),
}
"""Reach, how far fibres lie beside their plan, and dead channels."""
CLOSE = Contact(radius=0.6)
"""What a plan that is believed takes a press for."""

REACHES = ("gaussian", "disc", "skirted")
WIDTH = 0.55
"""Standard deviation of the Gaussian reach, grid units; the others are about as wide."""
GAIN_V, UNEVEN_GAIN = -0.5, 0.2
"""V for a relative stretch of 1, and how far channels differ in it: standard deviation of its logarithm."""
SMOOTH = 1.5
"""Length over which the way beside the plan changes, grid units."""

Predict = Callable[[Array], Array]


def trials() -> Iterator[BenchTrial]:
    """Identification of every world from more and more presses, and the plain ways."""
    for world in WORLDS:
        for presses in PRESSES:
            judge = partial(_judged, world)
            yield BenchTrial(world, "twin", presses, partial(_identified, world, presses), judge)
            yield BenchTrial(world, "plan", presses, partial(_believed, world, presses), judge)
            yield BenchTrial(world, "place", presses, partial(_smoothed, world, presses), judge)


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
    fibres, unit_mm = len(plan.knots), plan.unit_mm
    distance, weight = reach_of(reach)
    turn, shift = rng.choice([-3.0, 3.0]), rng.uniform(2, 3, 2) * rng.choice([-1, 1], 2)
    wired, lost = rng.permutation(fibres), set(rng.choice(fibres, dead, replace=False).tolist())
    gains = GAIN_V * np.exp(UNEVEN_GAIN * rng.standard_normal(fibres))
    laid = [plan.to_mm(line) for line in _laid(Plan.of(plan), laid_mm / unit_mm, rng)]
    read = [None if channel in lost else int(fibre) for channel, fibre in enumerate(wired)]
    low, high = np.array(sensed_rectangle(plan.layout))
    width, height = (unit_mm * (high - low)).tolist()

    def twin(noise_v: float) -> Twin:
        channels = [
            TwinChannel(
                channel, fibre, 0.0 if fibre is None else float(gains[channel]), noise_v, float(fibre is not None)
            )
            for channel, fibre in enumerate(read)
        ]
        courses = tuple(line if fibre in read else None for fibre, line in enumerate(laid))
        frame = PlanTransform(True, float(turn), (float(shift[0]), float(shift[1])))
        return Twin(
            plan, tuple(channels), frame, distance * unit_mm, weight, courses, noise, (width, height), presses=1
        )

    silent = twin(0.0)
    places = rng.uniform(-0.5, 0.5, (400, 2)) * (width, height)
    signals = silent.as_built_stretch(places)
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


@cache
def printed(world: str) -> Twin:
    reach, laid_mm, dead = WORLDS[world]
    plan = Morphology.random(GRID, knots=KNOTS, seed=0)
    return printed_pad(plan, np.random.default_rng(0), reach=reach, laid_mm=laid_mm, dead=dead)


@cache
def recorded(world: str, presses: int) -> Recording:
    return simulate(printed(world), RigSettings(presses=presses, seed=presses))


def _identified(world: str, presses: int) -> Identification:
    return identify(recorded(world, presses), printed(world).morphology)


def _believed(world: str, presses: int) -> Predict:
    """The plan as it is, its gains fitted."""
    pad, recording = printed(world), recorded(world, presses)
    fibres = [channel.fibre for channel in pad.channels]
    answers = responses(recording, np.ones(presses, bool))

    def planned(places_mm: Array) -> Array:
        return signals(pad.morphology, pad.morphology.to_grid(pad.frame.to_plan(places_mm)), CLOSE)

    told = planned(answers.places_mm)
    lines = [
        None if fibre is None else np.polyfit(told[:, fibre], answers.volts[:, channel], 1)
        for channel, fibre in enumerate(fibres)
    ]

    def predict(places_mm: Array) -> Array:
        found = planned(places_mm)
        columns = [
            np.zeros(len(found)) if fibre is None or line is None else np.polyval(line, found[:, fibre])
            for fibre, line in zip(fibres, lines, strict=True)
        ]
        return np.column_stack(columns).astype(np.float64)

    return predict


def _smoothed(world: str, presses: int) -> Predict:
    """Ridge regression on bumps over the pad, as the localizer's model of responses has it."""
    pad, recording = printed(world), recorded(world, presses)
    answers = responses(recording, np.ones(presses, bool))
    half_mm = max(pad.sensed_mm) / 2
    known = bumps(answers.places_mm / half_mm)
    mean = answers.volts.mean(axis=0)
    weights = np.linalg.solve(known.T @ known + RIDGE_PLACE * np.eye(known.shape[1]), known.T @ (answers.volts - mean))
    return lambda places_mm: np.asarray(mean + bumps(places_mm / half_mm) @ weights, np.float64)


def _judged(world: str, found: Identification | Predict) -> Mapping[str, float | None]:
    """Error of responses at fresh places, share of their spread; and of an identification what else it found."""
    pad = printed(world)
    places_mm = np.random.default_rng(1).uniform(-0.5, 0.5, (FRESH, 2)) * pad.sensed_mm
    signals_there, live = pad.as_built_stretch(places_mm), [c for c in pad.channels if c.fibre is not None]
    true = np.column_stack([channel.gain_v * signals_there[:, channel.fibre] for channel in live])
    if not isinstance(found, Identification):
        return {"error": _off(found(places_mm)[:, [channel.channel for channel in live]], true)}
    twin = found.twin()
    rows = {channel: row for row, channel in enumerate(found.live.tolist())}
    told = found.fit.pad.predict(places_mm)
    columns = [told[:, rows[c.channel]] if c.channel in rows else np.zeros(FRESH) for c in live]
    right = [twin.channels[channel.channel].fibre == channel.fibre for channel in pad.channels]
    return {
        "error": _off(np.column_stack(columns), true),
        "right": float(np.mean(right)),
        "explained": float(found.explained.mean()),
        "noise": twin.noise / pad.noise,
    }


def _off(told: Array, true: Array) -> float:
    left = (told - told.mean(axis=0)) - (true - true.mean(axis=0))
    return float(np.sqrt((left**2).mean(axis=0) / true.var(axis=0)).mean())


BENCH = Bench(
    "twin",
    trials,
    error="error of predicted responses at fresh places, share of their spread",
    reference=("place", 1500),
    best=("twin", 1500),
    plain=("plan", "place"),
)
