"""Files of a trained model: a JSON document and the arrays beside it, and the pad that a model is for."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors.numpy import load, save

from padforge.common.files import atomic_files, read_bytes, read_json
from padforge.common.validation import InputError, check_path, check_type, short_repr
from padforge.sense.recording.frames import FRAME_S

DOCUMENT_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)  # of dataclasses that are documents
RATE_TOLERANCE = 0.25  # share by which readings a second may be fewer than in the training of a model

T = TypeVar("T")


class ModelFiles(NamedTuple):
    """NAME.json and NAME.safetensors, written together; the document holds the digest of the arrays."""

    document: Path
    weights: Path

    def write(self, form: str, document: Mapping[str, Any], parts: Mapping[str, Any]) -> None:
        """Write a document and arrays, together or not at all; "format" and "weights_sha256" are added to the document.

        Each of the `parts` is an array, or a mapping, dataclass or tuple of parts; the name of an array in the file is
        its path, such as `bayes.0.grid`.
        """
        content = save(_flatten(parts))
        document = {"format": form, **document, "weights_sha256": hashlib.sha256(content).hexdigest()}
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        with atomic_files(self.document.parent) as stage:
            (stage / self.weights.name).write_bytes(content)
            (stage / self.document.name).write_text(text, encoding="utf-8")

    def read_document(self, form: str, kind: "TypeAdapter[T]") -> tuple[T, str]:
        """Read a document of a format, checked, and the digest of its arrays."""
        document = read_json(self.document, form)
        values = {name: value for name, value in document.items() if name not in ("format", "weights_sha256")}
        try:
            read = kind.validate_json(json.dumps(values))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            message = f"{key} is {short_repr(first['input'])}: {first['msg'].lower()}"
            raise InputError(f"{self.document}: {message}") from error
        return read, check_type(f"{self.document}: weights_sha256", document.get("weights_sha256"), str)

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


def _flatten(part: Any, path: str = "") -> dict[str, NDArray[Any]]:
    """Return the arrays of a part by their path."""
    if isinstance(part, np.ndarray):
        return {path: np.ascontiguousarray(part)}
    if is_dataclass(part):
        part = {each.name: getattr(part, each.name) for each in fields(part)}
    items = enumerate(part) if isinstance(part, tuple) else part.items()
    return {
        name: array for key, each in items for name, array in _flatten(each, f"{path}.{key}" if path else key).items()
    }


def select_arrays(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names begin with a prefix, by their names without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def check_same_pad(model: Any, what: str, fibres: int, rate_hz: float) -> None:
    """Raise InputError if readings are of another number of fibres than a model, or too few for it in a second.

    The model, whose name in messages is `what`, has its own `fibres` and `rate_hz`. Of a higher rate than that of
    frames (see `framed`) only the frames count.
    """
    if fibres != model.fibres:
        raise InputError(f"readings are of {fibres} fibres, {what} was learnt from {model.fibres}")
    least_hz = (1 - RATE_TOLERANCE) * min(model.rate_hz, 1 / FRAME_S)
    if rate_hz < least_hz:
        raise InputError(f"there are {rate_hz:.3g} readings a second, {what} needs {least_hz:.3g} or more")
