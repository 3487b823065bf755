"""What commands of sense share: options and arguments, what a terminal shows and is typed, a recording in one line."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common.command_line import progress
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from padforge.sense.recording.recording import Recording


METHODS, FEATURES = ("ensemble", "published"), ("press_and_release", "causal", "onset", "published")
SHOWN_HZ = 15
"""How often a terminal is drawn anew."""
FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)

recording_argument = click.argument("recording", type=click.Path(path_type=Path))
model_option = click.option("--model", type=FOLDER, required=True, help="Folder that calibrate wrote.")
max_failures_option = click.option(
    "--max-failures", type=click.IntRange(0, 8), default=3, show_default=True, help="Up to so many fibres lost at once."
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
    """The recording in a folder or file, with a line on stderr where its end is torn off or cut off."""
    from padforge.sense.formats.import_export import open_recording

    recording = open_recording(path)
    if recording.torn_presses:
        click.echo(f"{path}: the end is torn off, its last {recording.torn_presses} presses are left out", err=True)
    if path.is_file():
        say_note(recording, path)
    return recording


def say_note(recording: "Recording", file: Path) -> None:
    """Say on stderr what of a file did not become part of its recording."""
    if note := recording.source.get("note"):
        click.echo(f"{file}: {note}", err=True)


def recording_line(recording: "Recording", out: Path) -> str:
    """A recording in one line, with what is missing of it."""
    import numpy as np

    unknown = int((~recording.has_position).sum())
    missing = int(np.isnan(recording.readings).sum())
    return (
        f"{len(recording.presses_mm)} presses{f' ({unknown} of unknown place)' * (unknown > 0)}, "
        f"{len(recording.readings)} readings of {recording.fibres} fibres"
        f"{f', {missing} values missing,' * (missing > 0)} at {_rate(recording.rate_hz)} Hz -> {out}"
    )


def _rate(hz: float) -> str:
    """A rate as people say it; one that a wrong unit of time made small is seen to be."""
    return f"{hz:.1f}" if hz >= 1 else f"{hz:.2g}"


@contextmanager
def reported(name: str) -> Iterator[Callable[[int, int], None]]:
    """Yield what shows on stderr how far the work is; with (0, 0) all that is said is that it goes on."""
    with progress() as bar:
        task = bar.add_task(name, total=None, note="")

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total or None, note=f"{done} of {total}" if total else "")

        yield report


@contextmanager
def drawn_anew() -> Iterator[Callable[[Sequence[str]], None] | None]:
    """Yield what shows lines on stdout in place of those before; None where that is no terminal."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console = Console()
    if not console.is_terminal:
        yield None
        return
    with Live(console=console, refresh_per_second=SHOWN_HZ) as drawn:
        yield lambda lines: drawn.update(Text("\n".join(lines)))


@contextmanager
def typed_keys() -> Iterator[Callable[[], str]]:
    """Yield what gives the keys typed since it was called last, unseen; none where stdin is no POSIX terminal."""
    if os.name != "posix" or not sys.stdin.isatty():
        yield lambda: ""
        return
    import select
    import termios
    import tty

    stdin = sys.stdin.fileno()

    def typed() -> str:
        waiting = bool(select.select([stdin], [], [], 0)[0])
        return os.read(stdin, 64).decode(errors="ignore") if waiting else ""

    before = termios.tcgetattr(stdin)
    tty.setcbreak(stdin)
    try:
        yield typed
    finally:
        termios.tcsetattr(stdin, termios.TCSADRAIN, before)
