"""What a trained model says of the presses and fibres of a recording, for those who write it to files of others."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from padforge.design.common.validation import check_path as as_path
from padforge.design.common.validation import check_type
from padforge.sense.arrays import Array
from padforge.sense.recording.recording import Recording


@dataclass(frozen=True)
class FaultFound:
    """A fibre at fault: `kind` in a word and `text` in a line, by index, and the press at which it was named."""

    press: int
    fibres: tuple[int, ...]
    kind: str
    text: str


@dataclass(frozen=True)
class ModelFindings:
    """What a model says of Q presses.

    Attributes:
        positions_mm: (Q, 2). std_mm: (Q, 2) standard deviations. r90_mm: (Q,) radius that holds 90 % of presses.
        depths_mm: (Q,) and depths_r90_mm: (Q,) how far beside it 90 % are at most; NaN where depth was not learnt.
        faults: by the press at which they were named; None where health was not learnt.
        dead: fibres, by index, that never lived.
    """

    positions_mm: Array
    std_mm: Array
    r90_mm: Array
    depths_mm: Array
    depths_r90_mm: Array
    faults: Sequence[FaultFound] | None = None
    dead: Sequence[int] = ()


def export_path(recording: object, path: object, findings: object = None) -> Path:
    """Where a recording, and what a model says of it, is to be written.

    Raises:
        InputError: one of them is something else.
    """
    check_type("recording", recording, Recording)
    if findings is not None:
        check_type("findings", findings, ModelFindings)
    return as_path("path", path)
