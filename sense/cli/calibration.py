"""`padforge sense calibrate` and `evaluate`: learning places, and how well it went."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.common.command_line import (
    json_option,
    load_spec,
    profile_option,
    progress,
    seed_option,
    show_result,
    spec_option,
)
from design.common.errors import InputError

from .options import FEATURES, FOLDER, METHODS, Numbers, model_option, read_recording, recording_argument

if TYPE_CHECKING:
    from design.common.settings import Spec
    from sense.health.health_model import HealthModel
    from sense.localizer.localizer import Localizer
    from sense.recordings.recording import Recording


@click.command()
@recording_argument
@click.option("--method", type=click.Choice(METHODS), help="masked: one network for every loss; or as published.")
@click.option("--features", type=click.Choice(FEATURES), help="full: press and release; causal: to its end; early.")
@click.option("--test-split", type=click.Choice(["random", "chronological"]), help="Presses held back for the test.")
@seed_option
@spec_option
@click.option("--out", type=FOLDER, help="Folder for the results (default: the one RECORDING lies in).")
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
    from design.common.files import claimed

    overrides = {"method": method, "features": features, "split": test_split, "seed": seed}
    folder = out or recording.absolute().parent
    with claimed(folder):
        document = run_calibration(load_spec(spec), read_recording(recording), folder, overrides)
    show_result(document, calibration_lines(document), as_json)


def run_calibration(spec: "Spec", recording: "Recording", out: Path, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Calibrate with the settings of `spec`, write all results to `out`, and return `calibration.json`.

    Nothing in `out` changes before the last result is there.
    """
    from design.common.files import refuse_unwritable, staged, write_json
    from design.common.profiling import stage
    from sense.health import health_model as watch
    from sense.localizer.calibration.calibration import calibrate as learn
    from sense.report.calibration_figures import draw_error_by_loss, draw_error_map
    from sense.settings import LocalizerSettings

    refuse_unwritable(out)
    options = spec.section(LocalizerSettings, **overrides)
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
    from sense.health.learning import learn_health

    try:
        return learn_health(recording, localizer)
    except InputError as error:
        click.echo(f"no watch is kept on the fibres' health: {error}", err=True)
        return {}


@click.command()
@model_option
@recording_argument
@click.option("--lost", type=Numbers(), help="How many fibres to lose (default: 0 to 3, as far as one is left).")
@json_option
@profile_option
def evaluate(model: Path, recording: Path, lost: tuple[int, ...] | None, as_json: bool) -> None:
    """Errors on RECORDING for every set of lost fibres.

    \b
    padforge sense evaluate --model out/pad out/later/recording --lost 0,1

    Of the recording the model was trained on, only the presses that were held back count.
    """
    from sense.localizer.evaluation import evaluate as test
    from sense.localizer.localizer import Localizer

    localizer = Localizer.load(model)
    levels = range(min(4, localizer.fibres)) if lost is None else lost
    document = test(localizer, read_recording(recording), levels)
    show_result(document, calibration_lines(document), as_json)


def calibration_lines(document: Mapping[str, Any]) -> list[str]:
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
