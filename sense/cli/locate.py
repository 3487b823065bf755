"""`padforge sense locate` and `health`: what a recording says of its presses and of its fibres."""

from pathlib import Path

import click

from design.common.command_line import json_option, out_option, pad_folder, profile_option, show_result

from .options import FibreNumbers, fibre_indices, model_option, read_recording, recording_argument


@click.command()
@model_option
@recording_argument
@click.option("--mask", type=FibreNumbers(), default=(), help="Fibres to leave out, by number, the first is 1.")
@out_option(what="CSV file for the places, places.csv", file=True)
@profile_option
def locate(model: Path, recording: Path, mask: tuple[int, ...], out: Path | None) -> None:
    """Find the place of every press of RECORDING, and how sure it is; no true place is needed.

    \b
    padforge sense locate --model out/pad out/later/recording --mask 1,4 --out places.csv

    \b
    The columns of the CSV: press (counted from 0), x_mm, y_mm, sd_x_mm, sd_y_mm (standard
    deviations), r50_mm, r90_mm (radii that hold the true place in 50 % and 90 % of cases);
    of a model that has learnt them also depth_mm, depth_r90_mm, force_n, force_r90_n.
    """
    from sense.health.model_folder import examined, has_health
    from sense.localizer import locating
    from sense.localizer.localizer import Localizer

    file = out or pad_folder(recording) / "places.csv"
    localizer = Localizer.load(model)
    lost = fibre_indices(mask, localizer.fibres)
    opened = read_recording(recording)
    findings = examined(model, opened)[1] if has_health(model) else []
    for finding in findings:
        click.echo(f"{finding.text}; left out from there on", err=True)
    found = locating.locate(localizer, opened, lost, findings)
    locating.write_places(found, file)
    click.echo(f"{len(found.r50_mm)} places -> {file}")


@click.command()
@model_option
@recording_argument
@json_option
@click.pass_context
def health(context: click.Context, model: Path, recording: Path, as_json: bool) -> None:
    """Say which fibres of RECORDING are lost, damaged or drifting, from the readings alone.

    \b
    padforge sense health --model out/pad out/later/recording

    Exit 1 if one is. Fibres are numbered from 1; in JSON "dead" and "fibres" hold indices, from 0.
    """
    from dataclasses import asdict

    from sense.health.model_folder import examined
    from sense.health.monitor import fault_lines

    opened = read_recording(recording)
    known, findings = examined(model, opened)
    document = {
        "format": "padforge-findings/1",
        "presses": len(opened.begun),
        "dead": list(known.dead),
        "findings": [asdict(finding) | {"text": finding.text} for finding in findings],
    }
    show_result(document, fault_lines(findings, opened.fibres, known.dead), as_json)
    context.exit(int(bool(findings)))
