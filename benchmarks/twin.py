"""Error of the identified twin against the number of presses, on simulated printed pads whose truth is known.

The error is that of predicted responses at test positions, against the noiseless responses of the pad. Baselines are
the plan as designed, with the true wiring and pose, and a smooth function of position alone.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial

import numpy as np

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design import Morphology
from padforge.design.contact import signals
from padforge.design.settings import Contact, sensed_rectangle
from padforge.design.twin import PlanTransform, Twin, TwinChannel
from padforge.sense.arrays import Array
from padforge.sense.localizer.response_model import RIDGE_POSITION, rbf_features
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import IDEAL_RIG
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.twin.as_built import PadPlan
from padforge.sense.twin.identification import Identification, identify_pad
from padforge.sense.twin.responses import compute_responses

PRESSES = (150, 300, 600, 1500, 3000)
TEST = 400
GRID, KNOTS = 4, 5
WORLDS = {
    "gaussian, 0.5 mm, 1 dead": ("gaussian", 0.5, 1),
    "disc, 1 mm, 2 dead": ("disc", 1.0, 2),
    "skirted, 2 mm, 3 dead": ("skirted", 2.0, 3),
}
"""Sensitivity profile, standard deviation of the lateral offset of fibres in mm, and number of dead channels."""
PLAN_CONTACT = Contact(radius=0.6)  # contact of the baseline that believes the plan

WIDTH = 0.55  # standard deviation of the Gaussian profile, grid units; the others are about as wide
GAIN_V = -0.5  # response to a relative stretch of 1, V
GAIN_SD = 0.2  # standard deviation of the logarithm of gains over channels
OFFSET_SCALE = 1.5  # correlation length of lateral offsets along a fibre, grid units

Predict = Callable[[Array], Array]


def trials() -> Iterator[BenchTrial]:
    """Yield identifications from more and more presses of every world, and the baselines."""
    ways = {"twin": _identify, "plan": _fit_plan, "place": _fit_smooth}
    for world in WORLDS:
        for presses in PRESSES:
            for way, fit in ways.items():
                yield BenchTrial(world, way, presses, partial(fit, world, presses), partial(_evaluate, world))


def _sensitivity_profile(kind: str) -> tuple[Array, Array]:
    """Return distances in grid units and weights of a profile: "gaussian", "disc" or "skirted"."""
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
    profile: str = "gaussian",
    lateral_offset_mm: float = 0.5,
    n_dead: int = 1,
    noise: float = 0.015,
) -> Twin:
    """Simulate a printed pad: turned over, wired in random order, with fibres beside their planned paths.

    `lateral_offset_mm` is the standard deviation of their distance from these, `noise` that of a response as a share of
    full scale; `n_dead` channels read nothing.
    """
    fibres, unit_mm = len(plan.knots), plan.unit_mm
    distance, weight = _sensitivity_profile(profile)
    turn, shift = rng.choice([-3.0, 3.0]), rng.uniform(2, 3, 2) * rng.choice([-1, 1], 2)
    wiring, dead = rng.permutation(fibres), set(rng.choice(fibres, n_dead, replace=False).tolist())
    gains_v = GAIN_V * np.exp(GAIN_SD * rng.standard_normal(fibres))
    as_built = _offset_paths(PadPlan.from_morphology(plan), lateral_offset_mm / unit_mm, rng)
    as_built_mm = [plan.to_mm(path) for path in as_built]
    channel_fibres = [None if channel in dead else int(fibre) for channel, fibre in enumerate(wiring)]
    low, high = np.array(sensed_rectangle(plan.layout))
    width, height = (unit_mm * (high - low)).tolist()

    channels = tuple(
        TwinChannel(c, fibre, 0.0 if fibre is None else float(gains_v[c]), 0.0, float(fibre is not None))
        for c, fibre in enumerate(channel_fibres)
    )
    paths = tuple(path if fibre in channel_fibres else None for fibre, path in enumerate(as_built_mm))
    pose = PlanTransform(True, float(turn), (float(shift[0]), float(shift[1])))
    twin = Twin(plan, channels, pose, distance * unit_mm, weight, paths, noise, (width, height), presses=1)
    stretch = twin.as_built_stretch(rng.uniform(-0.5, 0.5, (400, 2)) * (width, height))
    full_scale_v = [abs(gains_v[c.channel]) * stretch[:, c.fibre].max() for c in channels if c.fibre is not None]
    noise_v = noise * float(np.mean(full_scale_v))
    return replace(twin, channels=tuple(replace(channel, noise_v=noise_v) for channel in channels))


def _offset_paths(plan: PadPlan, std: float, rng: np.random.Generator) -> list[Array]:
    """Return paths beside the planned ones, offset by Gaussian processes of a standard deviation; grid units."""
    paths = []
    for path, length in zip(plan.paths, plan.lengths, strict=True):
        arc = np.cumsum(length) - length / 2
        nodes = np.linspace(0, arc[-1], 24)
        covariance = np.exp(-0.5 * ((nodes[:, None] - nodes) / OFFSET_SCALE) ** 2) + 1e-9 * np.eye(len(nodes))
        offsets = std * np.linalg.cholesky(covariance) @ rng.standard_normal((len(nodes), 2))
        points = path + np.column_stack([np.interp(arc, nodes, offset) for offset in offsets.T])
        ends = 1.5 * points[0] - 0.5 * points[1], 1.5 * points[-1] - 0.5 * points[-2]
        paths.append(np.vstack([ends[0], points, ends[1]]))
    return paths


@cache
def printed(world: str) -> Twin:
    """Simulate the printed pad of a world."""
    return printed_pad(Morphology.random(GRID, knots=KNOTS, seed=0), np.random.default_rng(0), *WORLDS[world])


@cache
def recorded(world: str, presses: int) -> Recording:
    """Simulate presses of the pad of a world."""
    return simulate(printed(world), IDEAL_RIG.model_copy(update={"presses": presses, "seed": presses}))


def _identify(world: str, presses: int) -> Identification:
    return identify_pad(recorded(world, presses), printed(world).morphology)


def _fit_plan(world: str, presses: int) -> Predict:
    """Fit the gains of the plan as designed."""
    pad = printed(world)
    measured = compute_responses(recorded(world, presses), np.ones(presses, bool))
    fibres = [channel.fibre for channel in pad.channels]

    def plan_signals(positions_mm: Array) -> Array:
        return signals(pad.morphology, pad.morphology.to_grid(pad.frame.to_plan(positions_mm)), PLAN_CONTACT)

    inputs = plan_signals(measured.positions_mm)
    lines = [
        np.zeros(2) if fibre is None else np.polyfit(inputs[:, fibre], measured.volts[:, channel], 1)
        for channel, fibre in enumerate(fibres)
    ]

    def predict(positions_mm: Array) -> Array:
        inputs = plan_signals(positions_mm)
        columns = [np.polyval(line, inputs[:, fibre or 0]) for fibre, line in zip(fibres, lines, strict=True)]
        return np.column_stack(columns).astype(np.float64)

    return predict


def _fit_smooth(world: str, presses: int) -> Predict:
    """Fit a smooth function of position by ridge regression on radial basis functions, as the localizer does."""
    measured = compute_responses(recorded(world, presses), np.ones(presses, bool))
    half_mm = max(printed(world).sensed_mm) / 2
    design_matrix, mean = rbf_features(measured.positions_mm / half_mm), measured.volts.mean(axis=0)
    gram = design_matrix.T @ design_matrix + RIDGE_POSITION * np.eye(design_matrix.shape[1])
    weights = np.linalg.solve(gram, design_matrix.T @ (measured.volts - mean))
    return lambda positions_mm: np.asarray(mean + rbf_features(positions_mm / half_mm) @ weights, np.float64)


def _evaluate(world: str, fitted: Identification | Predict) -> Mapping[str, float | None]:
    """Return the relative error of responses at test positions, and of an identification its other results."""
    pad = printed(world)
    positions_mm = np.random.default_rng(1).uniform(-0.5, 0.5, (TEST, 2)) * pad.sensed_mm
    stretch = pad.as_built_stretch(positions_mm)
    live = [channel for channel in pad.channels if channel.fibre is not None]
    true = np.column_stack([channel.gain_v * stretch[:, channel.fibre] for channel in live])
    if not isinstance(fitted, Identification):
        return {"error": _relative_error(fitted(positions_mm)[:, [channel.channel for channel in live]], true)}
    twin = fitted.twin
    rows = {channel: row for row, channel in enumerate(fitted.live.tolist())}
    predicted = fitted.fit.pad.predict(positions_mm)
    columns = [predicted[:, rows[c.channel]] if c.channel in rows else np.zeros(TEST) for c in live]
    wired = [twin.channels[channel.channel].fibre == channel.fibre for channel in pad.channels]
    return {
        "error": _relative_error(np.column_stack(columns), true),
        "right": float(np.mean(wired)),
        "explained": float(fitted.explained.mean()),
        "noise": twin.noise / pad.noise,
    }


def _relative_error(predicted: Array, true: Array) -> float:
    """Return the rms error relative to the standard deviation, mean over channels, without constant offsets."""
    residual = (predicted - predicted.mean(axis=0)) - (true - true.mean(axis=0))
    return float(np.sqrt((residual**2).mean(axis=0) / true.var(axis=0)).mean())


BENCH = Bench(
    "twin",
    trials,
    "error of predicted responses at test positions, relative to their standard deviation",
    reference=("place", 1500),
    default=("twin", 1500),
    baselines=("plan", "place"),
)
