"""What all that is trained on a recording shares: a document with its weights beside it, the pad it suits, its rate."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from padforge.design.common.files import atomic_files, read_bytes
from padforge.design.common.validation import InputError, check_type, short_repr
from padforge.design.common.validation import check_path as as_path

RATE_TOLERANCE = 0.25
"""Windows are counted in readings, so a recording must be about as fast as the one that was learnt from."""


class ModelFiles(NamedTuple):
    """NAME.json and NAME.safetensors, of which the first has the digest of the second.

    They are written together; a pair whose halves somebody has mixed is told from a whole one.
    """

    document: Path
    weights: Path

    def write(self, document: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], what: str) -> None:
        """Write `document`, its "weights_sha256" filled in, and `arrays`, together or not at all.

        Raises:
            InputError: the document of `what` is not finite or no JSON, or the folder cannot be written.
        """
        content = save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
        document = {**document, "weights_sha256": hashlib.sha256(content).hexdigest()}
        try:
            text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.document}: {what} cannot be written as JSON ({error})") from error
        with atomic_files(self.document.parent) as stage:
            (stage / self.weights.name).write_bytes(content)
            (stage / self.document.name).write_text(text, encoding="utf-8")

    @contextmanager
    def arrays(self, digest: str, what: str) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the arrays that were written with a document that has this digest of them, to be checked in the body.

        Raises:
            InputError: they cannot be read or are others, or the body raises what says that they are unsound.
        """
        content, name = read_bytes(self.weights), self.document.name
        if hashlib.sha256(content).hexdigest() != digest:
            raise InputError(f"{self.weights}: not the weights that {name} was written with; calibrate again")
        try:
            yield load(content)
        except (KeyError, TypeError, ValueError, SafetensorError) as error:
            raise InputError(f"{self.weights}: no weights of {what} that {name} describes ({error})") from error


def files_of(folder: str | Path, name: str) -> ModelFiles:
    """The files of the model `name` in a folder.

    Raises:
        InputError: `folder` is no path, or `name` no plain name.
    """
    folder = as_path("folder", folder)
    if not re.fullmatch(r"\w{1,100}", check_type("name", name, str)):
        raise InputError(f"name is {short_repr(name)}, expected letters, digits and underscores")
    return ModelFiles(folder / f"{name}.json", folder / f"{name}.safetensors")


class TrainedModel(Protocol):
    """Trained on `fibres` fibres, lost ones included, of which there were `rate_hz` readings per second."""

    @property
    def fibres(self) -> int: ...

    @property
    def rate_hz(self) -> float: ...


def refuse_other_pad(model: TrainedModel, what: str, fibres: int, rate_hz: float) -> None:
    """Raise InputError if readings are of other fibres, or come at another rate, than those `model` was trained on."""
    if fibres != model.fibres:
        raise InputError(f"readings are of {fibres} fibres, {what} was learnt from {model.fibres}")
    if abs(rate_hz / model.rate_hz - 1) > RATE_TOLERANCE:
        raise InputError(
            f"there are {rate_hz:.3g} readings a second, allowed is {model.rate_hz:.3g}, at which {what} was learnt, "
            f"within {RATE_TOLERANCE:.0%}"
        )
