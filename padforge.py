"""padforge: the front door. One command; `run` chains design, fabricate and sense, `report` shows what they made."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from design.cli import design
from design.common.command_line import (
    INTERRUPTED,
    json_option,
    load_spec,
    out_option,
    profile_option,
    progress,
    run_to_end,
    seed_option,
    show_result,
    spec_option,
)
from design.common.errors import InputError
from fabricate.cli import fabricate
from sense.cli.main import sense
from sense.studies.cli import study

if TYPE_CHECKING:
    from design.common.settings import Settings, Spec


SECTIONS = {
    "pad": "design.settings:PadSettings",
    "contact": "design.settings:Contact",
    "search": "design.settings:SearchSettings",
    "rules": "design.settings:RulesSettings",
    "mould": "fabricate.settings:MouldSettings",
    "printer": "fabricate.settings:PrinterSettings",
    "rig": "sense.settings:RigSettings",
    "localizer": "sense.settings:LocalizerSettings",
}
"""The sections of a `pad.toml`, and where the settings of each are."""


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


cli.add_command(design)
cli.add_command(fabricate)
cli.add_command(sense)
cli.add_command(study)


@cli.command()
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path), default="pad.toml")
def init(path: Path) -> None:
    """Write a settings file, pad.toml, with every default and a comment a key.

    \b
    padforge init
    padforge init soft.toml
    """
    from design.common.files import write_text
    from design.common.settings import commented_toml

    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or move it away")
    write_text(path, commented_toml(_sections()))
    click.echo(f"settings -> {path}")


@cli.command()
@spec_option
@seed_option
@out_option("out/pad")
@profile_option
@click.pass_context
def run(context: click.Context, spec: Path | None, seed: int | None, out: Path) -> None:
    """Do the whole job: optimise, mould, record presses on the simulated rig, calibrate, report.

    \b
    padforge run
    padforge run --spec pad.toml --seed 1 --out out/soft

    Exit 1 if the pad breaks a design rule or its mould fails a check; everything is written all the same.
    """
    from design.common.files import claimed
    from design.common.profiling import stage

    settings = load_spec(spec)
    _check_ahead(settings, out)
    with claimed(out):
        code = _run_stages(settings, seed, out)
        if code != INTERRUPTED:
            with stage("report"):
                click.echo(f"report: {write_report(out)}")
    context.exit(code)


@cli.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path), default="out/pad")
def report(folder: Path) -> None:
    """Write report.html for the pad in FOLDER: whatever its stages have left there, on one page.

    \b
    padforge report out/pad
    """
    click.echo(f"report: {write_report(folder)}")


BENCHES = {
    "contact": "design.pad.benchmark:BENCH",
    "objective": "design.criteria.benchmark:BENCH",
    "search": "design.optimisers.benchmark:BENCH",
    "networks": "design.evaluation.benchmark:BENCH",
    "filter": "sense.processing.benchmark:BENCH",
    "localizer": "sense.localizer.calibration.benchmark:BENCH",
    "mould": "fabricate.mould.benchmark:BENCH",
}
"""Where each bench is, imported when it is asked for."""


@cli.command()
@click.argument("names", nargs=-1, metavar="[NAME]...", type=click.Choice(list(BENCHES)))
@click.option(
    "--against",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE",
    help="bench.json or NAME.json of an earlier run: say what has become worse since, exit 1 if anything has.",
)
@out_option("out/bench")
@json_option
@click.pass_context
def bench(context: click.Context, names: tuple[str, ...], against: Path | None, out: Path, as_json: bool) -> None:
    """Measure run time against error, beside plain ways of doing the same.

    \b
    padforge bench                                   all of them, some minutes
    padforge bench contact filter                    of contact, objective, search, networks, filter, localizer, mould
    padforge bench --against before/bench.json       what has become slower or less accurate, by ratio

    Writes NAME.json, NAME.csv and NAME.png for each, and bench.json and bench.csv with the summary.
    """
    from dataclasses import asdict
    from pkgutil import resolve_name

    from design.benchmarking.comparison import compared, comparison_lines, read_earlier
    from design.benchmarking.suite import run_benches
    from design.benchmarking.table import bench_lines, summary_lines

    before = read_earlier(against) if against else {}
    chosen = names or [name for name in BENCHES if not before or name in before]
    if not chosen:
        raise InputError(f"{against}: holds none of the benches {', '.join(BENCHES)}")
    with progress() as bar:
        task = bar.add_task("bench", total=None, note="")
        benches = [resolve_name(BENCHES[name]) for name in dict.fromkeys(chosen)]
        summary, changes = run_benches(benches, out, lambda step: bar.update(task, note=step), before)
    tables = [line for document in summary["benches"].values() for line in [*bench_lines(document), ""]]
    verdict = ["", *comparison_lines(changes, compared(before, summary["benches"]))] if against else []
    document = summary | {"worse": [asdict(change) for change in changes]}
    show_result(document, [*tables, *summary_lines(summary["summary"]), *verdict], as_json)
    context.exit(int(bool(changes)))


def _sections() -> "dict[str, type[Settings]]":
    from pkgutil import resolve_name

    return {name: resolve_name(where) for name, where in SECTIONS.items()}


def _check_ahead(spec: "Spec", out: Path) -> None:
    """Refuse what would fail only after minutes of work: any section, sections that do not fit, a real recording."""
    import numpy as np

    from design.settings import PadSettings
    from fabricate import FabricationSettings
    from sense.localizer.calibration.calibration import split_presses
    from sense.settings import LocalizerSettings, RigSettings

    for model in _sections().values():
        spec.section(model)
    FabricationSettings.from_spec(spec).require_consistent(spec.section(PadSettings).pitch_mm)
    learning = spec.section(LocalizerSettings)
    split_presses(spec.section(RigSettings).presses, learning.split, learning.test_share, np.random.default_rng(0))
    _require_replaceable(out / "recording")


def _run_stages(spec: "Spec", seed: int | None, out: Path) -> int:
    """All stages into `out`, each with its summary on stdout; the exit code: 0, 1 if a rule or check fails, or 130."""
    from design.cli import run_search
    from design.cli import search_lines as design_summary
    from fabricate import FabricationSettings, build
    from fabricate.cli import mould_lines as mould_summary
    from sense.cli.calibration import calibration_lines as calibration_summary
    from sense.cli.calibration import run_calibration
    from sense.cli.rig import run_recording

    seeds = {"seed": seed}
    _, found = run_search(spec, out, seeds)
    click.echo("\n".join(design_summary(found, out)))
    if found.stopped:
        return INTERRUPTED
    written = [out / "morphology.json"]
    mould = build(found.morphology, out, settings=FabricationSettings.from_spec(spec), inputs=written)
    click.echo("\n".join(mould_summary(mould, out)))
    recorded = out / "recording"
    _require_replaceable(recorded)
    if recorded.exists():
        shutil.rmtree(recorded)
    recording = run_recording(spec, found.morphology, recorded, seeds, written)
    click.echo(f"sense: {len(recording.presses_mm)} presses on the simulated rig -> {recorded}")
    calibration = run_calibration(spec, recording, out, seeds)
    click.echo("\n".join(f"  {line}" for line in calibration_summary(calibration)))
    return int(bool(found.violations) or any(finding["status"] == "fail" for finding in mould["findings"]))


def _require_replaceable(recorded: Path) -> None:
    """Refuse to run over a recording, unless it is a simulated one, which the same seed gives again."""
    from design.common.files import read_json
    from sense.recordings.recorder import FILES, FORMAT, START

    if not recorded.exists() or (recorded.is_dir() and not any(recorded.iterdir())):
        return
    source = read_json(recorded / START, FORMAT).get("source")
    kind = source.get("kind") if isinstance(source, dict) else None
    if kind != "simulated":
        raise InputError(f"{recorded}: holds a recording of kind {kind!r}, not a simulated one; choose another --out")
    strange = sorted(path.name for path in recorded.iterdir() if path.name not in FILES)
    if strange:
        raise InputError(f"{recorded}: holds {strange[0]}, which is no part of a recording; choose another --out")


def write_report(folder: Path) -> Path:
    """Write `report.html` from the files in `folder`; stages that have left none are left out.

    Raises:
        InputError: no stage has left anything, or a file is damaged.
    """
    from design.common.files import read_json, write_text
    from design.common.page.elements import PageSection, page
    from design.report.sections import design_sections, origin, provenance_section
    from fabricate.report.sections import fabrication_sections
    from sense.report import sections as sensed

    stages = (
        ("design", folder / "design.json", design_sections),
        ("fabrication", folder / "fabrication.json", fabrication_sections),
        ("recording", folder / "recording" / "start.json", sensed.recording_sections),
        ("calibration", folder / "calibration.json", sensed.calibration_sections),
        ("robustness", folder / "robustness.json", sensed.robustness_sections),
    )
    sections: list[PageSection] = []
    origins: list[list[object]] = []
    for name, path, made_of in stages:
        if path.exists():
            document = read_json(path, f"padforge-{name}/1")
            with _as_written(path):
                sections += made_of(folder, document)
                origins.append(origin(folder, name, document))
    studies: list[str] = []
    for path, document in sensed.find_studies(folder):
        with _as_written(path):
            studies += sensed.study_pieces(path, document)
            origins.append(origin(folder, f"study {path.stem}", document))
    if not origins:
        raise InputError(f"{folder}: no design.json, fabrication.json, calibration.json or study to report on")
    if studies:
        sections.append(PageSection("Studies", studies))
    lead = "Fibres, mould and calibration of one soft strain-sensor pad."
    title = f"Pad report: {folder.resolve().name}"
    write_text(folder / "report.html", page(title, lead, [*sections, provenance_section(origins)]))
    return folder / "report.html"


@contextmanager
def _as_written(path: Path) -> Iterator[None]:
    """Blame a document that is not as padforge writes it on its file."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as padforge writes it ({error!r})") from error


def main() -> None:
    """Run the command line."""
    sys.exit(run_to_end(cli, "padforge"))


if __name__ == "__main__":
    main()
