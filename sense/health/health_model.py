"""`health.json` and the arrays beside it: what they may hold, so that nothing else gets past their reading.

What a healthy pad is like: learnt from a recording of one, kept in `health.safetensors` and `health.json`.
`monitor` follows presses by it and names the fibre that is lost, damaged or drifting.

Learning what a healthy pad is like from a recording of one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, JsonValue

from padforge.design.common.files import read_json
from padforge.design.common.parallel import one_torch_thread, run_tasks
from padforge.design.common.settings import Settings, validate
from padforge.design.common.validation import InputError, check_float, check_int, check_mapping, check_type, short_repr
from padforge.sense.arrays import (
    MAX_FIBRES,
    MAX_RATE_HZ,
    MIN_RATE_HZ,
    MIN_SCALE_V,
    Array,
    Floats,
    Indices,
    Mask,
    check_numbers,
    stream_of,
)
from padforge.sense.health.fault_likelihoods import HYPOTHESES, LIBRARY, STEPS, FaultLikelihoods, Tail
from padforge.sense.health.trace_model import (
    COMPONENTS,
    HIDDEN,
    INPUTS,
    MEMBERS,
    REST,
    TARGETS,
    TRACE,
    Shapes,
    Weights,
    expected,
    member,
    shapes_of,
    traces_of,
    train_predictors,
)
from padforge.sense.localizer.model_files import check_same_pad, files_of
from padforge.sense.recording.recording import Recording, rate_of

FORMAT = "padforge-health/2"
MAX_FALSE_ALARMS = 0.1
"""Greatest rate of false alarms a press: above it every press is one."""
MOST_LOST = 2
"""What is chance is learnt for no to this many fibres left out."""
LEAST_PRESSES = 300
"""Fewest presses that health is learnt from."""
WEAK_PRESSES = 850
"""Presses from which a fibre that answers by half is told from one pressed where it seldom was; from 680, simulated
pads gave a false alarm in every other recording, from 850 none in 12."""
POSITIVE = (
    *("shapes.inputs", "shapes.targets", "evidence.scale", "evidence.other_spread", "evidence.noise"),
    *("evidence.noise_spread", "evidence.constant", "evidence.innovation", "tail.slope"),
)
"""Arrays that are divided by, or whose logarithm is taken."""
MAX_VALUE = 1e6
"""Greatest number of a sound model, by amount."""


class HealthDocument(Settings):
    """The whole of `health.json`, see `HealthModel`."""

    format: Literal["padforge-health/2"] = FORMAT
    fibres: int = Field(ge=1, le=MAX_FIBRES)
    dead: list[Annotated[int, Field(ge=0, lt=MAX_FIBRES)]]
    rate_hz: float = Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)
    false_alarms: float = Field(gt=0, le=MAX_FALSE_ALARMS)
    presses: int = Field(ge=LEAST_PRESSES)
    weights_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    provenance: dict[str, JsonValue]


def refuse_unsound(arrays: Mapping[str, NDArray[Any]], fibres: int) -> None:
    """Raise ValueError unless `arrays` are those of a model of so many living fibres, and all of them sane."""
    hypotheses, targets, members, losses = len(HYPOTHESES), TARGETS, MEMBERS, min(MOST_LOST, fibres - 1) + 1
    numbers = {
        "shapes.basis": (fibres, TRACE, COMPONENTS),
        "shapes.inputs": (fibres, INPUTS),
        **dict.fromkeys(("shapes.targets", "evidence.scale", "evidence.extra"), (fibres, targets)),
        "evidence.floor": (fibres, COMPONENTS),
        **dict.fromkeys(("evidence.other_mean", "evidence.other_spread"), (LIBRARY, fibres, COMPONENTS)),
        **{f"evidence.{name}": (fibres,) for name in ("noise", "noise_centre", "noise_spread", "constant")},
        "evidence.filters": (fibres, len(STEPS), TRACE),
        **dict.fromkeys(("evidence.persistence", "evidence.innovation"), (1,)),
        **dict.fromkeys(("tail.level", "tail.slope"), (losses, hypotheses)),
        "rests": (2, fibres),
    }
    weights = {
        "weights.first.w": (members, fibres, INPUTS, HIDDEN),
        "weights.first.alive": (members, fibres, HIDDEN),
        "weights.first.b": (members, HIDDEN),
        "weights.hidden.w": (members, HIDDEN, HIDDEN),
        "weights.hidden.b": (members, HIDDEN),
        "weights.last.w": (members, fibres, HIDDEN, 2 * targets),
        "weights.last.b": (members, fibres, 2 * targets),
    }
    expected_arrays = {name: (shape, np.float64) for name, shape in numbers.items()}
    expected_arrays |= {name: (shape, np.float32) for name, shape in weights.items()}
    found = {name: (array.shape, array.dtype.type) for name, array in arrays.items()}
    if found != expected_arrays:
        wrong = min(name for name in found.keys() | expected_arrays if found.get(name) != expected_arrays.get(name))
        raise ValueError(f"{wrong} is {found.get(wrong)}, expected {expected_arrays.get(wrong)}")
    for name, array in arrays.items():
        if not np.abs(array).max(initial=0) <= MAX_VALUE:
            raise ValueError(f"{name} goes up to {np.abs(array).max():g}, allowed is {MAX_VALUE:g}")
    for name in POSITIVE:
        if not (arrays[name] > 0).all():
            raise ValueError(f"{name} is {arrays[name].min():g} at least, allowed is above 0")


COMMANDED, DETECTED = "health", "health_live"
"""Names of the files of a model: learnt from presses as they were commanded, and as they are found in the readings."""
FALSE_ALARMS = 1e-5
"""False alarms a press, all fibres and kinds of fault together: one in 100 000 healthy presses."""
SETTLED = 10
"""Presses after which the running level of a rest is worth comparing with."""


@dataclass(frozen=True)
class HealthModel:
    """How the fibres of a healthy pad go together. L of its C fibres lived; arrays of fibres have only these.

    Attributes:
        shapes, weights, evidence, tail: see there.
        rests: (2, L) least and greatest rest, V.
        fibres: C. dead: fibres that gave nothing in the recording that was learnt from.
        rate_hz: readings per second of it, and `presses`: how many were learnt from.
        false_alarms: alarms a press that are allowed on a healthy pad.
        provenance: where the model came from; free JSON.
    """

    shapes: Shapes
    weights: Weights
    evidence: FaultLikelihoods
    tail: Tail
    rests: Array
    fibres: int
    dead: tuple[int, ...]
    rate_hz: float
    presses: int
    false_alarms: float = FALSE_ALARMS
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def living(self) -> Indices:
        """(L,) indices of the fibres that lived."""
        return np.setdiff1d(np.arange(self.fibres), self.dead)

    @property
    def threshold(self) -> float:
        """Rarity (`Tail.rarity`) that names a fibre: every hypothesis has an equal part of the false alarms."""
        return float(np.log(len(HYPOTHESES) / self.false_alarms))

    def refuse_other(self, readings: Array, times_s: Array) -> None:
        """Raise InputError if a recording has other fibres or another rate than the one that was learnt from."""
        check_same_pad(self, "health", readings.shape[1], rate_of(times_s))

    def save(self, folder: str | Path, name: str = COMMANDED) -> None:
        """Write NAME.safetensors and NAME.json; reading them back gives the same to the last bit.

        Raises:
            InputError: the provenance is no JSON, or `folder` cannot be written.
        """
        numbers = {key: getattr(self, key) for key in ("fibres", "dead", "rate_hz", "false_alarms", "presses")}
        unsealed = {"weights_sha256": "", "provenance": dict(self.provenance)}
        files_of(folder, name).write({"format": FORMAT, **numbers, **unsealed}, self._arrays(), "health")

    @classmethod
    def load(cls, folder: str | Path, name: str = COMMANDED) -> "HealthModel":
        """Read what `save` wrote.

        Raises:
            InputError: a file is missing, torn or of another kind, a value is none that `save` writes, or the two do
                not belong together.
        """
        files = files_of(folder, name)
        document = validate(HealthDocument, read_json(files.document, FORMAT), f"{files.document}:")
        dead = sorted(set(document.dead))
        if dead != document.dead or len(dead) >= document.fibres or not set(dead) < set(range(document.fibres)):
            raise InputError(f"{files.document}: dead is {document.dead}, expected some of {document.fibres} fibres")
        with files.arrays(document.weights_sha256, "the health") as arrays:
            refuse_unsound(arrays, document.fibres - len(dead))
        parts: dict[str, dict[str, Any]] = {"shapes": {}, "weights": {}, "evidence": {}, "tail": {}}
        for name, array in arrays.items():
            part, _, key = name.partition(".")
            if part in parts:
                parts[part][key] = array
        return cls(
            shapes=Shapes(**parts["shapes"]),
            weights=parts["weights"],
            evidence=FaultLikelihoods(**parts["evidence"]),
            tail=Tail(**parts["tail"]),
            rests=arrays["rests"],
            dead=tuple(dead),
            **{key: getattr(document, key) for key in ("fibres", "rate_hz", "presses", "false_alarms", "provenance")},
        )

    def _arrays(self) -> dict[str, NDArray[Any]]:
        parts = {"shapes": asdict(self.shapes), "weights": self.weights, "evidence": asdict(self.evidence)}
        parts["tail"] = asdict(self.tail)
        flat = {f"{part}.{key}": np.asarray(value) for part, values in parts.items() for key, value in values.items()}
        return flat | {"rests": self.rests}


def checked_presses(
    readings: ArrayLike, times_s: ArrayLike, down_command: ArrayLike, up_command: ArrayLike
) -> tuple[Array, Array, Indices, Indices]:
    """Readings (R, C), R >= 2, their times (R,), and the presses (Q,) one after another, as plain arrays.

    Raises:
        InputError: they are something else.
    """
    times_s, readings = stream_of(times_s, readings)
    down_command, up_command = (
        check_numbers(edges, np.int64, "presses", copy=False) for edges in (down_command, up_command)
    )
    if len(readings) < 2:
        raise InputError(f"readings have shape {readings.shape}, expected (R, C), R >= 2")
    if down_command.ndim != 1 or down_command.shape != up_command.shape or len(down_command) == 0:
        raise InputError(
            f"presses have {down_command.size} begins and {up_command.size} ends, expected as many, at least one"
        )
    ends = np.stack([down_command, up_command], axis=1).ravel()
    sound = np.concatenate([[down_command[0] >= 1], (ends[1::2] > ends[::2]), ends[2::2] >= ends[1:-1:2]])
    if not sound.all() or up_command[-1] > len(readings):
        raise InputError(
            f"presses begin at {down_command[0]} and end at {up_command[-1]} of {len(readings)} readings, expected a reading "
            "before the first, and each to end before the next begins"
        )
    return readings, times_s, down_command, up_command


BLOCK = 50
"""Each member learns from all presses but its own fold, of blocks of successive ones: neighbours share what drifts."""
LOSSES = 4
"""Random choices of fibres left out from which it is learnt what is chance without them."""


def learn_health(
    recording: Recording, held_back: Sequence[int], provenance: Mapping[str, Any]
) -> dict[str, HealthModel]:
    """Learn what the healthy pad gives from the presses of a recording but those `held_back`, by index.

    Args:
        provenance: of the calibration that this is a part of; its "seed" is that of all that is random here.

    Returns:
        By name of the files, one model for recordings whose presses were commanded, and one for those that are found.

    Raises:
        InputError: too few presses, no living fibre, or an argument of another kind.
    """
    from padforge.sense.signals.press_detection import as_detected

    learnt = np.ones(len(check_type("recording", recording, Recording).presses_mm), dtype=bool)
    away = check_numbers(held_back, np.int64, "held_back")
    if away.ndim != 1 or not ((away >= 0) & (away < len(learnt))).all():
        raise InputError(f"held_back is {short_repr(held_back)}, allowed are presses from 0 to {len(learnt) - 1}")
    learnt[away] = False
    seed = check_int("the seed of provenance", check_mapping("provenance", provenance).get("seed"), 0, 2**64 - 1)
    readings, times_s = recording.readings, recording.times_s
    commanded = recording.down_command, recording.up_command
    edges = {COMMANDED: commanded, DETECTED: as_detected(readings, times_s, *commanded)}

    def fit(name: str) -> HealthModel:
        down_command, up_command = (edge[learnt] for edge in edges[name])
        rng = np.random.default_rng(seed)
        return fit_health_model(readings, times_s, down_command, up_command, rng=rng, provenance=provenance)

    with one_torch_thread():
        found = dict(run_tasks((name, partial(fit, name)) for name in edges))
    return {name: found[name] for name in edges}


def fit_health_model(
    readings: Array,
    times_s: Array,
    down_command: Indices,
    up_command: Indices,
    *,
    rng: np.random.Generator,
    false_alarms: float = FALSE_ALARMS,
    provenance: Mapping[str, Any] | None = None,
) -> HealthModel:
    """Learn from a recording of a healthy pad.

    Presses that lack a reading (NaN) of a living fibre are left out. One living fibre is enough for what its own
    readings tell (stuck, noisy, offset); whether it answers rightly only two or more tell. From fewer than
    WEAK_PRESSES a press at an unusual place looks like a weak fibre; such models never call one weak.

    Args:
        readings: (R, C) volts, NaN where missing. times_s: (R,) ascending, s.
        down_command, up_command: (Q,) first reading after the probe was sent down, and up.
        rng: source of all that is random. false_alarms: above 0, at most 0.1.

    Raises:
        InputError: shapes, indices or the rate of false alarms out of range, fewer than 300 presses that are
            whole, or no living fibre.
    """
    if not (false_alarms := check_float("false alarms a press", false_alarms, 0.0, MAX_FALSE_ALARMS)) > 0:
        raise InputError(f"false alarms a press are {false_alarms}, allowed is above 0 to {MAX_FALSE_ALARMS}")
    check_type("rng", rng, np.random.Generator)
    readings, times_s, down_command, up_command = checked_presses(readings, times_s, down_command, up_command)
    dead = dead_fibres(readings)
    traces = _whole_traces(readings, down_command, up_command, dead)
    shapes, inputs, targets = shapes_of(traces)
    held_out = _HeldOut.train(inputs, targets, rng)
    measured = traces[held_out.settled], targets[held_out.settled]
    evidence = FaultLikelihoods.fit(*measured, *held_out.without(np.array([], dtype=np.int64)), shapes.targets, rng)
    tail = _tail(evidence, measured, held_out, rng)
    rests = traces[:, :, :REST].mean(axis=2)
    return HealthModel(
        shapes=shapes,
        weights=held_out.weights,
        evidence=evidence,
        tail=tail if len(traces) >= WEAK_PRESSES else tail.without("weak"),
        rests=np.stack([rests.min(axis=0), rests.max(axis=0)]),
        fibres=readings.shape[1],
        dead=tuple(dead.tolist()),
        rate_hz=rate_of(times_s),
        presses=len(traces),
        false_alarms=false_alarms,
        provenance=provenance or {},
    )


def dead_fibres(readings: Array) -> Indices:
    """Indices of fibres of (R, C) readings that give one value, mostly nothing, or, unlike most, mostly the end of
    their range."""
    missing = np.isnan(readings).mean(axis=0) > 0.5
    spread = np.where(missing, 0.0, readings)
    low, high = np.nanmin(spread, axis=0), np.nanmax(spread, axis=0)
    at_end = np.maximum((spread == low).mean(axis=0), (spread == high).mean(axis=0))
    # Where there is no noise every fibre rests at the end of its range.
    saturated = (at_end > 0.5) & (np.median(at_end) <= 0.5)
    return np.flatnonzero(missing | (high - low < MIN_SCALE_V) | saturated)


def _whole_traces(readings: Array, down_command: Indices, up_command: Indices, dead: Indices) -> Array:
    """(Q, L, TRACE) traces of the living fibres, of the presses that lack none of their readings."""
    living = np.setdiff1d(np.arange(readings.shape[1]), dead)
    if len(living) == 0:
        raise InputError(f"all {len(dead)} fibres are dead: they read one value, or nothing; one must live")
    traces = traces_of(readings[:, living], down_command, up_command)
    traces = traces[np.isfinite(traces).all(axis=(1, 2))]
    if len(traces) < LEAST_PRESSES:
        raise InputError(f"recording has {len(traces)} whole presses, health is learnt from {LEAST_PRESSES} or more")
    return traces


@dataclass(frozen=True)
class _HeldOut:
    """Members that each never saw a fold of the presses: of its own presses a network thinks too well.

    Attributes:
        inputs: (Q, L, N), targets: (Q, L, T), scaled. fold: (Q,) of each press. settled: (Q,) presses to learn from.
    """

    inputs: Floats
    targets: Array
    fold: Indices
    settled: Mask
    weights: Weights

    @classmethod
    def train(cls, inputs: Floats, targets: Array, rng: np.random.Generator) -> "_HeldOut":
        presses = np.arange(len(inputs))
        fold, settled = presses // min(BLOCK, len(inputs) // (4 * MEMBERS)) % MEMBERS, presses >= SETTLED
        rows = [np.flatnonzero(settled & (fold != k)) for k in range(MEMBERS)]
        return cls(inputs, targets, fold, settled, train_predictors(inputs, targets, rows, rng))

    def without(self, lost: Indices) -> tuple[Array, Array]:
        """Means and spreads of settled presses without the fibres `lost`, by the member that never saw the press."""
        mean, spread = np.empty_like(self.targets), np.empty_like(self.targets)
        for k in range(MEMBERS):
            own = self.fold == k
            fibre_mask = np.tile(~np.isin(np.arange(self.inputs.shape[1]), lost), (own.sum(), 1))
            mean[own], spread[own] = expected(member(self.weights, k), self.inputs[own], fibre_mask)
        return mean[self.settled], spread[self.settled]


def _tail(
    evidence: FaultLikelihoods, measured: tuple[Array, Array], held_out: _HeldOut, rng: np.random.Generator
) -> Tail:
    """What is chance, learnt for each number of fibres left out; of those left out none has a say."""
    fibres, ratios = measured[0].shape[1], []
    for lost in range(min(MOST_LOST, fibres - 1) + 1):
        told = []
        for chosen in [rng.permutation(fibres)[:lost] for _ in range(LOSSES if lost else 1)]:
            stay, begin = evidence.ratios(*measured, *held_out.without(chosen))
            stay[:, chosen] = begin[:, chosen] = 0.0
            told.append((stay, begin))
        ratios.append((np.concatenate([stay for stay, _ in told]), np.concatenate([begin for _, begin in told])))
    return Tail.fit(ratios)
