"""Options and arguments that commands of sense share."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from sense.recordings.recording import Recording

METHODS, FEATURES = ("masked", "published"), ("full", "causal", "early", "published")

FILE = click.Path(path_type=Path, dir_okay=False)

FOLDER = click.Path(path_type=Path, file_okay=False)

recording_argument = click.argument("recording", type=click.Path(path_type=Path))


def recording_out_option(default: str) -> Callable[..., Any]:
    """`--out DIR`, the run directory that is written."""
    note = f"Folder of the recording; must be new or empty (default: {default})."
    return click.option("--out", type=FOLDER, help=note)


model_option = click.option("--model", type=FOLDER, required=True, help="Folder that calibrate wrote.")


class Numbers(click.ParamType):
    """Whole numbers with commas between them, as `0,3`."""

    name = "N,N,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            return tuple(int(part) for part in value.split(",") if part.strip())
        except ValueError:
            self.fail(f"got {value!r}, expected whole numbers with commas between them", param, ctx)


def read_recording(path: Path) -> "Recording":
    from sense.recordings.import_export import open_recording

    recording = open_recording(path)
    if recording.torn_presses:
        click.echo(f"{path}: the end is torn off, its last {recording.torn_presses} presses are left out", err=True)
    return recording
