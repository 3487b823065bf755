"""padforge: the front door. One command; `run` chains design, fabricate and sense, `report` shows what they made."""

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.cli import INTERRUPTED, design
from design.console import json_option, load_spec, out_option, progress, seed_option, show_result, spec_option
from design.errors import Fault, InputError
from fabricate.cli import fabricate
from sense.cli import sense

if TYPE_CHECKING:
    from design.settings import Section, Spec


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="padforge")
def cli() -> None:
    """From an idea to a calibrated soft strain-sensor pad.

    \b
    padforge run                                     all of it, on built-in defaults, into out/pad
    padforge design --out out/pad                    optimise the fibres
    padforge fabricate out/pad/morphology.json       make the mould
    padforge sense calibrate out/pad/recording       learn places from presses
    """


cli.add_command(design)
cli.add_command(fabricate)
cli.add_command(sense)


@cli.command()
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path), default="pad.toml")
def init(path: Path) -> None:
    """Write a settings file, pad.toml, with every default and a comment a key."""
    from design.files import write_text
    from design.settings import commented_toml

    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or move it away")
    write_text(path, commented_toml(_sections()))
    click.echo(f"settings -> {path}")


@cli.command()
@spec_option
@seed_option
@out_option("out/pad")
@click.pass_context
def run(context: click.Context, spec: Path | None, seed: int | None, out: Path) -> None:
    """Do the whole job: optimise, mould, record presses on the simulated rig, calibrate, report.

    Exit 1 if the pad breaks a design rule or its mould fails a check; everything is written all the same.
    """
    settings = load_spec(spec)
    _check_ahead(settings, out)
    code = _run_stages(settings, seed, out)
    if code != INTERRUPTED:
        click.echo(f"report: {write_report(out)}")
    context.exit(code)


@cli.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path), default="out/pad")
def report(folder: Path) -> None:
    """Write report.html for the pad in FOLDER: whatever its stages have left there, on one page."""
    click.echo(f"report: {write_report(folder)}")


@cli.command()
@click.argument("name", type=click.Choice(["contact", "objective", "search", "filter", "localizer", "mould"]))
@out_option("out/bench")
@json_option
def bench(name: str, out: Path, as_json: bool) -> None:
    """Measure run time against error, beside plain ways of doing the same.

    Writes NAME.json, NAME.csv and NAME.png.
    """
    from design.bench import bench_contact, bench_objective
    from design.bench_search import bench_search
    from design.bench_table import lines
    from fabricate.bench import bench_mould
    from sense.bench_filter import bench_filter
    from sense.bench_localizer import bench_localizer

    benches = {
        "contact": bench_contact,
        "objective": bench_objective,
        "search": bench_search,
        "filter": bench_filter,
        "localizer": bench_localizer,
        "mould": bench_mould,
    }
    with progress() as bar:
        task = bar.add_task(name, total=None, note="")
        document = benches[name](out, lambda step: bar.update(task, note=step))
    show_result(document, lines(document), as_json)


def _sections() -> "dict[str, type[Section]]":
    from design.settings import MODELS as DESIGN
    from fabricate.settings import MODELS as FABRICATE
    from sense.settings import MODELS as SENSE

    return DESIGN | FABRICATE | SENSE


def _check_ahead(spec: "Spec", out: Path) -> None:
    """Refuse what would fail only after minutes of work: any section, sections that do not fit, a real recording."""
    import numpy as np

    from design.settings import Pad
    from fabricate import Settings
    from sense.calibration import split_presses
    from sense.settings import Localizer, Rig

    for model in _sections().values():
        spec.section(model)
    Settings.from_spec(spec).require_consistent(spec.section(Pad).pitch_mm)
    learning = spec.section(Localizer)
    split_presses(spec.section(Rig).presses, learning.split, learning.test_share, np.random.default_rng(0))
    _require_replaceable(out / "recording")


def _run_stages(spec: "Spec", seed: int | None, out: Path) -> int:
    """All stages into `out`, each with its summary on stdout; the exit code: 0, 1 if a rule or check fails, or 130."""
    from design.cli import run_search
    from design.cli import summary as design_summary
    from fabricate import Settings, build
    from fabricate.cli import summary as mould_summary
    from sense.cli import run_calibration
    from sense.cli import summary as calibration_summary
    from sense.rig.cli import run_recording

    seeds = {"seed": seed}
    _, found = run_search(spec, out, seeds)
    click.echo("\n".join(design_summary(found, out)))
    if found.stopped:
        return INTERRUPTED
    written = [out / "morphology.json"]
    mould = build(found.morphology, out, settings=Settings.from_spec(spec), inputs=written)
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
    from design.files import read_json
    from sense.recorder import FORMAT, START

    if not recorded.exists() or (recorded.is_dir() and not any(recorded.iterdir())):
        return
    source = read_json(recorded / START, FORMAT).get("source")
    kind = source.get("kind") if isinstance(source, dict) else None
    if kind != "simulated":
        raise InputError(f"{recorded}: holds a recording of kind {kind!r}, not a simulated one; choose another --out")


def write_report(folder: Path) -> Path:
    """Write `report.html` from the files in `folder`; stages that have left none are left out."""
    from design.files import read_json, write_text
    from design.page import page, tiles

    key_figures: list[tuple[str, str]] = []
    body: list[str] = []
    for name, section in (("design", _design), ("fabrication", _mould), ("calibration", _calibration)):
        path = folder / f"{name}.json"
        if path.exists():
            document = read_json(path, f"padforge-{name}/1")
            try:
                figures, pieces = section(folder, document)
            except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
                raise InputError(f"{path}: not as padforge writes it ({error!r})") from error
            key_figures += figures
            body += pieces
    if not body:
        raise InputError(f"{folder}: no design.json, fabrication.json or calibration.json to report on")
    lead = "Fibres, mould and calibration of one soft strain-sensor pad."
    write_text(folder / "report.html", page(f"Pad report: {folder.name}", lead, [tiles(key_figures), *body]))
    return folder / "report.html"


Pieces = tuple[list[tuple[str, str]], list[str]]


def _design(folder: Path, document: dict[str, Any]) -> Pieces:
    from design.page import figures, heading, paragraph, table

    spread = {int(name[-1]): value for name, value in document["terms"].items() if name.startswith("ambiguity")}
    broken = [[v["rule"], ", ".join(map(str, v["fibres"])), v["measured"], v["limit"]] for v in document["violations"]]
    enforced = document["provenance"]["settings"]["rules"]["enforce"]
    holds = f"{len(broken)} broken" if broken else "all hold" if enforced else "not asked for"
    return [(holds, "design rules"), (f"{spread[0]:.3f}", "ambiguity, grid units")], [
        heading("Fibres"),
        figures(
            [(folder / "design.svg", "The plan: horizontal and vertical fibres, their crossings, and the contact.")]
        ),
        table(["fibres lost", "ambiguity (grid units)"], list(spread.items())),
        paragraph(f"Rules of [rules], checked on the exact curves: {holds}."),
        *([table(["rule", "fibres", "measured", "limit"], broken)] if broken else []),
    ]


def _mould(folder: Path, document: dict[str, Any]) -> Pieces:
    from design.page import figures, heading, table

    worst = max((f["status"] for f in document["findings"]), key=["pass", "warn", "fail"].index)
    size = " x ".join(f"{round(side, 2):g}" for side in document["size_mm"])
    shown = ("number", "fibre", "depth_mm", "in_pad_mm", "cut_mm")
    return [(worst, "mould checks"), (f"{document['silicone_volume_ml']:.1f} ml", "silicone to cast")], [
        heading("Mould"),
        figures(
            [
                (folder / "mould.png", f"The mould, {size} mm, shaded by height."),
                (folder / "tracks.png", "The fibres as they lie in the mould; the deeper one interrupts the other."),
            ]
        ),
        table(["check", "verdict", "finding"], [[f["name"], f["status"], f["message"]] for f in document["findings"]]),
        heading("Fibres to cut"),
        table(
            ["number", "fibre", "depth (mm)", "in the pad (mm)", "cut (mm)"],
            [[fibre[name] for name in shown] for fibre in document["fibres"]],
        ),
    ]


def _calibration(folder: Path, document: dict[str, Any]) -> Pieces:
    from design.page import figures, heading, paragraph, table

    names = ("lost", "subsets", "mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm")
    errors = [[row[name] for name in names] + [f"{row['within_r90']:.1%}"] for row in document["errors"]]
    return [
        (f"{errors[0][2]:.2f} mm", "mean error, all fibres"),
        (f"{errors[-1][2]:.2f} mm", f"{errors[-1][0]} lost"),
    ], [
        heading("Calibration"),
        paragraph(
            f"Errors on {document['test_presses']} presses never trained on ({document['split']} split); "
            "one network serves every loss."
        ),
        figures(
            [
                (folder / "error_map.png", "Where presses were, and how far off they were found."),
                (folder / "error_by_loss.png", "Error by number of lost fibres."),
            ]
        ),
        table(
            ["lost", "subsets", "mean (mm)", "std (mm)", "worst (mm)", "median (mm)", "95 % (mm)", "within r90"], errors
        ),
    ]


def main() -> None:
    """Run the command line; a user's own mistake is one line on stderr and exit 2."""
    try:
        code = cli.main(standalone_mode=False, prog_name="padforge")
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        code = 2
    except (click.exceptions.Abort, KeyboardInterrupt):
        code = _fail("interrupted; what was finished is kept", INTERRUPTED)
    except click.ClickException as error:
        code = _fail(error.format_message(), 2)
    except InputError as error:
        code = _fail(str(error), 2)
    except Fault as fault:
        code = _fail(str(fault), fault.exit_code)
    except OSError as error:
        code = _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), 2)
    sys.exit(code)


def _fail(message: str, code: int) -> int:
    print(f"padforge: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
