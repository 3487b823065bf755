"""What a healthy pad is like: learnt from a recording of one, kept in `health.safetensors` and `health.json`.

`monitor` follows presses by it and names the fibre that is lost, damaged or drifting.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.design.common.files import read_json
from padforge.design.common.settings import validate
from padforge.design.common.validation import InputError
from padforge.sense.recordings.processing.limits import Array, Indices, as_numbers, stream_of
from padforge.sense.recordings.recording import rate_of

from padforge.sense.health.alarm_thresholds import Tail
from padforge.sense.health.fault_likelihoods import HYPOTHESES, FaultLikelihoods
from padforge.sense.health.fibre_prediction import Shapes, Weights
from padforge.sense.health.schema import FORMAT, HealthDocument, refuse_unsound
from padforge.sense.health.trained_model import files_of, refuse_other_pad

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
        refuse_other_pad(self, "health", readings.shape[1], rate_of(times_s))

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
