"""The command line: the commands of all packages, and `run`, `init`, `report` and `bench`."""

import sys
from pathlib import Path
from pkgutil import resolve_name

import click

from padforge.benchmarks.cli import bench
from padforge.design.cli import compare_command
from padforge.design.cli import design as design_group
from padforge.design.common.command_line import (
    INTERRUPTED,
    force_option,
    load_spec,
    out_option,
    profile_option,
    run_to_end,
    seed_option,
    spec_option,
)
from padforge.design.common.validation import InputError
from padforge.fabricate.cli import fabricate as fabricate_group
from padforge.fabricate.cli import formats_option, mould_costs, split_formats
from padforge.sense.cli.main import sense as sense_group
from padforge.sense.studies.cli import study as study_group

from .report import write_report
from .run import SECTIONS, Run, check_ahead, run_stages, sections

PRESETS = {"published": "padforge.design.settings:PUBLISHED"}
"""Settings other than the defaults, by section, that `padforge init` can write."""

EXTRAS = {"design": "design", "fabricate": "cad", "sense": "train", "study": "train"}
"""What of `pyproject.toml` each stage needs to be installed; what chains stages needs all of it."""


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="padforge")
@click.pass_context
def cli(context: click.Context) -> None:
    """From an idea to a calibrated soft strain-sensor pad.

    \b
    padforge run                                     all of it, on built-in defaults, into out/pad
    padforge design --out out/pad                    optimise the fibres
    padforge fabricate out/pad/morphology.json       make the mould
    padforge sense calibrate out/pad/recording       learn places from presses
    padforge study robustness                        the paper's figures, for pads of your own
    """
    context.obj = list(SECTIONS)


for group in (design_group, fabricate_group, sense_group, study_group, bench):
    cli.add_command(group)
design_group.add_command(compare_command(mould_costs))


@cli.command("init")
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path), default="pad.toml")
@click.option("--preset", type=click.Choice(list(PRESETS)), help="published: contact, noise and area of the paper.")
def _init(path: Path, preset: str | None) -> None:
    """Write a settings file, pad.toml, with every default and a comment a key.

    \b
    padforge init
    padforge init soft.toml --preset published
    """
    from padforge.design.common.files import write_text
    from padforge.design.common.settings import commented_toml

    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or move it away")
    write_text(path, commented_toml(sections(), resolve_name(PRESETS[preset]) if preset else None))
    click.echo(f"settings -> {path}")


@cli.command("run")
@spec_option
@formats_option
@click.option("--time-budget", type=click.FloatRange(min=0), metavar="S", help="Take about S seconds for all of it.")
@click.option("--resume", is_flag=True, help="Go on where a run into the same folder was broken off.")
@seed_option
@out_option("out/pad")
@force_option
@profile_option
@click.pass_context
def _run(
    context: click.Context,
    spec: Path | None,
    formats: str,
    time_budget: float | None,
    resume: bool,
    seed: int | None,
    out: Path,
    force: bool,
) -> None:
    """Do the whole job: optimise, mould, record presses on the simulated rig, calibrate, report.

    \b
    padforge run
    padforge run --spec pad.toml --seed 1 --out out/soft
    padforge run --time-budget 600 --formats 3mf,dxf
    padforge run --resume

    Of a time budget the search takes half at most, and the calibration what is left after all else. --resume keeps
    what is finished and was made of the same settings and files; a search goes on from its states. A calibration of
    other than simulated presses, and a pad from which more was made than a run makes, give way with --force only.

    Exit 1 if the pad breaks a design rule or its mould fails a check; everything is written all the same.
    """
    from padforge.design.common.files import locked_folder
    from padforge.design.common.profiling import stage

    run = Run(load_spec(spec), out, seed, split_formats(formats), resume, time_budget, force)
    check_ahead(run)
    with locked_folder(out):
        if (code := run_stages(run)) != INTERRUPTED:
            with stage("report"):
                click.echo(f"report: {write_report(out)}")
    context.exit(code)


@cli.command("report")
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path), default="out/pad")
def _report(folder: Path) -> None:
    """Write report.html for the pad in FOLDER: whatever its stages have left there, on one page.

    \b
    padforge report out/pad
    """
    click.echo(f"report: {write_report(folder)}")


def main() -> None:
    """Run the command line."""
    sys.exit(run_to_end(cli, "padforge", EXTRAS))
