"""The localizer: from the readings of a press to its place, with any fibres lost. Needs no torch."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from design.errors import InputError
from design.files import atomic, read_json

from .document import FORMAT, LEAST_SPREAD_V, read_document
from .network import Floats, Weights, forward, masked, refuse_unsound
from .output import writing
from .presses import INPUTS
from .recording import Recording

DOCUMENT, WEIGHTS = "localizer.json", "localizer.safetensors"
RATE_TOLERANCE = 0.25
"""Windows are counted in readings, so a recording must be about as fast as the one that was learnt from."""
MAX_INPUT = 1e4
"""Greatest scaled input, in spreads: what lies further off is no press, and is held there."""
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
        return cls(inputs.mean(axis=0), np.where(spread >= LEAST_SPREAD_V, spread, 1.0), (low + high) / 2, span or 1.0)

    def inputs(self, inputs: Array) -> Floats:
        """(Q, C, F) volts to what the network takes."""
        return np.clip((inputs - self.centre) / self.spread, -MAX_INPUT, MAX_INPUT).astype(np.float32)

    def targets(self, places_mm: Array) -> Floats:
        """(Q, 2) mm to what the network gives."""
        return ((places_mm - self.middle_mm) / self.span_mm).astype(np.float32)

    def places_mm(self, targets: Floats) -> Array:
        """What the network gives to mm."""
        return targets * self.span_mm + self.middle_mm

    @property
    def entries(self) -> int:
        """D, the numbers that enter the network: the inputs, and one a fibre that says whether it lives."""
        return self.centre.size + len(self.centre)


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
        alive = np.ones(self.fibres, dtype=bool)
        for fibre in np.asarray(lost).ravel().tolist():
            if type(fibre) is not int or not 0 <= fibre < self.fibres:
                raise InputError(f"lost fibre {fibre}: no such fibre, allowed are 0 to {self.fibres - 1}")
            alive[fibre] = False
        if not alive.any():
            raise InputError(f"all {self.fibres} fibres are lost, at least one must be left")
        return alive

    def save(self, folder: str | Path) -> None:
        """Write `localizer.safetensors` and `localizer.json`; reading them back gives the same to the last bit.

        Nothing is touched before both are complete. The document has the digest of its weights, so `load` tells a
        pair that was interrupted between its halves from a whole one.

        Raises:
            InputError: something is not finite or no JSON, or `folder` cannot be written.
        """
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
        try:
            text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        except (TypeError, ValueError) as error:
            raise InputError(f"{folder / DOCUMENT}: localizer cannot be written as JSON ({error})") from error
        with writing(folder), atomic(folder / WEIGHTS) as new_weights, atomic(folder / DOCUMENT) as new_document:
            new_weights.write_bytes(content)
            new_document.write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, folder: str | Path) -> "Localizer":
        """Read what `save` wrote.

        Raises:
            InputError: a file is missing, torn or of another kind, a value is none that `save` writes, or the two do
                not belong together.
        """
        folder = Path(folder)
        document = read_document(read_json(folder / DOCUMENT, FORMAT), str(folder / DOCUMENT))
        path = folder / WEIGHTS
        try:
            content = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error
        if hashlib.sha256(content).hexdigest() != document.weights_sha256:
            raise InputError(f"{path}: not the weights that {DOCUMENT} was written with; calibrate again")
        scaling = Scaling(
            np.array(document.scaling.centre_v),
            np.array(document.scaling.spread_v),
            np.array(document.scaling.middle_mm),
            document.scaling.span_mm,
        )
        try:
            weights = load(content)
            refuse_unsound(weights, scaling.entries)
        except (KeyError, TypeError, ValueError, SafetensorError) as error:
            raise InputError(f"{path}: no weights of the localizer that {DOCUMENT} describes ({error})") from error
        return cls(
            weights=weights,
            scaling=scaling,
            features=document.features,
            rate_hz=document.rate_hz,
            learnt_from=document.learnt_from,
            split=document.split,
            test=tuple(document.test),
            errors=[row.model_dump() for row in document.errors],
            provenance=document.provenance,
        )
