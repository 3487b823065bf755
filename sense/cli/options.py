"""Shared options and arguments of the commands of `padforge sense`, the terminal, and summaries of recordings."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from padforge.common.command_line import echo
from padforge.common.validation import InputError

if TYPE_CHECKING:
    from padforge.sense.health.domain_shift import DomainShift
    from padforge.sense.health.fault_detector import FaultDetector, FibreFault
    from padforge.sense.localizer.model import Localization
    from padforge.sense.recording.recording import Recording


FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)

recording_argument = click.argument("recording", type=click.Path(path_type=Path))
model_option = click.option("--model", type=FOLDER, required=True, help="Folder that calibrate wrote.")
max_failures_option = click.option(
    "--max-failures", type=click.IntRange(0, 8), default=3, show_default=True, help="Most fibres that fail at once."
)


def fibres_option(name: str, text: str) -> Callable[..., Any]:
    """Return an option that takes numbers of fibres, from 1, separated by commas."""

    def parse(context: click.Context, param: click.Parameter, value: str) -> tuple[int, ...]:
        try:
            return tuple(int(number) for number in value.split(",") if number.strip())
        except ValueError:
            message = f"got {value!r}, expected whole numbers with commas between them"
            raise click.BadParameter(message) from None

    return click.option(name, metavar="N,N,...", default="", callback=parse, help=text)


def fibre_indices(numbers: Sequence[int], fibres: int) -> tuple[int, ...]:
    """Convert numbers of fibres, from 1, to indices; raises InputError for a missing fibre."""
    for number in numbers:
        if not 1 <= number <= fibres:
            raise InputError(f"fibre {number}: no such fibre, allowed are 1 to {fibres}")
    return tuple(number - 1 for number in numbers)


def read_recording(path: Path) -> "Recording":
    """Open a recording; print a line on stderr if its end is torn off, or if it omits parts of the file."""
    from padforge.sense.formats.import_export import open_recording

    recording = open_recording(path)
    if recording.torn_presses:
        echo(f"{path}: the end is torn off, its last {recording.torn_presses} presses are left out", err=True)
    if path.is_file():
        echo_note(recording, path)
    return recording


def echo_note(recording: "Recording", file: Path) -> None:
    """Print on stderr which parts of a file are not in its recording."""
    if note := recording.source.get("note"):
        echo(f"{file}: {note}", err=True)


def pressed_line(recording: "Recording") -> str:
    """Describe the presses and readings of a recording, and missing values, in one line."""
    import numpy as np

    from padforge.sense.recording.doubts import area_mm

    unknown, area = int((~recording.has_position).sum()), area_mm(recording)
    over = "" if area is None else f" over {area[0]:.4g} x {area[1]:.4g} mm"
    missing = int(np.isnan(recording.readings).sum())
    # a rate below 1 Hz comes from a wrong unit of time
    rate = f"{recording.rate_hz:.1f}" if recording.rate_hz >= 1 else f"{recording.rate_hz:.2g}"
    return (
        f"{len(recording.presses_mm)} presses{over}{f' ({unknown} of unknown position)' * (unknown > 0)}, "
        f"{len(recording.readings)} readings of {recording.fibres} fibres"
        f"{f', {missing} values missing,' * (missing > 0)} at {rate} Hz"
    )


def recording_line(recording: "Recording", out: Path) -> str:
    """Describe a recording in a folder in one line."""
    return f"{pressed_line(recording)} -> {out}"


class Prediction(NamedTuple):
    """Predictions of the models in a folder for a recording; without a health model no faults and shifts."""

    localization: "Localization"  # faulty fibres are masked from their first bad press on
    faults: "list[FibreFault]"
    shifts: "list[DomainShift]"
    detector: "FaultDetector | None"
    is_other_pad: bool  # then no fibre is reported or masked as faulty


def predict_despite_faults(
    model: Path, recording: "Recording", failed: Sequence[int] = (), moment: tuple[str, float] | None = None
) -> Prediction:
    """Localize all presses by the models in a folder, with faulty fibres masked from their first bad press on.

    The fibres of the numbers `failed`, from 1, are masked, too. If there is a `moment`, "touch" or "lift" and the time
    since then, s, only readings until this moment are used.
    """
    from padforge.sense.health.domain_shift import detect_shifts
    from padforge.sense.health.fault_detector import FaultDetector, has_health, mask_faults
    from padforge.sense.localizer.model import LocalizerModel
    from padforge.sense.localizer.moments import Moment
    from padforge.sense.recording.frames import framed
    from padforge.sense.signals.press_detection import first_readings

    localizer = LocalizerModel.load(model)
    detector = FaultDetector.load(model) if has_health(model) else None
    excluded = fibre_indices(failed, localizer.fibres)
    presses = localizer.scaled_features(recording)
    presses.fibre_mask[:, list(excluded)] = False
    is_other_pad = localizer.is_other_pad(presses)
    faults = detector.predict(recording) if detector and not is_other_pad else []
    fibre_mask = mask_faults(faults, len(recording.down_command), localizer.fibres)
    if moment is not None:
        if localizer.features != "windows":
            raise InputError(f"--at is given: the localizer is of method {localizer.method}, expected ensemble")
        frames, (since, time_s) = framed(recording), moment
        count, commands = round(time_s * frames.rate_hz), (frames.down_command, frames.up_command)
        end = Moment("lift", count) if since == "lift" else Moment("touch", max(count, 1))
        until = end.until(first_readings(frames.readings, frames.times_s, *commands), frames.up_command)
        presses = localizer.scaled_features(recording, until)
    localization = localizer.localize(replace(presses, fibre_mask=presses.fibre_mask & fibre_mask), excluded)
    fibre_mask[:, list(excluded)] = False
    has_shifts = detector is not None and not is_other_pad
    shifts = detect_shifts(localizer, detector.model_, recording, fibre_mask) if has_shifts else []
    return Prediction(localization, faults, shifts, detector, is_other_pad)


@contextmanager
def redrawn_lines() -> Iterator[Callable[[Sequence[str]], None] | None]:
    """Yield a function that replaces the lines shown on stdout; None if stdout is not a terminal."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console = Console()
    if not console.is_terminal:
        yield None
        return
    with Live(console=console, refresh_per_second=15) as display:
        yield lambda lines: display.update(Text("\n".join(lines)))


@contextmanager
def typed_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the keys typed since its last call; "" if stdin is not a POSIX terminal."""
    if os.name != "posix" or not sys.stdin.isatty():
        yield lambda: ""
        return
    import select
    import termios
    import tty

    stdin = sys.stdin.fileno()

    def read_keys() -> str:
        is_ready = bool(select.select([stdin], [], [], 0)[0])
        return os.read(stdin, 64).decode(errors="ignore") if is_ready else ""

    attributes = termios.tcgetattr(stdin)
    tty.setcbreak(stdin)
    try:
        yield read_keys
    finally:
        termios.tcsetattr(stdin, termios.TCSADRAIN, attributes)
