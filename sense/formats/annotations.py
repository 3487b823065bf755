"""Predictions of a trained model for the presses and fibres of a recording, to be exported with it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from padforge.common.validation import check_path, check_type
from padforge.sense.arrays import Array
from padforge.sense.recording.recording import Recording


@dataclass(frozen=True)
class FaultAnnotation:
    """A fault that a model detected."""

    press: int  # index of the press at which it was detected
    fibres: tuple[int, ...]  # indices
    kind: str  # one word
    text: str  # one line


@dataclass(frozen=True)
class ModelAnnotations:
    """Predictions for Q presses."""

    positions_mm: Array  # shape (Q, 2)
    std_mm: Array  # standard deviations of the positions; shape (Q, 2)
    r90_mm: Array  # radius that contains the true position in 90 % of presses; shape (Q,)
    depths_mm: Array  # NaN if the model predicts none; shape (Q,)
    depths_r90_mm: Array  # half width of the 90 % interval of the depth; shape (Q,)
    faults: Sequence[FaultAnnotation] | None = None  # in the order of presses; None if there is no health model
    dead: Sequence[int] = ()  # indices of fibres that never responded


def check_export(recording: object, path: object, annotations: object = None) -> Path:
    """Check the types of the arguments of an export, and return the path."""
    check_type("recording", recording, Recording)
    if annotations is not None:
        check_type("annotations", annotations, ModelAnnotations)
    return check_path("path", path)
