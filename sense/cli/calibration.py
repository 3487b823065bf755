"""`padforge sense calibrate` and `evaluate`: learning places, and how well it went."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from padforge.design.common import command_line as common

from padforge.sense.cli.options import FEATURES, METHODS, lost_option, model_option, read_recording, recording_argument, reported


@click.command()
@recording_argument
@click.option("--method", type=click.Choice(METHODS), help="masked: one network for every loss; or as published.")
@click.option("--features", type=click.Choice(FEATURES), help="full: press and release; causal: to its end; early.")
@click.option(
    "--test-split", "split", type=click.Choice(["random", "chronological"]), help="Presses held back for the test."
)
@click.option("--time-budget", type=click.FloatRange(min=0), metavar="S", help="Train for S seconds.")
@common.seed_option
@common.spec_option
@common.out_option()
@common.force_option
@common.json_option
@common.profile_option
def calibrate(
    recording: Path,
    time_budget: float | None,
    spec: Path | None,
    out: Path | None,
    force: bool,
    as_json: bool,
    **overrides: Any,
) -> None:
    """Learn places from RECORDING and test on presses held back.

    \b
    padforge sense calibrate out/pad/recording --test-split chronological
    padforge sense calibrate out/pad/recording --time-budget 600

    Writes localizer and health (.safetensors, .json), health_live for touches found live, calibration.json,
    error_map.png and error_by_loss.png.
    """
    from padforge.design.common.files import locked_folder
    from padforge.sense.report.calibration_results import calibrate_into, calibration_lines
    from padforge.sense.settings import LocalizerSettings

    folder = out or common.pad_folder(recording)
    with locked_folder(folder):
        options = common.load_spec(spec).section(LocalizerSettings, **overrides)
        presses = read_recording(recording)
        with reported("training") as report:
            document = calibrate_into(
                presses,
                folder,
                options,
                time_budget=time_budget,
                progress=report,
                warn=partial(click.echo, err=True),
                force=force,
            )
    common.show_result(document, calibration_lines(document), as_json)


@click.command()
@model_option
@recording_argument
@lost_option
@common.json_option
@common.profile_option
def evaluate(model: Path, recording: Path, lost: int, as_json: bool) -> None:
    """Errors on RECORDING for every set of lost fibres.

    \b
    padforge sense evaluate --model out/pad out/later/recording --lost 1

    Of the recording the model was trained on, only the presses that were held back count.
    """
    from padforge.sense.localizer.evaluation import evaluate as test
    from padforge.sense.localizer.localizer import Localizer
    from padforge.sense.report.calibration_results import calibration_lines

    localizer = Localizer.load(model)
    levels = range(min(lost, localizer.fibres - 1) + 1)
    document = test(localizer, read_recording(recording), levels)
    common.show_result(document, calibration_lines(document), as_json)
