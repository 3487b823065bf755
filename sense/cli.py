"""`padforge sense`: the edge where recordings come in and places go out."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.console import json_option, load_spec, profile_option, progress, seed_option, show_result, spec_option
from design.errors import InputError

from .cli_live import live
from .cli_studies import recalibrate, robustness, size_curve
from .rig.cli import describe, doctor, record

if TYPE_CHECKING:
    from design.settings import Spec

    from .health import HealthModel
    from .localizer import Localizer
    from .monitor import Finding
    from .recording import Recording

METHODS, FEATURES = ("masked", "published"), ("full", "causal", "early", "published")

_FILE = click.Path(path_type=Path, dir_okay=False)
_FOLDER = click.Path(path_type=Path, file_okay=False)

recording_argument = click.argument("recording", type=click.Path(path_type=Path))


def recording_out_option(default: str) -> Callable[..., Any]:
    """`--out DIR`, the run directory that is written."""
    note = f"Folder of the recording; must be new or empty (default: {default})."
    return click.option("--out", type=_FOLDER, help=note)


model_option = click.option("--model", type=_FOLDER, required=True, help="Folder that calibrate wrote.")


class _Numbers(click.ParamType):
    """Whole numbers with commas between them, as `0,3`."""

    name = "N,N,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            return tuple(int(part) for part in value.split(",") if part.strip())
        except ValueError:
            self.fail(f"got {value!r}, expected whole numbers with commas between them", param, ctx)


@click.group()
def sense() -> None:
    """Record presses, learn places from them and find new ones.

    \b
    padforge sense record --morphology out/pad/morphology.json
    padforge sense calibrate out/pad/recording
    padforge sense locate --model out/pad out/later/recording --out places.csv
    """


sense.add_command(record)
sense.add_command(doctor)
sense.add_command(live)
sense.add_command(recalibrate)
sense.add_command(robustness)
sense.add_command(size_curve)


@sense.command("import")
@click.argument("file", type=_FILE)
@recording_out_option("out/NAME/recording for NAME.mat")
def import_(file: Path, out: Path | None) -> None:
    """Make a recording of FILE, a published .mat, a .csv or a .h5 that export wrote.

    \b
    padforge sense import readings.csv --out out/lab/recording

    \b
    The CSV has the columns time_s, one of volts per fibre, x_mm, y_mm; the last two hold
    the place pressed while the probe is down and are empty on all other lines.
    """
    from design.files import provenance

    from .exchange import import_file
    from .recorder import refuse_existing

    folder = out or Path("out") / file.stem / "recording"
    refuse_existing(folder)
    recording = import_file(file)
    recording.save(folder, provenance("padforge sense import", inputs=[file]))
    click.echo(describe(recording, folder))


@sense.command()
@recording_argument
@click.argument("file", type=_FILE)
def export(recording: Path, file: Path) -> None:
    """Write RECORDING to FILE, as HDF5 (.h5) or CSV (.csv), for other programs.

    \b
    padforge sense export out/pad/recording recording.h5
    """
    from .exchange import export_file

    export_file(_open(recording), file)
    click.echo(f"{recording} -> {file}")


@sense.command()
@recording_argument
@click.option("--method", type=click.Choice(METHODS), help="masked: one network for every loss; or as published.")
@click.option("--features", type=click.Choice(FEATURES), help="full: press and release; causal: to its end; early.")
@click.option("--test-split", type=click.Choice(["random", "chronological"]), help="Presses held back for the test.")
@seed_option
@spec_option
@click.option("--out", type=_FOLDER, help="Folder for the results (default: the one RECORDING lies in).")
@json_option
@profile_option
def calibrate(
    recording: Path,
    method: str | None,
    features: str | None,
    test_split: str | None,
    seed: int | None,
    spec: Path | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Learn places from RECORDING and test on presses held back.

    \b
    padforge sense calibrate out/pad/recording --test-split chronological

    Writes localizer and health (.safetensors, .json), health_live for touches found live, calibration.json,
    error_map.png and error_by_loss.png.
    """
    from design.output import claimed

    overrides = {"method": method, "features": features, "split": test_split, "seed": seed}
    folder = out or recording.absolute().parent
    with claimed(folder):
        document = run_calibration(load_spec(spec), _open(recording), folder, overrides)
    show_result(document, summary(document), as_json)


def run_calibration(spec: "Spec", recording: "Recording", out: Path, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Calibrate with the settings of `spec`, write all results to `out`, and return `calibration.json`.

    Nothing in `out` changes before the last result is there.
    """
    from design.files import write_json
    from design.output import refuse_unwritable, staged
    from design.profiling import stage

    from . import health as watch
    from .calibration import calibrate as learn
    from .figures import draw_error_by_loss, draw_error_map
    from .settings import Localizer

    refuse_unwritable(out)
    options = spec.section(Localizer, **overrides)
    with progress() as bar:
        task = bar.add_task("training", total=None, note="")

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, note=f"step {done} of {total}")

        localizer, document = learn(recording, options, progress=report)
        bar.update(task, total=None, note="the health of the fibres")
        with stage("health"):
            health = _health(recording, localizer)
    with staged(out) as folder:
        localizer.save(folder)
        for name, model in health.items():
            model.save(folder, name)
        write_json(folder / "calibration.json", document)
        with stage("figures"):
            draw_error_map(document, folder / "error_map.png")
            draw_error_by_loss(document, folder / "error_by_loss.png")
    if not health:
        for name in (watch.RECORDED, watch.FELT):  # of an earlier calibration, which must not speak for this one
            for file in watch.files_of(out, name):
                file.unlink(missing_ok=True)
    return document


def _health(recording: "Recording", localizer: "Localizer") -> "dict[str, HealthModel]":
    """Models that health is told by, or none, and a line that says so, where the recording does not suffice."""
    from .calibration import learn_health

    try:
        return learn_health(recording, localizer)
    except InputError as error:
        click.echo(f"no watch is kept on the fibres' health: {error}", err=True)
        return {}


@sense.command()
@model_option
@recording_argument
@click.option("--lost", type=_Numbers(), help="How many fibres to lose (default: 0 to 3, as far as one is left).")
@json_option
@profile_option
def evaluate(model: Path, recording: Path, lost: tuple[int, ...] | None, as_json: bool) -> None:
    """Errors on RECORDING for every set of lost fibres.

    \b
    padforge sense evaluate --model out/pad out/later/recording --lost 0,1

    Of the recording the model was trained on, only the presses that were held back count.
    """
    from .calibration import evaluate as test
    from .localizer import Localizer

    localizer = Localizer.load(model)
    levels = range(min(4, localizer.fibres)) if lost is None else lost
    document = test(localizer, _open(recording), levels)
    show_result(document, summary(document), as_json)


@sense.command()
@model_option
@recording_argument
@click.option("--mask", type=_Numbers(), default=(), help="Fibres to leave out, counted from 0.")
@click.option("--out", type=_FILE, required=True, help="CSV file for the places and their radii.")
@profile_option
def locate(model: Path, recording: Path, mask: tuple[int, ...], out: Path) -> None:
    """Find the place of every press of RECORDING, and how sure it is; no true place is needed.

    \b
    padforge sense locate --model out/pad out/later/recording --out places.csv

    \b
    The columns of the CSV: press (counted from 0), x_mm, y_mm, sd_x_mm, sd_y_mm (standard
    deviations), r50_mm, r90_mm (radii that hold the true place in 50 % and 90 % of cases).
    """
    from .calibration import locate as find
    from .localizer import Localizer
    from .places import write_places

    opened = _open(recording)
    findings = _findings(model, opened)
    for finding in findings:
        click.echo(f"{finding.text}; left out from there on", err=True)
    found = find(Localizer.load(model), opened, mask, findings)
    write_places(found, out)
    click.echo(f"{len(found.r50_mm)} places -> {out}")


@sense.command()
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

    from .monitor import lines

    opened = _open(recording)
    known, findings = _examined(model, opened)
    document = {
        "format": "padforge-findings/1",
        "presses": len(opened.begun),
        "dead": list(known.dead),
        "findings": [asdict(finding) | {"text": finding.text} for finding in findings],
    }
    show_result(document, lines(findings, opened.fibres, known.dead), as_json)
    context.exit(int(bool(findings)))


def _findings(model: Path, recording: "Recording") -> "list[Finding]":
    """What is wrong with the fibres of a recording, as far as the model's folder tells health."""
    from .health import RECORDED, files_of

    return _examined(model, recording)[1] if files_of(model, RECORDED)[0].exists() else []


def _examined(model: Path, recording: "Recording") -> "tuple[HealthModel, list[Finding]]":
    """What health is told by, presses that were found by what was learnt from such, and what is wrong."""
    from .exchange import FOUND
    from .health import FELT, RECORDED, HealthModel
    from .monitor import examine

    name = FELT if FOUND.items() <= recording.source.items() else RECORDED
    known = HealthModel.load(model, name)
    return known, examine(known, recording.readings, recording.times_s, recording.begun, recording.lifted)


def _open(path: Path) -> "Recording":
    from .recording import Recording

    recording = Recording.open(path)
    if recording.torn_presses:
        click.echo(f"{path}: the end is torn off, its last {recording.torn_presses} presses are left out", err=True)
    return recording


def summary(document: Mapping[str, Any]) -> list[str]:
    """The errors of a calibration document as a table for people."""
    names = ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm")
    return [
        f"error in mm on {document['test_presses']} presses (split: {document['split']})",
        "lost  sets   mean    std    max median    p95  in r50  in r90",
        *(
            f"{row['lost']:4d} {row['subsets']:5d} {' '.join(f'{row[name]:6.2f}' for name in names)} "
            f"{row['within_r50']:7.1%} {row['within_r90']:7.1%}"
            for row in document["errors"]
        ),
    ]
