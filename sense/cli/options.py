"""Options and arguments that commands of sense share, how far their work is, and a recording in one line."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.common.command_line import progress
from design.common.errors import InputError

if TYPE_CHECKING:
    from sense.recordings.recording import Recording

METHODS, FEATURES = ("masked", "published"), ("full", "causal", "early", "published")
FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)

recording_argument = click.argument("recording", type=click.Path(path_type=Path))
model_option = click.option("--model", type=FOLDER, required=True, help="Folder that calibrate wrote.")
lost_option = click.option(
    "--lost", type=click.IntRange(0, 8), default=3, show_default=True, help="Up to so many fibres lost at once."
)


class FibreNumbers(click.ParamType):
    """Numbers of fibres with commas between them, as `1,4`; they count from 1."""

    name = "N,N,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            return tuple(int(part) for part in value.split(",") if part.strip())
        except ValueError:
            self.fail(f"got {value!r}, expected whole numbers with commas between them", param, ctx)


def fibre_indices(numbers: Sequence[int], fibres: int) -> tuple[int, ...]:
    """Indices of the fibres that people number from 1; InputError for one that a pad of so many has not."""
    for number in numbers:
        if not 1 <= number <= fibres:
            raise InputError(f"fibre {number}: no such fibre, allowed are 1 to {fibres}")
    return tuple(number - 1 for number in numbers)


def read_recording(path: Path) -> "Recording":
    """The recording in a folder or file, with a line on stderr where its end is torn off."""
    from sense.recordings.import_export import open_recording

    recording = open_recording(path)
    if recording.torn_presses:
        click.echo(f"{path}: the end is torn off, its last {recording.torn_presses} presses are left out", err=True)
    return recording


def recording_line(recording: "Recording", out: Path) -> str:
    """A recording in one line, with what is missing of it."""
    import numpy as np

    unknown = int((~recording.known).sum())
    missing = int(np.isnan(recording.readings).sum())
    return (
        f"{len(recording.presses_mm)} presses{f' ({unknown} of unknown place)' * (unknown > 0)}, "
        f"{len(recording.readings)} readings of {recording.fibres} fibres"
        f"{f', {missing} values missing,' * (missing > 0)} at {recording.rate_hz:.1f} Hz -> {out}"
    )


@contextmanager
def reported(name: str) -> Iterator[Callable[[int, int], None]]:
    """Yield what shows on stderr how far the work is; with (0, 0) all that is said is that it goes on."""
    with progress() as bar:
        task = bar.add_task(name, total=None, note="")

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total or None, note=f"{done} of {total}" if total else "")

        yield report
