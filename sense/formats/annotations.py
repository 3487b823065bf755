"""What a trained model predicts for the presses and fibres of a recording, as exports carry it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from padforge.common.validation import check_path, check_type
from padforge.sense.arrays import Array
from padforge.sense.recording.recording import Recording


@dataclass(frozen=True)
class FaultAnnotation:
    """A fault of fibres (indices) that a model names at a press (index): its kind, one word, and a line of text."""

    press: int
    fibres: tuple[int, ...]
    kind: str
    text: str


@dataclass(frozen=True)
class ModelAnnotations:
    """Predictions for Q presses.

    Attributes:
        positions_mm: (Q, 2).
        std_mm: (Q, 2) standard deviations.
        r90_mm: (Q,) radius that holds the true position in 90 % of presses.
        depths_mm: (Q,) NaN where the model predicts no depth.
        depths_r90_mm: (Q,) error of the depth that 90 % of presses stay below.
        faults: in the order of presses; None if the model has no health model.
        dead: indices of fibres that never responded.
    """

    positions_mm: Array
    std_mm: Array
    r90_mm: Array
    depths_mm: Array
    depths_r90_mm: Array
    faults: Sequence[FaultAnnotation] | None = None
    dead: Sequence[int] = ()


def check_export(recording: object, path: object, annotations: object = None) -> Path:
    """Check the arguments of an export, and return the path; raise InputError where one is of another type."""
    check_type("recording", recording, Recording)
    if annotations is not None:
        check_type("annotations", annotations, ModelAnnotations)
    return check_path("path", path)
