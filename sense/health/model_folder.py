"""Health in the folder of a model, as `calibrate` leaves it there: what is known of a recording's fibres by it."""

from collections.abc import Collection
from pathlib import Path

from padforge.design.common.files import resolve_exchange
from padforge.sense.recordings.formats.assembly import FOUND
from padforge.sense.recordings.recording import Recording

from padforge.sense.health.health_model import COMMANDED, DETECTED, HealthModel
from padforge.sense.health.monitor import FibreFault, examine
from padforge.sense.health.trained_model import files_of


def has_health(model: Path, name: str = COMMANDED) -> bool:
    """Whether health was learnt into a folder."""
    return resolve_exchange(files_of(model, name).document).exists()


def examined(model: Path, recording: Recording) -> tuple[HealthModel, list[FibreFault]]:
    """What health is told by, presses that were found by what was learnt from such, and what is wrong.

    Raises:
        InputError: health was not learnt into this folder, or does not suit the recording.
    """
    known = HealthModel.load(model, DETECTED if FOUND.items() <= recording.source.items() else COMMANDED)
    return known, examine(known, recording.readings, recording.times_s, recording.begun, recording.lifted)


def health_files(names: Collection[str] = (COMMANDED, DETECTED)) -> set[str]:
    """Names of the files in a folder by which it tells health, for those of its models that are named."""
    return {file.name for name in names for file in files_of(Path(), name)}


def health_in(model: Path) -> dict[str, HealthModel]:
    """What the folder of a model tells health by, by the names of its files; nothing where none was learnt.

    Raises:
        InputError: it is damaged.
    """
    return {name: HealthModel.load(model, name) for name in (COMMANDED, DETECTED) if has_health(model, name)}
