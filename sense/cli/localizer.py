"""Commands of `padforge sense` that fit, evaluate and apply models."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from padforge.common import command_line as common
from padforge.common.validation import InputError
from padforge.sense.cli.options import (
    FILE,
    FOLDER,
    fibre_indices,
    fibres_option,
    max_failures_option,
    model_option,
    predict_despite_faults,
    pressed_line,
    read_recording,
    recording_argument,
)


@click.command()
@recording_argument
@click.option(
    "--method",
    type=click.Choice(["ensemble", "published"]),
    help="ensemble: one localizer for all failed fibres; published: the network of the paper.",
)
@click.option(
    "--morphology", type=FILE, help="The pad as planned: morphology.json or published .mat, for up to 500 presses."
)
@click.option(
    "--test-split", "split", type=click.Choice(["random", "chronological"]), help="How test presses are chosen."
)
@click.option(
    "--time-budget",
    type=common.FiniteRange(min=0, min_open=True),
    metavar="S",
    help="Train for S seconds; radii, errors and health come on top.",
)
@click.option(
    "--without",
    type=click.Choice(["health", "figures", "moments"]),
    multiple=True,
    help="Leave out the health of the fibres, the figures, or the errors by moment; may be given several times.",
)
@common.seed_option
@common.spec_option
@common.out_option()
@common.force_option
@common.json_option
@common.profile_option
def calibrate(
    recording: Path, morphology: Path | None, spec: Path | None, out: Path | None, as_json: bool, **options: Any
) -> int:
    """Train a localizer on RECORDING. It is tested on held-out presses.

    \b
    padforge sense calibrate out/pad/recording --test-split chronological
    padforge sense calibrate out/pad/recording --time-budget 600
    padforge sense calibrate out/pad/recording --time-budget 20 --without health --without moments

    Writes localizer.json and .safetensors, a folder health, calibration.json, and figures of the errors. Exit 1 if the
    recording is doubtful: units that cannot be right, or presses that cannot lie where it says.

    With few presses, --morphology adds the responses that the plan predicts. The fibres must be on the channels in the
    order of the plan, and positions must count from the middle of the pad.

    A time budget is that of the training. On top come radii and errors, which may take as long as a training, and what
    --without leaves out: health most of all. A budget in which nothing can be learnt is refused, and a line says when
    the localizer is not converged.
    """
    from padforge.common.files import locked_folder
    from padforge.design.morphology import Morphology
    from padforge.sense.localizer.evaluation import calibration_lines, moment_lines
    from padforge.sense.report.calibration import calibrate_into
    from padforge.sense.settings import LocalizerSettings

    folder = out or common.pad_folder(recording)
    run = {name: options.pop(name) for name in ("time_budget", "without", "force")}
    with locked_folder(folder):
        settings, presses = common.load_spec(spec).section(LocalizerSettings, **options), read_recording(recording)
        with common.progress_bar("training") as show:
            pad = None if morphology is None else Morphology.load(morphology)
            document = calibrate_into(presses, folder, settings, pad=pad, on_progress=show, **run)
    lines = [pressed_line(presses), *calibration_lines(document), *moment_lines(document["by_moment"])]
    common.show_result(document, lines, as_json)
    return int(bool(document["doubts"]))


@click.command()
@model_option
@recording_argument
@max_failures_option
@common.json_option
@common.profile_option
def evaluate(model: Path, recording: Path, max_failures: int, as_json: bool) -> int:
    """Evaluate a model on RECORDING, by set of failed fibres.

    \b
    padforge sense evaluate --model out/pad out/later/recording --max-failures 1

    On the recording that the model was trained on, only the held-out presses count. Exit 1 if something is doubtful.
    """
    from padforge.sense.localizer import evaluation
    from padforge.sense.localizer.model import LocalizerModel

    localizer = LocalizerModel.load(model)
    levels = range(min(max_failures, localizer.fibres - 1) + 1)
    opened = read_recording(recording)
    with common.progress_bar("evaluating") as show:
        document = evaluation.evaluate(localizer, opened, levels, on_progress=show).to_dict()
    lines = [*evaluation.calibration_lines(document), *evaluation.moment_lines(document["by_moment"])]
    common.show_result(document, lines, as_json)
    return int(bool(document["doubts"]))


def _parse_moment(context: click.Context, param: click.Parameter, value: str | None) -> tuple[str, float] | None:
    if value is None:
        return None
    match = re.fullmatch(r"(?:(end)|(lift\+)?(\d{1,4}(?:\.\d{1,6})?)s)", value)
    if match is None:
        raise click.BadParameter(f"got {value!r}, expected as 0.3s, end or lift+0.25s")
    return ("lift", 0.0) if match[1] else ("lift" if match[2] else "touch", float(match[3]))


@click.command()
@model_option
@recording_argument
@fibres_option("--exclude-fibres", "Fibres to mask, numbered from 1.")
@click.option(
    "--at",
    "moment",
    metavar="MOMENT",
    callback=_parse_moment,
    help="Use readings until then: 0.3s after the touch, end of the press, or lift+0.25s (default: all readings).",
)
@common.out_option(what="CSV file of positions, places.csv", file=True)
@common.profile_option
def locate(
    model: Path, recording: Path, exclude_fibres: tuple[int, ...], moment: tuple[str, float] | None, out: Path | None
) -> int:
    """Predict where RECORDING was pressed, with uncertainties. True positions are not needed.

    \b
    padforge sense locate --model out/pad out/later/recording --exclude-fibres 1,4 --out places.csv
    padforge sense locate --model out/pad out/later/recording --at 0.3s

    \b
    The columns of the CSV: press (counted from 0), x_mm, y_mm, std_x_mm, std_y_mm (standard
    deviations), r50_mm, r90_mm (radii that hold the true position in 50 % and 90 % of cases),
    unlike (1 where no single press explains the responses, as of two fingers: it may be anywhere);
    of a model that estimates them also depth_mm, depth_r90_mm, force_n, force_r90_n.

    Lines on stderr name fibres that are faulty, and those that differ from the calibration, so that radii may fail.
    Exit 1 if the presses are of another pad: then no fibre is masked.
    """
    from padforge.sense.localizer.model import write_localization
    from padforge.sense.localizer.single_press import OTHER_PAD

    file = out or common.pad_folder(recording) / "places.csv"
    opened = read_recording(recording)
    localization, faults, shifts, _, is_other_pad = predict_despite_faults(model, opened, exclude_fibres, moment)
    if is_other_pad:
        common.echo(OTHER_PAD, err=True)
    for fault in faults:
        masked = f"; masked from press {fault.since} on" if fault.is_masked else ""
        common.echo(f"{fault.text}{masked}", err=True)
    for shift in shifts:
        common.echo(shift.text, err=True)
    write_localization(localization, file)
    common.echo(f"{len(localization.r50_mm)} positions -> {file}")
    return int(is_other_pad)


@click.command()
@model_option
@recording_argument
@common.json_option
def health(model: Path, recording: Path, as_json: bool) -> int:
    """Detect failed, damaged and drifting fibres of RECORDING. The readings alone are needed.

    \b
    padforge sense health --model out/pad out/later/recording

    Exit 1 if there are any, or if the presses are of another pad: then no fibre is said to be at fault. Fibres are
    numbered from 1; in JSON "dead" and "fibres" hold indices, from 0, and "shifts" how fibres differ from the
    calibration.
    """
    from dataclasses import asdict

    from padforge.sense.health.fault_detector import FaultDetector, fault_lines
    from padforge.sense.localizer.single_press import OTHER_PAD

    opened, dead = read_recording(recording), FaultDetector.load(model).model_.dead
    _, findings, shifts, _, is_other_pad = predict_despite_faults(model, opened)
    document = {
        "format": "padforge-findings/1",
        "presses": len(opened.down_command),
        "other_pad": is_other_pad,
        "dead": list(dead),
        "findings": [asdict(finding) | {"text": finding.text} for finding in findings],
        "shifts": [asdict(shift) | {"text": shift.text} for shift in shifts],
    }
    lines = [*fault_lines(findings, opened.fibres, dead), *(shift.text for shift in shifts)]
    common.show_result(document, [OTHER_PAD] if is_other_pad else lines, as_json)
    return int(bool(findings) or is_other_pad)


@click.command()
@model_option
@click.argument("files", nargs=-1, required=True, metavar="[RECORDING] OUT", type=click.Path(path_type=Path))
@common.profile_option
def deploy(model: Path, files: tuple[Path, ...]) -> None:
    """Write the localizer for other programs, as OUT, an .onnx.

    \b
    padforge sense deploy --model out/pad localizer.onnx

    It takes all readings so far, the rows at which presses start and end, and a mask of the fibres, and returns
    positions, standard deviations and radii. It is compared with the localizer in ONNX Runtime, on the presses of
    RECORDING or on synthetic ones, and not written if they differ.
    """
    from padforge.common.files import check_writable, sha256
    from padforge.sense.deploy.onnx_export import export_onnx
    from padforge.sense.localizer.model import LocalizerModel

    path, recording = files[-1], files[0] if len(files) == 2 else None
    if len(files) > 2:
        raise InputError(f"{files[1]}: one argument too many, expected [RECORDING] OUT")
    if path.suffix != ".onnx":
        raise InputError(f"{path}: cannot be written, expected a name that ends in .onnx")
    check_writable(path.parent)
    localizer, digest = LocalizerModel.load(model), sha256(model / "localizer.json")
    opened = None if recording is None else read_recording(recording)
    common.echo(f"{export_onnx(localizer, digest, path, opened).text} -> {path}")


@click.command()
@model_option
@recording_argument
@click.option(
    "--morphology", type=FILE, help="The pad as planned: morphology.json or published .mat (default: the recording's)."
)
@common.seed_option
@common.out_option()
@common.force_option
@common.json_option
def recalibrate(
    model: Path,
    recording: Path,
    morphology: Path | None,
    seed: int | None,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Adapt a model to a changed pad. RECORDING holds 20 to 500 presses at known positions.

    The pad may have drifted, have been cast again or have a new fibre.

    \b
    padforge sense recalibrate --model out/pad out/later/recording

    Writes a model and recalibration.json. Changes are kept only if they reduce the error in cross-validation. What the
    plan says of a new fibre takes the place of many presses: with --morphology, the fibres are on the channels in its
    order, and positions are from the middle of the pad. The old model is replaced only if --out names its folder.
    """
    from padforge.common.files import atomic_files, check_replaceable, locked_folder, write_json
    from padforge.design.morphology import Morphology
    from padforge.sense.health.fault_detector import HEALTH_FILES, FaultDetector, has_health
    from padforge.sense.localizer import recalibration
    from padforge.sense.localizer.model import LocalizerModel

    target = out or common.pad_folder(recording)
    if out is None and target.resolve() == model.resolve():
        raise InputError(f"{target}: holds the old model; name a folder for the new one with --out")
    with locked_folder(target):
        old, opened = LocalizerModel.load(model), read_recording(recording)
        replaced, remade = target / "localizer.json", ["recalibration.json", *HEALTH_FILES]
        origin = {"seed": seed or 0, "inputs": {"recording": opened.digest, "localizer": dict(old.provenance)}}
        check_replaceable(replaced, origin, remade, force)
        detector = FaultDetector.load(model) if has_health(model) else None
        with common.progress_bar("recalibrating") as report:
            pad = None if morphology is None else Morphology.load(morphology)
            localizer, result = recalibration.recalibrate(old, opened, pad=pad, seed=seed or 0, on_progress=report)
        with atomic_files(target, without=HEALTH_FILES) as folder:
            localizer.save(folder)
            check_replaceable(replaced, folder / replaced.name, remade, force)  # other models show in the result alone
            write_json(folder / "recalibration.json", result.to_dict())
            if detector:  # faults do not depend on positions
                detector.include_rests(opened)
                detector.save(folder)
    common.show_result(result.to_dict(), recalibration.recalibration_lines(result), as_json)


@click.command("fibre-loss")
@recording_argument
@click.option("--model", type=FOLDER, help="Folder that calibrate wrote: one network for all failures.")
@click.option("--retrain", is_flag=True, help="As in the paper: a network for every set of failed fibres.")
@max_failures_option
@fibres_option("--failed", "Also map errors without these fibres, numbered from 1, such as 2,5.")
@common.seed_option
@common.spec_option
@common.out_option()
@common.json_option
def fibre_loss(
    recording: Path, model: Path | None, failed: tuple[int, ...], out: Path | None, as_json: bool, **options: Any
) -> None:
    """Errors on RECORDING with failed fibres, and their maps. One localizer for all failures is compared with
    networks retrained for every set.

    \b
    padforge sense fibre-loss out/pad/recording --model out/pad

    \b
    Figure 14, S6, S7 and S8 of the paper, whose S1 and S2 broke:
    padforge sense fibre-loss para5_long.mat --retrain --failed 4,5,6

    Writes fibre_loss.json and fibre_loss.png (figures 13 and 14 of the paper), with maps of the errors without the
    worst set of each size, and without the fibres of --failed.
    """
    from padforge.common.files import check_writable
    from padforge.sense.localizer.model import LocalizerModel
    from padforge.sense.settings import LocalizerSettings
    from padforge.sense.studies.fibre_loss import draw_fibre_loss, fibre_loss_lines, fibre_loss_study

    if not (model or options["retrain"]):
        raise InputError("neither --model nor --retrain is given, expected one of them or both")
    target = out or common.pad_folder(recording)
    check_writable(target)
    localizer = LocalizerModel.load(model) if model else None
    settings = common.load_spec(options.pop("spec")).section(LocalizerSettings, seed=options.pop("seed"))
    opened = read_recording(recording)
    options |= {"failed": fibre_indices(failed, opened.fibres)}
    with common.progress_bar("networks") as show:
        result = fibre_loss_study(opened, localizer, options=settings, on_progress=show, **options)
    _write_study(target / "fibre_loss", result.to_dict(), partial(draw_fibre_loss, result))
    common.show_result(result.to_dict(), fibre_loss_lines(result), as_json)


def _write_study(path: Path, document: dict[str, Any], draw: Callable[[Path], None]) -> None:
    """Write a document and its figure, as `path` with .json and .png."""
    from padforge.common.files import atomic_files, write_json

    with atomic_files(path.parent) as folder:
        write_json(folder / f"{path.name}.json", document)
        draw(folder / f"{path.name}.png")


@click.command("learning-curve")
@recording_argument
@common.seed_option
@common.spec_option
@common.out_option()
@common.json_option
def learning_curve(recording: Path, seed: int | None, spec: Path | None, out: Path | None, as_json: bool) -> None:
    """Errors by number of training presses, and with more.

    \b
    padforge sense learning-curve out/pad/recording

    Writes learning_curve.json and learning_curve.png.
    """
    from padforge.common.files import check_writable
    from padforge.sense.settings import LocalizerSettings
    from padforge.sense.studies import learning_curve as study

    target = out or common.pad_folder(recording)
    check_writable(target)
    options, opened = common.load_spec(spec).section(LocalizerSettings, seed=seed), read_recording(recording)
    with common.progress_bar("training") as show:
        result = study.learning_curve(opened, options, on_progress=show)
    _write_study(target / "learning_curve", result.to_dict(), partial(study.draw_learning_curve, result))
    common.show_result(result.to_dict(), study.learning_curve_lines(result), as_json)


@click.command()
@recording_argument
@click.option("--morphology", type=FILE, required=True, help="The pad as planned: morphology.json or published .mat.")
@common.seed_option
@common.spec_option
@common.out_option()
@common.force_option
@common.json_option
@common.profile_option
def identify(
    recording: Path, morphology: Path, seed: int | None, spec: Path | None, out: Path | None, force: bool, as_json: bool
) -> int:
    """Identify the twin of a printed pad from RECORDING. The twin has its fibres as built, wiring, pose and
    sensitivity profile.

    If [contact] is a layer, its width, squeeze and stretch are measured. A twin that is doubtful is written
    nevertheless, and what is doubtful is printed, with exit code 1: a channel that does not fit this pad, or a second
    wiring that fits nearly as well.

    \b
    padforge sense identify out/pad/recording --morphology out/pad/morphology.json

    Writes twin.json, for padforge design --twin and padforge sense record --rig simulated --twin; identification.json,
    twin_plan.png and twin_responses.png.
    """
    from padforge.common.files import locked_folder
    from padforge.design.morphology import Morphology
    from padforge.design.settings import read_contact
    from padforge.sense.report.identification import identification_lines, identify_into

    contact = read_contact(common.load_spec(spec))
    folder, pad = out or common.pad_folder(recording), Morphology.load(morphology)
    inputs = [path for path in (recording, morphology) if not path.is_dir()]
    with locked_folder(folder), common.progress_bar("identify") as show:
        opened = read_recording(recording)
        options = {"contact": contact, "inputs": inputs, "on_progress": show, "force": force}
        document = identify_into(opened, pad, folder, seed or 0, **options)
    common.show_result(document, identification_lines(document, folder), as_json)
    return int(bool(document["doubts"]))
