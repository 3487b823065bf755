"""The localizer: from the readings of a press to its place, with any fibres lost. Needs no torch."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from design.errors import InputError
from design.files import atomic, read_json, write_json

from .network import Floats, Weights, forward, masked
from .presses import INPUTS
from .recording import Recording

FORMAT = "padforge-localizer/1"
DOCUMENT, WEIGHTS = "localizer.json", "localizer.safetensors"
RATE_TOLERANCE = 0.25
"""Windows are counted in readings, so a recording must be about as fast as the one that was learnt from."""
_CHUNK = 8192

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scaling:
    """How inputs become numbers of about 1, and what the network gives becomes mm.

    Attributes:
        centre, spread: (C, F) V; an input enters as (input - centre) / spread.
        middle_mm: (2,) place that the network calls 0. span_mm: distance that it calls 1.
    """

    centre: Array
    spread: Array
    middle_mm: Array
    span_mm: float

    @classmethod
    def fit(cls, inputs: Array, places_mm: Array) -> "Scaling":
        """From (Q, C, F) inputs and (Q, 2) places of the training presses.

        A window is scaled by the geometric mean of its own spread and its fibre's: the fine windows of a touch keep
        some of their smallness, and so of their noise. What never varied is left as large as it is.
        """
        own = inputs.std(axis=0)
        fibre = np.sqrt((own**2).mean(axis=1, keepdims=True))
        spread = np.sqrt(own * fibre)
        low, high = places_mm.min(axis=0), places_mm.max(axis=0)
        span = float((high - low).max() / 2)
        return cls(inputs.mean(axis=0), np.where(spread > 0, spread, 1.0), (low + high) / 2, span or 1.0)

    def inputs(self, inputs: Array) -> Floats:
        """(Q, C, F) volts to what the network takes."""
        return ((inputs - self.centre) / self.spread).astype(np.float32)

    def targets(self, places_mm: Array) -> Floats:
        """(Q, 2) mm to what the network gives."""
        return ((places_mm - self.middle_mm) / self.span_mm).astype(np.float32)

    def places_mm(self, targets: Floats) -> Array:
        """What the network gives to mm."""
        return targets * self.span_mm + self.middle_mm


@dataclass(frozen=True)
class Localizer:
    """A trained localizer.

    Attributes:
        weights: of the network, see `network.Weights`.
        scaling: of its inputs and outputs.
        features: which inputs it takes, a key of `presses.INPUTS`.
        rate_hz: readings per second of the recording it learnt from.
        learnt_from: digest of that recording, `test`: its presses that were held back, by index, and `split`: how.
        errors: on those, one row per number of lost fibres.
        provenance: where the localizer came from; free JSON.
    """

    weights: Weights
    scaling: Scaling
    features: str
    rate_hz: float
    learnt_from: str
    split: str
    test: tuple[int, ...]
    errors: Sequence[Mapping[str, Any]] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def fibres(self) -> int:
        """C, the number of fibres it was trained on, lost ones included."""
        return len(self.scaling.centre)

    def inputs(self, recording: Recording) -> Floats:
        """(Q, C, F) scaled inputs of every press of `recording`.

        Raises:
            InputError: the recording has other fibres or another rate than the one that was learnt from.
        """
        if recording.fibres != self.fibres:
            raise InputError(f"recording has {recording.fibres} fibres, the localizer was trained on {self.fibres}")
        if abs(recording.rate_hz / self.rate_hz - 1) > RATE_TOLERANCE:
            raise InputError(
                f"recording has {recording.rate_hz:.3g} readings a second, allowed is {self.rate_hz:.3g}, "
                f"at which the localizer was trained, within {RATE_TOLERANCE:.0%}"
            )
        return self.scaling.inputs(INPUTS[self.features](recording.readings, recording.begun, recording.lifted))

    def places(self, inputs: Floats, lost: ArrayLike = ()) -> Array:
        """(Q, C, F) scaled inputs to (Q, 2) places in mm, without what the fibres `lost`, by index, gave.

        Raises:
            InputError: a lost fibre that is not there, or none left.
        """
        alive = self._alive(lost)
        chunks = [inputs[i : i + _CHUNK] for i in range(0, len(inputs), _CHUNK)]
        found = [forward(self.weights, masked(chunk, alive)).mean(axis=0) for chunk in chunks]
        return self.scaling.places_mm(np.concatenate(found)) if found else np.empty((0, 2))

    def _alive(self, lost: ArrayLike) -> NDArray[np.bool_]:
        given = np.asarray(lost, dtype=np.int64).ravel()
        outside = given[(given < 0) | (given >= self.fibres)]
        if len(outside):
            raise InputError(f"lost fibre {outside[0]}: no such fibre, allowed are 0 to {self.fibres - 1}")
        alive = np.ones(self.fibres, dtype=bool)
        alive[given] = False
        if not alive.any():
            raise InputError(f"all {self.fibres} fibres are lost, at least one must be left")
        return alive

    def save(self, folder: str | Path) -> None:
        """Write `localizer.safetensors` and `localizer.json`; reading them back gives the same to the last bit."""
        folder = Path(folder)
        content = save({name: np.ascontiguousarray(weight) for name, weight in self.weights.items()})
        document = {
            "format": FORMAT,
            "features": self.features,
            "fibres": self.fibres,
            "rate_hz": self.rate_hz,
            "scaling": {
                "centre_v": self.scaling.centre.tolist(),
                "spread_v": self.scaling.spread.tolist(),
                "middle_mm": self.scaling.middle_mm.tolist(),
                "span_mm": self.scaling.span_mm,
            },
            "weights_sha256": hashlib.sha256(content).hexdigest(),
            "split": self.split,
            "test_presses": len(self.test),
            "errors": [dict(row) for row in self.errors],
            "learnt_from": self.learnt_from,
            "test": list(self.test),
            "provenance": dict(self.provenance),
        }
        with atomic(folder / WEIGHTS) as temporary:
            temporary.write_bytes(content)
        write_json(folder / DOCUMENT, document)

    @classmethod
    def load(cls, folder: str | Path) -> "Localizer":
        """Read what `save` wrote.

        Raises:
            InputError: a file is missing, torn or of another kind, or the two do not belong together.
        """
        folder = Path(folder)
        document = read_json(folder / DOCUMENT, FORMAT)
        try:
            content = (folder / WEIGHTS).read_bytes()
        except OSError as error:
            raise InputError(f"{folder / WEIGHTS}: cannot be read ({error.strerror})") from error
        if hashlib.sha256(content).hexdigest() != document.get("weights_sha256"):
            raise InputError(f"{folder / WEIGHTS}: not the weights that {DOCUMENT} was written with")
        try:
            scaling = document["scaling"]
            localizer = cls(
                weights=load(content),
                scaling=Scaling(
                    np.array(scaling["centre_v"], dtype=np.float64),
                    np.array(scaling["spread_v"], dtype=np.float64),
                    np.array(scaling["middle_mm"], dtype=np.float64),
                    float(scaling["span_mm"]),
                ),
                features=document["features"],
                rate_hz=float(document["rate_hz"]),
                learnt_from=document["learnt_from"],
                split=document["split"],
                test=tuple(document["test"]),
                errors=document["errors"],
                provenance=document["provenance"],
            )
        except (KeyError, TypeError, ValueError, SafetensorError) as error:
            raise InputError(f"{folder / DOCUMENT}: no valid localizer ({error!r})") from error
        if localizer.features not in INPUTS:
            raise InputError(
                f"{folder / DOCUMENT}: features is {localizer.features!r}, allowed are {', '.join(INPUTS)}"
            )
        return localizer
