"""The command line: the stages, studies, `design compare`, `run`, `example`, `init`, `schema`, `report` and `bench`."""

import sys
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import click

from padforge.common import command_line as common
from padforge.common.validation import InputError
from padforge.design.cli import design as design_group
from padforge.design.cli import search_progress, time_budget_option
from padforge.fabricate.cli import fabricate as fabricate_group
from padforge.fabricate.cli import formats_option, mould_costs
from padforge.sense.cli.main import sense as sense_group
from padforge.sense.cli.options import recording_line
from padforge.sense.cli.studies import study as study_group

from .report import write_report
from .run import Run, check_run, run_stages
from .settings import SECTIONS, check_settings, section_models

try:
    from padforge.benchmarks.cli import bench
except ModuleNotFoundError as error:
    if not (error.name or "").startswith("padforge.benchmarks"):  # a wheel has no benchmarks
        raise

    @click.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
    def bench() -> None:
        """Compare run time and error with published and plain methods. Runs in a checkout of the repository."""
        raise InputError("bench runs in a checkout of the repository only, whose benchmarks are not installed")


PRESETS = {
    "published": "padforge.design.settings:PUBLISHED",
    "built": "padforge.design.settings:BUILT",
    "ideal": "padforge.sense.settings:IDEAL",
}
"""Settings other than the defaults, by section, that `padforge init` can write."""

EXTRAS = {"design": "design", "fabricate": "cad", "sense": "design", "study": "train", "run": "design,cad"}
"""Optional dependencies, as in `pyproject.toml`, of commands; others need all of these."""


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="padforge")
@click.pass_context
def cli(context: click.Context) -> None:
    """From an idea to a calibrated soft strain-sensor pad.

    \b
    padforge run                                  all stages, into out/pad
    padforge example                              a pad and a recording to try
    padforge design --out out/pad                 optimise the paths of the fibres
    padforge fabricate out/pad/morphology.json    make the mould
    padforge sense calibrate out/pad/recording    train a localizer on presses
    padforge study robustness                     figures of the paper
    """
    context.obj = common.SettingsFile(list(SECTIONS), check_settings)


for command in (design_group, fabricate_group, sense_group, study_group, bench):
    cli.add_command(command)


@design_group.command("compare")
@click.argument("sources", metavar="[SPEC|MORPHOLOGY]...", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--vary", metavar="KEY=V,V", multiple=True, help="Values of a setting, such as pad.grid=3,4.")
@time_budget_option("Seconds for each search.")
@common.seed_option
@common.out_option("out/comparison")
@common.json_option
@common.profile_option
def _compare(
    sources: tuple[Path, ...],
    vary: tuple[str, ...],
    time_budget: float | None,
    seed: int | None,
    out: Path,
    as_json: bool,
) -> None:
    """Compare pads in a table and a figure. Both state the mould, and the error with failed fibres.

    \b
    padforge design compare --vary pad.grid=3,4,5 --vary search.knots=6,21
    padforge design compare small.toml large.toml
    padforge design compare out/pad/morphology.json published.mat

    Every variant of the settings is designed in its own folder, with its mould; morphologies are not changed.
    """
    from padforge.common.files import locked_folder
    from padforge.design.compare import compare, comparison_lines, read_variants
    from padforge.design.contact import describe_large_strain
    from padforge.design.optimize.search import SearchOptions
    from padforge.design.settings import Contact

    variants = read_variants(sources, vary, common.load_spec)
    with locked_folder(out), search_progress() as on_progress:
        document = compare(variants, out, SearchOptions(on_progress, time_budget=time_budget), seed, mould_costs)
    notices = (describe_large_strain(Contact(**row["contact"])) for row in document["rows"])
    for notice in filter(None, dict.fromkeys(notices)):
        common.echo(notice, err=True)
    common.show_result(document, [*comparison_lines(document), f"comparison -> {out / 'comparison.json'}"], as_json)


@cli.command("init")
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path), default="pad.toml")
@click.option(
    "--preset",
    type=click.Choice(list(PRESETS)),
    help="published: contact, noise and area of the paper; built: the press on its pad; ideal: a simulated pad as"
    " planned.",
)
def _init(path: Path, preset: str | None) -> None:
    """Write pad.toml with every setting, its default and a comment.

    \b
    padforge init
    padforge init soft.toml --preset published
    """
    from padforge.common.files import write_text
    from padforge.common.settings import commented_toml

    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or move it away")
    write_text(path, commented_toml(section_models(), resolve_name(PRESETS[preset]) if preset else None))
    common.echo(f"settings -> {path}")


@cli.command("schema")
def _schema() -> None:
    """Print the JSON Schema of pad.toml, for editors.

    \b
    padforge schema > pad.schema.json

    With the line `#:schema ./pad.schema.json` at its top, editors that use Taplo (Even Better TOML in VS Code) complete
    the keys of a pad.toml, show their meaning and default, and mark what is not allowed.
    """
    import json

    from padforge.common.settings import settings_schema

    click.echo(json.dumps(settings_schema(section_models()), indent=1))


@cli.command("run")
@common.spec_option
@formats_option
@time_budget_option("Seconds for all stages together.")
@click.option("--resume", is_flag=True, help="Reuse the finished stages of an earlier run into the same folder.")
@common.seed_option
@common.out_option("out/pad")
@common.force_option
@common.profile_option
@click.pass_context
def _run(context: click.Context, spec: Path | None, formats: tuple[str, ...], out: Path, **options: Any) -> None:
    """Run all stages, from design to report, on the simulated rig.

    \b
    padforge run
    padforge run --spec pad.toml --seed 1 --out out/soft
    padforge run --time-budget 600 --formats 3mf,dxf
    padforge run --resume

    The search uses at most half of a time budget, the calibration what remains after all other stages. --resume reuses
    the stages whose settings and input files are unchanged, and continues an interrupted search. Without --force, a run
    does not replace a localizer that was trained on real presses, or a pad of which you have made other files.

    Exit code 1 if the pad breaks a design rule or its mould fails a check; all files are written nevertheless.
    """
    from padforge.common.files import locked_folder
    from padforge.common.profiling import stage

    run = Run(common.load_spec(spec), out, formats=formats, **options)
    check_run(run)
    with locked_folder(out):
        code = run_stages(run, common.echo, search_progress, partial(common.progress_bar, "training"))
        if code != common.INTERRUPTED:
            with stage("report"):
                common.echo(f"report: {write_report(out)}")
    context.exit(code)


@cli.command("example")
@common.out_option("out/example", "Folder of the example; must be new, empty, or an earlier example")
def _example(out: Path) -> None:
    """Write a pad and a recording, to try commands on.

    \b
    padforge example
    padforge sense calibrate out/example/recording

    The recording is simulated: 1500 presses on a pad like the published one. No setting changes it. The authors' own
    recording is not part of padforge; a line says where it is.
    """
    from padforge.common.files import locked_folder
    from padforge.sense.simulation.example import PUBLISHED_RECORDING, write_example

    with locked_folder(out):
        recording = write_example(out)
    repository, file = PUBLISHED_RECORDING
    common.echo(f"{recording.fibres} fibres -> {out / 'morphology.json'}")
    common.echo(recording_line(recording, out / "recording"))
    common.echo("simulated, with the properties of the published pad, whose recording is the authors':")
    common.echo(f"  {file} of {repository}")
    common.echo(f"  padforge sense calibrate {Path(file).name}")


@cli.command("report")
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path), default="out/pad")
def _report(folder: Path) -> None:
    """Write report.html, a page on all results in a FOLDER.

    \b
    padforge report out/pad
    """
    common.echo(f"report: {write_report(folder)}")


def main() -> None:
    sys.exit(common.run_to_end(cli, "padforge", EXTRAS))
