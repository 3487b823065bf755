"""What identification finds against the presses it is given, on printed pads whose truth is known.

The error is that of predicted responses at fresh places, against what the pad answers there without noise; beside it
stand the plan believed as it is, wired and framed as is true, and a smooth function of place alone.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial

import numpy as np

from design import Morphology
from design.benchmarking.harness import Bench, BenchTrial
from design.pad.contact import signals
from design.pad.twin import Twin
from design.settings import Contact
from sense.localizer.response_model import RIDGE_PLACE, bumps
from sense.recordings.processing.limits import Array
from sense.recordings.recording import Recording
from sense.recordings.simulation.published_protocol import simulate
from sense.settings import RigSettings

from .identification import Identification, identify
from .printed_worlds import printed_pad
from .responses import responses

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

Predict = Callable[[Array], Array]


def trials() -> Iterator[BenchTrial]:
    """Identification of every world from more and more presses, and the plain ways."""
    for world in WORLDS:
        for presses in PRESSES:
            judge = partial(_judged, world)
            yield BenchTrial(world, "twin", presses, partial(_identified, world, presses), judge)
            yield BenchTrial(world, "plan", presses, partial(_believed, world, presses), judge)
            yield BenchTrial(world, "place", presses, partial(_smoothed, world, presses), judge)


@cache
def _pad(world: str) -> Twin:
    reach, laid_mm, dead = WORLDS[world]
    plan = Morphology.random(GRID, knots=KNOTS, seed=0)
    return printed_pad(plan, np.random.default_rng(0), reach=reach, laid_mm=laid_mm, dead=dead)


@cache
def _recording(world: str, presses: int) -> Recording:
    return simulate(_pad(world), RigSettings(presses=presses, seed=presses))


def _identified(world: str, presses: int) -> Identification:
    return identify(_recording(world, presses), _pad(world).morphology)


def _believed(world: str, presses: int) -> Predict:
    """The plan as it is, its gains fitted."""
    pad, recording = _pad(world), _recording(world, presses)
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
        return np.column_stack(columns)

    return predict


def _smoothed(world: str, presses: int) -> Predict:
    """Ridge regression on bumps over the pad, as the localizer's model of responses has it."""
    pad, recording = _pad(world), _recording(world, presses)
    answers = responses(recording, np.ones(presses, bool))
    half_mm = max(pad.sensed_mm) / 2
    known = bumps(answers.places_mm / half_mm)
    mean = answers.volts.mean(axis=0)
    weights = np.linalg.solve(known.T @ known + RIDGE_PLACE * np.eye(known.shape[1]), known.T @ (answers.volts - mean))
    return lambda places_mm: mean + bumps(places_mm / half_mm) @ weights


def _judged(world: str, found: Identification | Predict) -> Mapping[str, float | None]:
    """Error of responses at fresh places, share of their spread; and of an identification what else it found."""
    pad = _pad(world)
    places_mm = np.random.default_rng(1).uniform(-0.5, 0.5, (FRESH, 2)) * pad.sensed_mm
    signals_there, live = pad.laid_signals(places_mm), [c for c in pad.channels if c.fibre is not None]
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
