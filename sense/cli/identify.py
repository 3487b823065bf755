"""`padforge sense identify`: the edge where a recording becomes a twin."""

from pathlib import Path

import click

from padforge.design.common import command_line as common

from padforge.sense.cli.options import FILE, read_recording, recording_argument


@click.command()
@recording_argument
@click.option("--morphology", type=FILE, required=True, help="The pad as planned: morphology.json or published .mat.")
@common.seed_option
@common.out_option()
@common.force_option
@common.json_option
@common.profile_option
def identify(recording: Path, morphology: Path, seed: int | None, out: Path | None, force: bool, as_json: bool) -> None:
    """Find from RECORDING how a printed pad was laid and wired, and what a press really does to it.

    \b
    padforge sense identify out/pad/recording --morphology out/pad/morphology.json

    Writes twin.json, for padforge design --twin and padforge sense record --rig simulated --twin; identification.json,
    twin_plan.png and twin_responses.png.
    """
    from padforge.design.common.files import locked_folder
    from padforge.design.morphology import Morphology
    from padforge.sense.report.identification_results import identification_lines, identify_into

    folder = out or common.pad_folder(recording)
    pad = Morphology.load(morphology)
    with locked_folder(folder), common.progress() as bar:
        task = bar.add_task("identify", total=None, note="")

        def report(what: str, done: int, of: int) -> None:
            bar.update(task, completed=done, total=of, note=what)

        inputs = [path for path in (recording, morphology) if not path.is_dir()]
        document = identify_into(
            read_recording(recording), pad, folder, seed or 0, inputs=inputs, report=report, force=force
        )
    common.show_result(document, identification_lines(document, folder), as_json)
