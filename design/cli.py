"""`padforge design`: optimise, draw, import, check, score and edit pads."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.common import command_line as common

if TYPE_CHECKING:
    from rich.progress import TaskID

    from padforge.common.progress import OnProgress
    from padforge.common.settings import Spec
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.rules import Violation
    from padforge.design.settings import Contact, PadSettings

SEARCH = "padforge.design.settings:SearchSettings"
POLL_S = 0.2  # period of checking for Ctrl-C where the system does not wake a waiting thread, s
morphology_argument = click.argument("morphology", type=click.Path(path_type=Path))
twin_option = click.option(
    "--twin",
    type=click.Path(dir_okay=False, path_type=Path),
    help="twin.json of a printed pad, whose sensitivity profile, noise and sensed area are used.",
)


def time_budget_option(text: str) -> Callable[..., Any]:
    """Make the option `--time-budget` with a help text."""
    return click.option("--time-budget", type=common.FiniteRange(min=0), metavar="S", help=text)


@contextmanager
def search_progress() -> "Iterator[OnProgress]":
    """Show a progress bar for every start of a search on stderr."""
    tasks: dict[str, TaskID] = {}
    with common.progress() as bar:

        def report(done: int, total: int, what: str) -> None:
            start, _, note = what.rpartition(": ")
            if start not in tasks:
                tasks[start] = bar.add_task(start, total=total, note="")
            bar.update(tasks[start], completed=done, note=note)

        yield report


@click.group(invoke_without_command=True)
@common.spec_option
@click.option(
    "--method",
    type=click.Choice(["descent", "genetic"]),
    help="descent (by gradients), or genetic (as published, with the published objective).",
)
@common.setting_option("--knots", SEARCH, int, "Inner knots per fibre.")
@common.setting_option("--starts", SEARCH, int, "Random starts of the gradient search.")
@click.option("--start-from", metavar="random|straight|FILE", help="Initial fibres (default: random).")
@twin_option
@time_budget_option("Stop with the best pad after S seconds.")
@click.option("--resume", is_flag=True, help="Continue an interrupted search into the same folder.")
@common.scheduler_option
@common.seed_option
@common.out_option("out/pad")
@common.force_option
@common.json_option
@common.profile_option
@click.pass_context
def design(
    context: click.Context,
    spec: Path | None,
    start_from: str | None,
    twin: Path | None,
    time_budget: float | None,
    resume: bool,
    scheduler: str | None,
    out: Path,
    force: bool,
    as_json: bool,
    **overrides: Any,
) -> None:
    """Optimise the paths of the fibres; check, draw or edit them.

    \b
    padforge design                                   settings: pad.toml
    padforge design --knots 8 --seed 1 --out out/pad
    padforge design --start-from out/pad/morphology.json
    padforge design --twin out/pad/twin.json          for a printed pad
    padforge design check out/pad/morphology.json     exit code 1: rule broken
    padforge design edit out/pad/morphology.json      edit the paths in a browser
    padforge design import plan.svg                   import them from a drawing

    Writes morphology.json, design.json, and figures of the plan. Exit code 1 if the best pad breaks a rule. Ctrl-C
    stops with the best pad so far (exit code 130); --resume continues from there, also after a kill. A pad from which a
    mould, a recording or other files in the folder were made is replaced with --force only.
    """
    if context.invoked_subcommand is not None:
        return
    from padforge.common.files import locked_folder
    from padforge.common.parallel import cluster
    from padforge.design.design_run import run_design, summary_lines
    from padforge.design.optimize.search import SearchOptions
    from padforge.design.settings import Contact
    from padforge.design.twin import Twin

    with locked_folder(out), cluster(scheduler) as executor, search_progress() as on_progress:
        options = SearchOptions(on_progress, resume=resume, time_budget=time_budget, executor=executor)
        document, result = run_design(common.load_spec(spec), out, overrides, start_from, options, twin, force=force)
    if twin is not None and (omitted := Twin.load(twin).ignored_effects()):
        common.echo(f"{twin}: {omitted}", err=True)
    _echo_large_strain(Contact(**document["provenance"]["settings"]["contact"]))
    common.show_result(document, summary_lines(result, out), as_json)
    context.exit(common.INTERRUPTED if result.stopped == "interrupted" else int(bool(result.violations)))


@design.command()
@morphology_argument
@common.spec_option
@common.out_option(what="Picture to write, .svg or .png", file=True)
def show(morphology: Path, spec: Path | None, out: Path | None) -> None:
    """Draw the plan to scale: fibres, crossings, broken rules, contact.

    \b
    padforge design show out/pad/morphology.json                  into out/pad/plan.svg
    padforge design show out/pad/morphology.json --out plan.png
    """
    from padforge.common.plotting import save_figure
    from padforge.common.validation import InputError
    from padforge.design.report import draw_plan
    from padforge.design.settings import read_contact

    path = out or common.pad_folder(morphology) / "plan.svg"
    if path.suffix.lower() not in (".svg", ".png"):
        raise InputError(f"--out is {path}, allowed are .svg and .png")
    pad, settings, pad_settings, violations = _load_and_check(morphology, spec)
    save_figure(draw_plan(pad, read_contact(settings), violations, pad_settings.keep_out_corners_mm), path)
    common.echo(f"plan -> {path}")


@design.command()
@morphology_argument
@common.spec_option
@common.json_option
@click.pass_context
def check(context: click.Context, morphology: Path, spec: Path | None, as_json: bool) -> None:
    """Check every design rule on the exact curves. Exit code 1 if one is broken.

    \b
    padforge design check out/pad/morphology.json
    """
    violations = _load_and_check(morphology, spec)[-1]
    lines = [str(violation) for violation in violations] or ["all rules hold"]
    common.show_result({"violations": list(map(asdict, violations))}, lines, as_json)
    context.exit(int(bool(violations)))


@design.command()
@morphology_argument
@common.spec_option
@twin_option
def score(morphology: Path, spec: Path | None, twin: Path | None) -> None:
    """Print every term of the objective as JSON.

    published_joint_entropy is the joint entropy of all fibres over 49 presses, which limit it to log2 49 = 5.61 bits;
    straight fibres and all published pads reach this limit.

    \b
    padforge design score out/pad/morphology.json
    padforge design score out/pad/morphology.json --twin out/pad/twin.json
    """
    from padforge.design.objectives.score import score as score_terms
    from padforge.design.settings import RulesSettings, SearchSettings, read_contact

    pad, settings, pad_settings, violations = _load_and_check(morphology, spec, twin)
    contact, search, rules = read_contact(settings), settings.section(SearchSettings), settings.section(RulesSettings)
    terms = score_terms(
        pad, contact, search.max_failures, rules=rules, pad_settings=pad_settings, scatter=search.response_scatter
    )
    _echo_large_strain(contact)
    common.show_result({"terms": terms, "violations": list(map(asdict, violations))}, [], as_json=True)


def _echo_large_strain(contact: "Contact") -> None:
    from padforge.design.contact import describe_large_strain

    if notice := describe_large_strain(contact):
        common.echo(notice, err=True)


def _load_and_check(
    morphology: Path, spec: Path | None, twin: Path | None = None
) -> "tuple[Morphology, Spec, PadSettings, list[Violation]]":
    """Load a morphology and its settings, those for a twin if there is one, and check the design rules."""
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.rules import check_rules
    from padforge.design.settings import PadSettings, RulesSettings

    pad, settings = Morphology.load(morphology), common.load_spec(spec)
    if twin is not None:
        from padforge.design.optimize.search import settings_for_twin

        settings = settings_for_twin(settings, twin, pad)
    pad_settings = settings.section(PadSettings, **pad.layout.settings)
    return pad, settings, pad_settings, check_rules(pad, settings.section(RulesSettings), pad_settings)


@design.command()
@click.argument("pad", required=False, type=click.Path(path_type=Path))
@common.spec_option
@common.out_option(what="Morphology to save to", file=True)
@common.force_option
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8322, show_default=True, help="Port of the page; 0: any."
)
def edit(pad: Path | None, spec: Path | None, out: Path | None, force: bool, port: int) -> None:
    """Edit the paths in a browser on this machine. The page shows broken rules and ambiguity at every step.

    \b
    padforge design edit out/pad/morphology.json     saves to out/pad/morphology-edited.json
    padforge design edit                             straight fibres of pad.toml, saves to out/pad/edited.json
    padforge design edit published.mat --out mine.json

    Drag knots, or select them with Tab and move them with the arrow keys. Saving (Ctrl+S in the page) replaces no
    earlier file except the one that --out names. Ctrl-C here ends the session.
    """
    from padforge.common.files import check_writable
    from padforge.common.server import LocalPage, page_text
    from padforge.common.validation import InputError

    from .editor import EditSession, free_name

    out = out or free_name(common.pad_folder(pad) / ("edited.json" if pad is None else f"{pad.stem}-edited.json"))
    if out.suffix.lower() != ".json":
        raise InputError(f"--out is {out}, allowed is a name that ends in .json")
    check_writable(out.parent)
    text = page_text("padforge.design.editor", "editor.html", "editor.css", "drawing.js", "editor.js")
    session = EditSession(common.load_spec(spec), pad, out, lambda view: page.show(view), force)
    with LocalPage(port, text, {"/edit": session.edit, "/save": session.save}) as page:
        replaces = " in place of its content" * out.exists()
        common.echo(f"page: {page.url} (Ctrl-C ends), saves to {out}{replaces}", err=True)
        try:
            session.begin()
            while True:
                time.sleep(POLL_S)
        finally:
            session.end()
            if session.unsaved:
                common.echo("edits since the last save are discarded", err=True)


@design.command("import")
@click.argument("plan", type=click.Path(dir_okay=False, path_type=Path))
@common.spec_option
@click.option(
    "--tolerance-mm",
    type=common.FiniteRange(1e-3, 10),
    default=0.05,
    show_default=True,
    help="Largest distance of fibres and their ends from the drawing.",
)
@common.out_option(place="out/ and the name of the drawing")
@common.force_option
@common.json_option
@click.pass_context
def import_(
    context: click.Context,
    plan: Path,
    spec: Path | None,
    tolerance_mm: float,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Import the paths from a drawing (.svg or .dxf). Every curve is a fibre; exit code 1 if a rule is broken.

    \b
    padforge design import plan.svg                      into out/plan/morphology.json
    padforge design import plan.dxf --tolerance-mm 0.2 --out out/pad

    [pad] of the settings defines the number of fibres and where they end. Curves are read from layers or groups whose
    names begin with fibre, horizontal or vertical, or else from all open curves; an element named pad is the border.
    """
    from padforge.common.files import atomic_files, check_replaceable, provenance
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.rules import check_rules
    from padforge.design.paths.import_plan import import_plan
    from padforge.design.settings import PadSettings, RulesSettings

    settings = common.load_spec(spec)
    pad_settings, rules = settings.section(PadSettings), settings.section(RulesSettings)
    result = import_plan(plan, pad_settings.layout, tolerance_mm)
    origin = provenance("padforge design import", None, [plan], packages=("ezdxf", "svgelements"))
    origin["settings"] = {"pad": pad_settings.model_dump(mode="json"), "tolerance_mm": tolerance_mm}
    path = (out or common.pad_folder(plan)) / "morphology.json"
    with atomic_files(path.parent) as folder:
        Morphology.from_layout(result.pad.knots, pad_settings.layout, origin).save(folder / path.name)
        check_replaceable(path, folder / path.name, force=force)
    violations, knots = check_rules(result.pad, rules, pad_settings), result.pad.knots.shape[1] - 2
    lines = [f"import: {len(result.fibres)} fibres of {knots} knots -> {path}", f"  {result.placement}"]
    for number, fibre in enumerate(result.fibres, 1):
        moved = f", ends moved by {fibre.end_shift_mm:.3f} mm" if fibre.end_shift_mm >= 5e-4 else ""
        lines.append(f"  fibre {number}: {fibre.name}, within {fibre.max_error_mm:.3f} mm{moved}")
    lines += [f"  broken: {violation}" for violation in violations] or ["  all rules hold"]
    document = {
        "fibres": [{"fibre": number, **asdict(fibre)} for number, fibre in enumerate(result.fibres, 1)],
        "knots": knots,
        "placement": result.placement,
        "violations": list(map(asdict, violations)),
    }
    common.show_result(document, lines, as_json)
    context.exit(int(bool(violations)))
