"""What a healthy pad is like: learnt from a recording of one, kept in `health.safetensors` and `health.json`.

`monitor` follows presses by it and names the fibre that is lost, damaged or drifting.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from design.common.errors import InputError, instance, real
from design.common.files import atomic, read_bytes, read_json, writing
from design.common.settings import validated
from sense.processing.limits import LEAST_SPREAD_V, as_numbers, stream_of

from .alarm_thresholds import Tail
from .fault_likelihoods import HYPOTHESES, Evidence
from .fibre_prediction import MEMBERS, REST, Shapes, Weights, expected, member, shapes_of, traces_of, train_predictors
from .schema import FORMAT, LEAST_PRESSES, MAX_FALSE_ALARMS, MOST_LOST, WEAK_PRESSES, HealthDocument, refuse_unsound

RECORDED, FELT = "health", "health_live"
"""Names of the files of a model: learnt from presses as they were commanded, and as they are found in the readings."""
FALSE_ALARMS = 1e-5
"""False alarms a press, all fibres and kinds of fault together: one in 100 000 healthy presses."""
BLOCK = 50
"""Each member learns from all presses but its own fold, of blocks of successive ones: neighbours share what drifts."""
LOSSES = 4
"""Random choices of fibres left out from which it is learnt what is chance without them."""
SETTLED = 10
"""Presses after which the running level of a rest is worth comparing with."""
RATE_TOLERANCE = 0.25
"""Traces are counted in readings, so a recording must be about as fast as the one that was learnt from."""

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


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
    evidence: Evidence
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

    @classmethod
    def fit(
        cls,
        readings: Array,
        times_s: Array,
        begun: Indices,
        lifted: Indices,
        *,
        rng: np.random.Generator,
        false_alarms: float = FALSE_ALARMS,
        provenance: Mapping[str, Any] | None = None,
    ) -> "HealthModel":
        """Learn from a recording of a healthy pad.

        Presses that lack a reading (NaN) of a living fibre are left out. One living fibre is enough for what its own
        readings tell (stuck, noisy, offset); whether it answers rightly only two or more tell. From fewer than
        WEAK_PRESSES a press at an unusual place looks like a weak fibre; such models never call one weak.

        Args:
            readings: (R, C) volts, NaN where missing. times_s: (R,) ascending, s.
            begun, lifted: (Q,) first reading after the probe was sent down, and up.
            rng: source of all that is random. false_alarms: above 0, at most 0.1.

        Raises:
            InputError: shapes, indices or the rate of false alarms out of range, fewer than 300 presses that are
                whole, or no living fibre.
        """
        if not (false_alarms := real("false alarms a press", false_alarms, 0.0, MAX_FALSE_ALARMS)) > 0:
            raise InputError(f"false alarms a press are {false_alarms}, allowed is above 0 to {MAX_FALSE_ALARMS}")
        instance("rng", rng, np.random.Generator)
        readings, times_s, begun, lifted = checked_presses(readings, times_s, begun, lifted)
        dead = _dead(readings)
        living = np.setdiff1d(np.arange(readings.shape[1]), dead)
        if len(living) == 0:
            raise InputError(f"all {len(dead)} fibres are dead: they read one value, or nothing; one must live")
        traces = traces_of(readings[:, living], begun, lifted)
        traces = traces[np.isfinite(traces).all(axis=(1, 2))]
        if len(traces) < LEAST_PRESSES:
            raise InputError(
                f"recording has {len(traces)} whole presses, health is learnt from {LEAST_PRESSES} or more"
            )

        shapes, inputs, targets = shapes_of(traces)
        presses = np.arange(len(traces))
        fold, settled = presses // min(BLOCK, len(traces) // (4 * MEMBERS)) % MEMBERS, presses >= SETTLED
        weights = train_predictors(
            inputs, targets, [np.flatnonzero(settled & (fold != k)) for k in range(MEMBERS)], rng
        )

        def judged(lost: Indices) -> tuple[Array, Array]:
            """Means and spreads without the fibres `lost`, by the member that never saw the press: of its own presses
            a network thinks too well."""
            mean, spread = np.empty_like(targets), np.empty_like(targets)
            for k in range(MEMBERS):
                own = fold == k
                alive = np.tile(~np.isin(np.arange(len(living)), lost), (own.sum(), 1))
                mean[own], spread[own] = expected(member(weights, k), inputs[own], alive)
            return mean[settled], spread[settled]

        measured = traces[settled], targets[settled]
        evidence = Evidence.fit(*measured, *judged(np.array([], dtype=np.int64)), shapes.targets, rng)
        ratios = []
        for lost in range(min(MOST_LOST, len(living) - 1) + 1):
            sets = [rng.permutation(len(living))[:lost] for _ in range(LOSSES if lost else 1)]
            told = [_without(evidence.ratios(*measured, *judged(chosen)), chosen) for chosen in sets]
            ratios.append((np.concatenate([stay for stay, _ in told]), np.concatenate([begin for _, begin in told])))
        rests, tail = traces[:, :, :REST].mean(axis=2), Tail.fit(ratios)
        return cls(
            shapes=shapes,
            weights=weights,
            evidence=evidence,
            tail=tail if len(traces) >= WEAK_PRESSES else tail.without("weak"),
            rests=np.stack([rests.min(axis=0), rests.max(axis=0)]),
            fibres=readings.shape[1],
            dead=tuple(dead.tolist()),
            rate_hz=_rate_hz(times_s),
            presses=len(traces),
            false_alarms=false_alarms,
            provenance=provenance or {},
        )

    def refuse_other(self, readings: Array, times_s: Array) -> None:
        """Raise InputError if a recording has other fibres or another rate than the one that was learnt from."""
        if readings.shape[1] != self.fibres:
            raise InputError(f"recording has {readings.shape[1]} fibres, health was learnt from {self.fibres}")
        rate_hz = _rate_hz(times_s)
        if abs(rate_hz / self.rate_hz - 1) > RATE_TOLERANCE:
            raise InputError(
                f"recording has {rate_hz:.3g} readings a second, allowed is {self.rate_hz:.3g}, "
                f"at which health was learnt, within {RATE_TOLERANCE:.0%}"
            )

    def save(self, folder: str | Path, name: str = RECORDED) -> None:
        """Write NAME.safetensors and NAME.json; reading them back gives the same to the last bit.

        Raises:
            InputError: the provenance is no JSON, or `folder` cannot be written.
        """
        path, weights = files_of(folder, name)
        content = save({name: np.ascontiguousarray(array) for name, array in self._arrays().items()})
        document = {
            "format": FORMAT,
            "fibres": self.fibres,
            "dead": list(self.dead),
            "rate_hz": self.rate_hz,
            "false_alarms": self.false_alarms,
            "presses": self.presses,
            "weights_sha256": hashlib.sha256(content).hexdigest(),
            "provenance": dict(self.provenance),
        }
        try:
            text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: health cannot be written as JSON ({error})") from error
        with writing(path.parent), atomic(weights) as new_weights, atomic(path) as new_document:
            new_weights.write_bytes(content)
            new_document.write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, folder: str | Path, name: str = RECORDED) -> "HealthModel":
        """Read what `save` wrote.

        Raises:
            InputError: a file is missing, torn or of another kind, a value is none that `save` writes, or the two do
                not belong together.
        """
        path, weights = files_of(folder, name)
        document = validated(HealthDocument, read_json(path, FORMAT), f"{path}:")
        content = read_bytes(weights)
        if hashlib.sha256(content).hexdigest() != document.weights_sha256:
            raise InputError(f"{weights}: not the weights that {path.name} was written with; learn health again")
        dead = sorted(set(document.dead))
        if dead != document.dead or len(dead) >= document.fibres or not set(dead) < set(range(document.fibres)):
            raise InputError(f"{path}: dead is {document.dead}, expected some of {document.fibres} fibres")
        try:
            arrays = load(content)
            refuse_unsound(arrays, document.fibres - len(dead))
        except (KeyError, TypeError, ValueError, SafetensorError) as error:
            raise InputError(f"{weights}: no weights of the health that {path.name} describes ({error})") from error
        parts: dict[str, dict[str, Any]] = {"shapes": {}, "weights": {}, "evidence": {}, "tail": {}}
        for name, array in arrays.items():
            part, _, key = name.partition(".")
            if part in parts:
                parts[part][key] = array
        return cls(
            shapes=Shapes(**parts["shapes"]),
            weights=parts["weights"],
            evidence=Evidence(**parts["evidence"]),
            tail=Tail(**parts["tail"]),
            rests=arrays["rests"],
            fibres=document.fibres,
            dead=tuple(dead),
            rate_hz=document.rate_hz,
            presses=document.presses,
            false_alarms=document.false_alarms,
            provenance=document.provenance,
        )

    def _arrays(self) -> dict[str, NDArray[Any]]:
        parts = {"shapes": asdict(self.shapes), "weights": self.weights, "evidence": asdict(self.evidence)}
        parts["tail"] = asdict(self.tail)
        flat = {f"{part}.{key}": np.asarray(value) for part, values in parts.items() for key, value in values.items()}
        return flat | {"rests": self.rests}


def files_of(folder: str | Path, name: str) -> tuple[Path, Path]:
    """The document and the weights of the model `name` in a folder."""
    return Path(folder) / f"{name}.json", Path(folder) / f"{name}.safetensors"


def checked_presses(
    readings: ArrayLike, times_s: ArrayLike, begun: ArrayLike, lifted: ArrayLike
) -> tuple[Array, Array, Indices, Indices]:
    """Readings (R, C), R >= 2, their times (R,), and the presses (Q,) one after another, as plain arrays.

    Raises:
        InputError: they are something else.
    """
    times_s, readings = stream_of(times_s, readings)
    begun, lifted = (as_numbers(edges, np.int64, "presses", copy=False) for edges in (begun, lifted))
    if len(readings) < 2:
        raise InputError(f"readings have shape {readings.shape}, expected (R, C), R >= 2")
    if begun.ndim != 1 or begun.shape != lifted.shape or len(begun) == 0:
        raise InputError(f"presses have {begun.size} begins and {lifted.size} ends, expected as many, at least one")
    ends = np.stack([begun, lifted], axis=1).ravel()
    sound = np.concatenate([[begun[0] >= 1], (ends[1::2] > ends[::2]), ends[2::2] >= ends[1:-1:2]])
    if not sound.all() or lifted[-1] > len(readings):
        raise InputError(
            f"presses begin at {begun[0]} and end at {lifted[-1]} of {len(readings)} readings, expected a reading "
            "before the first, and each to end before the next begins"
        )
    return readings, times_s, begun, lifted


def _without(ratios: tuple[Array, Array], lost: Indices) -> tuple[Array, Array]:
    """Ratios (Q, L, H) in which the fibres `lost` have no say."""
    for ratio in ratios:
        ratio[:, lost] = 0.0
    return ratios


def _rate_hz(times_s: Array) -> float:
    return 1 / float(np.median(np.diff(times_s)))


def _dead(readings: Array) -> Indices:
    """Fibres that read one value, mostly nothing, or, unlike most, mostly the end of their range."""
    missing = np.isnan(readings).mean(axis=0) > 0.5
    spread = np.where(missing, 0.0, readings)
    low, high = np.nanmin(spread, axis=0), np.nanmax(spread, axis=0)
    at_end = np.maximum((spread == low).mean(axis=0), (spread == high).mean(axis=0))
    # Where there is no noise every fibre rests at the end of its range.
    saturated = (at_end > 0.5) & (np.median(at_end) <= 0.5)
    return np.flatnonzero(missing | (high - low < LEAST_SPREAD_V) | saturated)
