"""`padforge sense recalibrate`, `robustness` and `size-curve`: following a pad; what fibres and presses are worth."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from design.common.command_line import json_option, load_spec, progress, seed_option, show_result, spec_option
from design.common.errors import InputError

_FOLDER = click.Path(path_type=Path, file_okay=False)
_out = click.option("--out", type=_FOLDER, required=True, help="Folder for the results.")
_recording = click.argument("recording", type=click.Path(path_type=Path))


@click.command()
@click.option("--model", type=_FOLDER, required=True, help="Folder that calibrate wrote.")
@_recording
@seed_option
@_out
@json_option
def recalibrate(model: Path, recording: Path, seed: int | None, out: Path, as_json: bool) -> None:
    """Follow a pad that has drifted or was re-made, by the presses of known place in RECORDING: 20 to 500 will do.

    \b
    padforge sense recalibrate --model out/pad out/later/recording --out out/later

    Writes a whole model and recalibration.json. Whether it got better is told by presses that were left out in turn;
    if it did not, places are found as before.
    """
    from design.common.files import refuse_unwritable, staged, write_json
    from sense.localizer.calibration.recalibration import recalibrate as follow
    from sense.localizer.calibration.recalibration import recalibration_lines
    from sense.localizer.localizer import Localizer
    from sense.recordings.import_export import open_recording

    refuse_unwritable(out)
    old, opened = Localizer.load(model), open_recording(recording)
    with _reported("recalibrating") as report:
        localizer, document = follow(old, opened, seed=seed or 0, progress=report)
    with staged(out) as folder:
        localizer.save(folder)
        write_json(folder / "recalibration.json", document)
        _copy_health(model, folder)
    show_result(document, recalibration_lines(document), as_json)


def _copy_health(model: Path, folder: Path) -> None:
    """What the old model tells health by goes with the new one: it was learnt without places."""
    from sense.health.health_model import FELT, RECORDED, files_of

    for name in (RECORDED, FELT):
        for file in files_of(model, name):
            if file.exists():
                shutil.copyfile(file, folder / file.name)


@click.command()
@_recording
@click.option("--model", type=_FOLDER, help="Folder that calibrate wrote: one network for every loss.")
@click.option("--retrain", is_flag=True, help="As published: another network for every set of lost fibres.")
@click.option("--lost", type=click.IntRange(0, 8), default=3, show_default=True, help="Fibres lost at once, at most.")
@seed_option
@spec_option
@_out
@json_option
def robustness(
    recording: Path,
    model: Path | None,
    retrain: bool,
    lost: int,
    seed: int | None,
    spec: Path | None,
    out: Path,
    as_json: bool,
) -> None:
    """Errors on RECORDING for every set of lost fibres, of one network or of networks retrained for each, or both.

    \b
    padforge sense robustness out/pad/recording --model out/pad --out out/pad

    Writes robustness.json and robustness.png (figures 13 and 14 of the paper). Retrained networks that are done are
    kept when it is broken off, and the same command goes on from them.
    """
    from design.common.files import refuse_unwritable, staged, write_json
    from sense.localizer.calibration.fibre_loss_study import fibre_loss_lines
    from sense.localizer.calibration.fibre_loss_study import fibre_loss_study as study
    from sense.localizer.localizer import Localizer
    from sense.recordings.import_export import open_recording
    from sense.report.robustness_figures import draw_robustness
    from sense.settings import LocalizerSettings as Options

    if not (model or retrain):
        raise InputError("neither --model nor --retrain is given, expected one of them or both")
    refuse_unwritable(out)
    localizer = Localizer.load(model) if model else None
    options, opened = load_spec(spec).section(Options, seed=seed), open_recording(recording)
    with _reported("networks") as report:
        document = study(
            opened,
            localizer,
            retrain=retrain,
            options=options,
            lost=lost,
            keep_in=out / "unfinished",
            progress=report,
        )
    with staged(out) as folder:
        write_json(folder / "robustness.json", document)
        draw_robustness(document, folder / "robustness.png")
    show_result(document, fibre_loss_lines(document), as_json)


@click.command("size-curve")
@_recording
@seed_option
@spec_option
@_out
@json_option
def size_curve(recording: Path, seed: int | None, spec: Path | None, out: Path, as_json: bool) -> None:
    """Errors by number of presses learnt from, and what recording more of them would bring.

    \b
    padforge sense size-curve out/pad/recording --out out/pad

    Writes size_curve.json and size_curve.png.
    """
    from design.common.files import refuse_unwritable, staged, write_json
    from sense.localizer.calibration.learning_curve import learning_curve as study
    from sense.localizer.calibration.learning_curve import learning_curve_lines
    from sense.recordings.import_export import open_recording
    from sense.report.robustness_figures import draw_size_curve
    from sense.settings import LocalizerSettings as Options

    refuse_unwritable(out)
    options, opened = load_spec(spec).section(Options, seed=seed), open_recording(recording)
    with _reported("training") as report:
        document = study(opened, options, progress=report)
    with staged(out) as folder:
        write_json(folder / "size_curve.json", document)
        draw_size_curve(document, folder / "size_curve.png")
    show_result(document, learning_curve_lines(document), as_json)


@contextmanager
def _reported(name: str) -> Iterator[Callable[[int, int], None]]:
    """Yield what shows on stderr how far the work is."""
    with progress() as bar:
        task = bar.add_task(name, total=None, note="")
        yield lambda done, total: bar.update(task, completed=done, total=total, note=f"{done} of {total}")
