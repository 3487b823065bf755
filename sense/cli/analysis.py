"""`padforge sense recalibrate`, `fibre-loss`, `learning-curve`: following a pad; what fibres and presses are worth."""

from pathlib import Path

import click

from padforge.design.common import command_line as common
from padforge.design.common.validation import InputError

from padforge.sense.cli.options import FOLDER, FibreNumbers, fibre_indices, lost_option, model_option, recording_argument, reported


@click.command()
@model_option
@recording_argument
@common.seed_option
@common.out_option()
@common.force_option
@common.json_option
def recalibrate(model: Path, recording: Path, seed: int | None, out: Path | None, force: bool, as_json: bool) -> None:
    """Follow a pad that has drifted or was re-made, by the presses of known place in RECORDING: 20 to 500 will do.

    \b
    padforge sense recalibrate --model out/pad out/later/recording

    Writes a whole model and recalibration.json. Whether it got better is told by presses that were left out in turn;
    if it did not, places are found as before. The old model is written over only where --out says so.
    """
    from padforge.design.common.files import atomic_files, check_replaceable, check_writable, write_json
    from padforge.sense.health.model_folder import health_files, health_in
    from padforge.sense.localizer.calibration import recalibration
    from padforge.sense.localizer.localizer import Localizer
    from padforge.sense.recordings.import_export import open_recording

    target = out or common.pad_folder(recording)
    if out is None and target.resolve() == model.resolve():
        raise InputError(f"{target}: holds the old model; name a folder for the new one with --out")
    check_writable(target)
    old, health, opened = Localizer.load(model), health_in(model), open_recording(recording)
    with reported("recalibrating") as report:
        localizer, document = recalibration.recalibrate(old, opened, seed=seed or 0, progress=report)
    with atomic_files(target, without=health_files()) as folder:
        localizer.save(folder)
        replaced = target / "localizer.json"
        check_replaceable(replaced, folder / replaced.name, ["recalibration.json", *health_files()], force)
        write_json(folder / "recalibration.json", document)
        for name, known in health.items():  # it was learnt without places
            known.save(folder, name)
    common.show_result(document, recalibration.recalibration_lines(document), as_json)


@click.command("fibre-loss")
@recording_argument
@click.option("--model", type=FOLDER, help="Folder that calibrate wrote: one network for every loss.")
@click.option("--retrain", is_flag=True, help="As published: another network for every set of lost fibres.")
@lost_option
@click.option("--failed", type=FibreNumbers(), default=(), help="Map errors without these fibres too, from 1: as 2,5.")
@common.seed_option
@common.spec_option
@common.out_option()
@common.json_option
def fibre_loss(
    recording: Path,
    model: Path | None,
    retrain: bool,
    lost: int,
    failed: tuple[int, ...],
    seed: int | None,
    spec: Path | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Errors on RECORDING for every set of lost fibres, of one network or of networks retrained for each, or both.

    \b
    padforge sense fibre-loss out/pad/recording --model out/pad

    Writes fibre_loss.json and fibre_loss.png (figures 13 and 14 of the paper), with maps of the errors without the
    worst set of each size, and without those fibres that --failed names. Retrained networks that are done are
    kept when it is broken off, and the same command goes on from them.
    """
    from padforge.design.common.files import atomic_files, check_writable, write_json
    from padforge.design.common.parallel import Checkpoints
    from padforge.sense.localizer.calibration.fibre_loss_study import fibre_loss_lines, fibre_loss_study
    from padforge.sense.localizer.localizer import Localizer
    from padforge.sense.recordings.import_export import open_recording
    from padforge.sense.report.fibre_loss_figure import draw_fibre_loss
    from padforge.sense.settings import LocalizerSettings

    if not (model or retrain):
        raise InputError("neither --model nor --retrain is given, expected one of them or both")
    target = out or common.pad_folder(recording)
    unfinished = target / "unfinished"
    check_writable(target)
    localizer = Localizer.load(model) if model else None
    options, opened = common.load_spec(spec).section(LocalizerSettings, seed=seed), open_recording(recording)
    with reported("networks") as report:
        document = fibre_loss_study(
            opened,
            localizer,
            retrain=retrain,
            options=options,
            lost=lost,
            failed=fibre_indices(failed, opened.fibres),
            keep_in=unfinished,
            progress=report,
        )
    with atomic_files(target) as folder:
        write_json(folder / "fibre_loss.json", document)
        draw_fibre_loss(document, folder / "fibre_loss.png")
    if retrain:
        Checkpoints(unfinished, {}).clear()
    common.show_result(document, fibre_loss_lines(document), as_json)


@click.command("learning-curve")
@recording_argument
@common.seed_option
@common.spec_option
@common.out_option()
@common.json_option
def learning_curve(recording: Path, seed: int | None, spec: Path | None, out: Path | None, as_json: bool) -> None:
    """Errors by number of presses learnt from, and what recording more of them would bring.

    \b
    padforge sense learning-curve out/pad/recording

    Writes learning_curve.json and learning_curve.png.
    """
    from padforge.design.common.files import atomic_files, check_writable, write_json
    from padforge.sense.localizer.calibration import learning_curve as study
    from padforge.sense.recordings.import_export import open_recording
    from padforge.sense.report.learning_curve_figure import draw_learning_curve
    from padforge.sense.settings import LocalizerSettings

    target = out or common.pad_folder(recording)
    check_writable(target)
    options, opened = common.load_spec(spec).section(LocalizerSettings, seed=seed), open_recording(recording)
    with reported("training") as report:
        document = study.learning_curve(opened, options, progress=report)
    with atomic_files(target) as folder:
        write_json(folder / "learning_curve.json", document)
        draw_learning_curve(document, folder / "learning_curve.png")
    common.show_result(document, study.learning_curve_lines(document), as_json)
