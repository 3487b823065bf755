"""`padforge sense locate` and `health`: what a recording says of its presses and of its fibres."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from design.common.command_line import (
    json_option,
    profile_option,
    show_result,
)

from .options import FILE, Numbers, model_option, read_recording, recording_argument

if TYPE_CHECKING:
    from sense.health.health_model import HealthModel
    from sense.health.monitor import FibreFault
    from sense.recordings.recording import Recording


@click.command()
@model_option
@recording_argument
@click.option("--mask", type=Numbers(), default=(), help="Fibres to leave out, counted from 0.")
@click.option("--out", type=FILE, required=True, help="CSV file for the places and their radii.")
@profile_option
def locate(model: Path, recording: Path, mask: tuple[int, ...], out: Path) -> None:
    """Find the place of every press of RECORDING, and how sure it is; no true place is needed.

    \b
    padforge sense locate --model out/pad out/later/recording --out places.csv

    \b
    The columns of the CSV: press (counted from 0), x_mm, y_mm, sd_x_mm, sd_y_mm (standard
    deviations), r50_mm, r90_mm (radii that hold the true place in 50 % and 90 % of cases).
    """
    from sense.localizer.localizer import Localizer
    from sense.localizer.locating import locate as find
    from sense.localizer.locating import write_places

    opened = read_recording(recording)
    findings = _findings(model, opened)
    for finding in findings:
        click.echo(f"{finding.text}; left out from there on", err=True)
    found = find(Localizer.load(model), opened, mask, findings)
    write_places(found, out)
    click.echo(f"{len(found.r50_mm)} places -> {out}")


@click.command()
@model_option
@recording_argument
@json_option
@click.pass_context
def health(context: click.Context, model: Path, recording: Path, as_json: bool) -> None:
    """Say which fibres of RECORDING are lost, damaged or drifting, from the readings alone.

    \b
    padforge sense health --model out/pad out/later/recording

    Exit 1 if one is.
    """
    from dataclasses import asdict

    from sense.health.monitor import fault_lines

    opened = read_recording(recording)
    known, findings = _examined(model, opened)
    document = {
        "format": "padforge-findings/1",
        "presses": len(opened.begun),
        "dead": list(known.dead),
        "findings": [asdict(finding) | {"text": finding.text} for finding in findings],
    }
    show_result(document, fault_lines(findings, opened.fibres, known.dead), as_json)
    context.exit(int(bool(findings)))


def _findings(model: Path, recording: "Recording") -> "list[FibreFault]":
    """What is wrong with the fibres of a recording, as far as the model's folder tells health."""
    from sense.health.health_model import RECORDED, files_of

    return _examined(model, recording)[1] if files_of(model, RECORDED)[0].exists() else []


def _examined(model: Path, recording: "Recording") -> "tuple[HealthModel, list[FibreFault]]":
    """What health is told by, presses that were found by what was learnt from such, and what is wrong."""
    from sense.health.health_model import FELT, RECORDED, HealthModel
    from sense.health.monitor import examine
    from sense.recordings.import_export import FOUND

    name = FELT if FOUND.items() <= recording.source.items() else RECORDED
    known = HealthModel.load(model, name)
    return known, examine(known, recording.readings, recording.times_s, recording.begun, recording.lifted)
