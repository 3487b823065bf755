"""Files of a trained model: a JSON document and the arrays beside it, and the pad that a model is for."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from padforge.common.files import atomic_files, read_bytes
from padforge.common.validation import InputError, check_path
from padforge.sense.recording.frames import FRAME_S

RATE_TOLERANCE = 0.25  # share by which there may be fewer readings a second than a model was learnt from


class ModelFiles(NamedTuple):
    """NAME.json and NAME.safetensors, written together; the document holds the digest of the arrays."""

    document: Path
    weights: Path

    def write(self, document: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write a document with "weights_sha256" added, and arrays, together or not at all."""
        content = save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
        document = {**document, "weights_sha256": hashlib.sha256(content).hexdigest()}
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        with atomic_files(self.document.parent) as stage:
            (stage / self.weights.name).write_bytes(content)
            (stage / self.document.name).write_text(text, encoding="utf-8")

    def read_arrays(self, digest: str) -> dict[str, NDArray[Any]]:
        """Read the arrays that were written with a document of this digest."""
        content = read_bytes(self.weights)
        if hashlib.sha256(content).hexdigest() != digest:
            raise InputError(
                f"{self.weights}: not the weights that {self.document.name} was written with; calibrate again"
            )
        return load(content)


def files_of(folder: str | Path, name: str) -> ModelFiles:
    """Return the files of a model in a folder."""
    folder = check_path("folder", folder)
    return ModelFiles(folder / f"{name}.json", folder / f"{name}.safetensors")


def select_arrays(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names begin with a prefix, by their names without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def check_same_pad(model: Any, what: str, fibres: int, rate_hz: float) -> None:
    """Raise InputError if readings are of another number of fibres than a model, or too few for it in a second.

    `what` is the name of the model in messages; it has `fibres` and `rate_hz`, as the readings. More readings than
    there are frames (see `framed`) are averaged.
    """
    if fibres != model.fibres:
        raise InputError(f"readings are of {fibres} fibres, {what} was learnt from {model.fibres}")
    least_hz = (1 - RATE_TOLERANCE) * min(model.rate_hz, 1 / FRAME_S)
    if rate_hz < least_hz:
        raise InputError(f"there are {rate_hz:.3g} readings a second, {what} needs {least_hz:.3g} or more")
