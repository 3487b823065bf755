"""`padforge design`: the edge where settings come in and morphologies go out."""

import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common.command_line import (
    INTERRUPTED,
    force_option,
    json_option,
    load_spec,
    out_option,
    pad_folder,
    profile_option,
    scheduler_option,
    seed_option,
    show_result,
    spec_option,
)

if TYPE_CHECKING:
    from padforge.design.compare import Making


@click.command("import")
@click.argument("plan", type=click.Path(dir_okay=False, path_type=Path))
@spec_option
@click.option(
    "--tolerance-mm",
    type=click.FloatRange(1e-3, 10),
    default=0.05,
    show_default=True,
    help="How far fibres and their ends may be off what is drawn.",
)
@out_option()
@force_option
@json_option
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
    """Take fibres from a drawing, .svg or .dxf, one curve each; exit 1 if they break a rule.

    \b
    padforge design import plan.svg                      into out/plan/morphology.json
    padforge design import plan.dxf --tolerance-mm 0.2 --out out/pad

    [pad] of the settings says which fibres there are and where they end. Taken are curves in layers or groups whose
    names begin with fibre, horizontal or vertical, else all open ones; what is named pad is its border.
    """
    from padforge.design.common.files import atomic_files, check_replaceable, provenance
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.rules import check_rules
    from padforge.design.paths.import_plan import import_plan
    from padforge.design.settings import PadSettings, RulesSettings

    settings = load_spec(spec)
    size, rules = settings.section(PadSettings), settings.section(RulesSettings)
    found = import_plan(plan, size.layout, tolerance_mm)
    made_by: dict[str, Any] = provenance(
        "padforge design import", None, [plan], packages=("ezdxf", "lxml", "fonttools")
    )
    made_by["settings"] = {"pad": size.model_dump(mode="json"), "tolerance_mm": tolerance_mm}
    folder = out or pad_folder(plan)
    with atomic_files(folder) as together:
        Morphology.from_layout(found.pad.knots, size.layout, made_by).save(together / "morphology.json")
        check_replaceable(folder / "morphology.json", together / "morphology.json", force=force)
    broken = check_rules(found.pad, rules, size)
    fibres = [{"fibre": number, **asdict(fibre)} for number, fibre in enumerate(found.fibres, 1)]
    knots = found.pad.knots.shape[1] - 2
    lines = [
        f"import: {len(fibres)} fibres of {knots} knots -> {folder / 'morphology.json'}",
        f"  {found.placement}",
        *(
            f"  fibre {each['fibre']}: {each['name']}, within {each['max_error_mm']:.3f} mm"
            + (f", ends moved by {each['end_shift_mm']:.3f} mm" if each["end_shift_mm"] >= 5e-4 else "")
            for each in fibres
        ),
        *([f"  broken  {violation}" for violation in broken] or ["  all rules hold"]),
    ]
    document = {"fibres": fibres, "knots": knots, "placement": found.placement, "violations": list(map(asdict, broken))}
    show_result(document, lines, as_json)
    context.exit(1 if broken else 0)


PORT = 8322
_LOOK_S = 0.2
"""Between two looks for Ctrl-C where the system does not wake a thread that waits."""


@click.command()
@click.argument("pad", required=False, type=click.Path(path_type=Path))
@spec_option
@out_option(what="Morphology to write when it is saved", file=True)
@force_option
@click.option("--port", type=click.IntRange(0, 65_535), default=PORT, show_default=True, help="Of the page; 0: any.")
def edit(pad: Path | None, spec: Path | None, out: Path | None, force: bool, port: int) -> None:
    """Draw fibres in a browser of this machine, and see at once which rules they break and where presses are confused.

    \b
    padforge design edit out/pad/morphology.json     saves beside it, to out/pad/morphology-edited.json
    padforge design edit                             the straight pad of pad.toml, into out/pad/edited.json
    padforge design edit published.mat --out mine.json

    Knots are dragged, or chosen with Tab and moved with the arrow keys. Saving (Ctrl+S in the page) replaces no file
    that was there before but the one that --out names. Ctrl-C here ends it.
    """
    from padforge.design.common.files import check_writable
    from padforge.design.common.server import LocalPage, page_text
    from padforge.design.common.validation import InputError
    from padforge.design.morphology import Morphology
    from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

    from .editor.edits import Answers
    from .editor.session import EditSession

    out = out or _free(pad)
    if out.suffix.lower() != ".json":
        raise InputError(f"--out is {out}, allowed is a name that ends in .json")
    check_writable(out.parent)
    settings = load_spec(spec)
    layout = settings.section(PadSettings).layout if pad is None else Morphology.load(pad).layout
    size = settings.section(PadSettings, **layout.settings)
    judged = Answers(size, settings.section(RulesSettings), settings.section(Contact), settings.section(SearchSettings))
    text = page_text("padforge.design.editor", "editor.html", "editor.css", "drawing.js", "editor.js")
    with ExitStack() as stack:
        session = EditSession(judged, pad, out, lambda view: page.show(view), force)
        page = LocalPage(port, text, {"/edit": session.edit, "/save": session.save})
        stack.enter_context(page)
        click.echo(
            f"page: {page.url} (Ctrl-C ends), saves to {out}{' in place of what it has' * out.exists()}", err=True
        )
        stack.push(lambda *error: _end(session))
        session.begin()
        while True:
            time.sleep(_LOOK_S)


def _end(session: Any) -> None:
    session.end()
    if session.unsaved:
        click.echo("what was drawn since the last save is not kept", err=True)


def _free(pad: Path | None) -> Path:
    """The first name beside a pad that no file has."""
    folder, stem = pad_folder(pad), "edited" if pad is None else f"{pad.stem}-edited"
    from .editor.session import free_name

    return free_name(folder / f"{stem}.json")


morphology_argument = click.argument("morphology", type=click.Path(path_type=Path))
twin_option = click.option(
    "--twin",
    type=click.Path(dir_okay=False, path_type=Path),
    help="twin.json of a printed pad: its reach, noise and sensed area are designed for.",
)


@click.group(invoke_without_command=True)
@spec_option
@click.option("--method", type=click.Choice(["descent", "genetic"]), help="As [search] method.")
@click.option("--knots", type=int, help="Inner knots per fibre.")
@click.option("--starts", type=int, help="Random starts of the gradient search.")
@click.option("--from", "origin", metavar="random|straight|FILE", help="What to start from (default: random).")
@twin_option
@click.option("--device", type=click.Choice(["cpu", "cuda"]), help="Where presses are told apart.")
@click.option("--time-budget", type=click.FloatRange(min=0), metavar="S", help="End with the best after S seconds.")
@click.option("--resume", is_flag=True, help="Go on where a search into the same folder was broken off.")
@scheduler_option
@seed_option
@out_option("out/pad")
@force_option
@json_option
@profile_option
@click.pass_context
def design(
    context: click.Context,
    spec: Path | None,
    method: str | None,
    knots: int | None,
    starts: int | None,
    origin: str,
    twin: Path | None,
    device: str | None,
    time_budget: float | None,
    resume: bool,
    scheduler: str | None,
    seed: int | None,
    out: Path,
    force: bool,
    as_json: bool,
) -> None:
    """Optimise the course of the fibres, or look at a finished morphology.

    \b
    padforge design                                   into out/pad, with the settings of pad.toml or the defaults
    padforge design --knots 8 --seed 1 --out out/pad
    padforge design --from out/pad/morphology.json    improves on a pad
    padforge design --twin out/pad/twin.json          for what presses of a printed pad have shown
    padforge design check out/pad/morphology.json     exit 1 if a rule is broken
    padforge design edit out/pad/morphology.json      fibres drawn by hand, in a browser
    padforge design import plan.svg                   fibres drawn elsewhere

    Writes morphology.json, design.json, design.svg and design.png. Exit 1 if the best pad breaks a rule. Ctrl-C ends
    with the best so far (exit 130); that and a kill leave what --resume goes on from. A pad from which a mould, a
    recording or others beside it were made is replaced with --force only.
    """
    if context.invoked_subcommand is not None:
        return
    from padforge.design.common.files import locked_folder
    from padforge.design.common.parallel import cluster
    from padforge.design.optimize.search import SearchOptions
    from padforge.design.run import run_search, search_lines
    from padforge.design.twin import Twin

    overrides = {"method": method, "knots": knots, "starts": starts, "seed": seed, "device": device}
    with locked_folder(out), cluster(scheduler) as executor:
        how = SearchOptions(resume=resume, time_budget=time_budget, executor=executor)
        document, result = run_search(load_spec(spec), out, overrides, origin, how, twin, force=force)
    if twin is not None and (left := Twin.load(twin).ignored_effects()):
        click.echo(f"{twin}: {left}", err=True)
    show_result(document, search_lines(result, out), as_json)
    context.exit(INTERRUPTED if result.stopped == "interrupted" else 1 if result.violations else 0)


@design.command()
@morphology_argument
@spec_option
@out_option(what="Picture to write, .svg or .png", file=True)
def show(morphology: Path, spec: Path | None, out: Path | None) -> None:
    """Draw the plan: fibres, crossings, broken rules and the contact to scale.

    \b
    padforge design show out/pad/morphology.json                  into out/pad/plan.svg
    padforge design show out/pad/morphology.json --out plan.png
    """
    from padforge.design.morphology import Morphology
    from padforge.design.run import write_plan

    path = out or pad_folder(morphology) / "plan.svg"
    write_plan(load_spec(spec), Morphology.load(morphology), path)
    click.echo(f"plan -> {path}")


@design.command()
@morphology_argument
@spec_option
@json_option
@click.pass_context
def check(context: click.Context, morphology: Path, spec: Path | None, as_json: bool) -> None:
    """Check every rule on the exact curves; exit 1 if one is broken.

    \b
    padforge design check out/pad/morphology.json
    """
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.rules import check_rules
    from padforge.design.settings import PadSettings, RulesSettings

    pad, settings = Morphology.load(morphology), load_spec(spec)
    size = settings.section(PadSettings, **pad.layout.settings)
    found = check_rules(pad, settings.section(RulesSettings), size)
    lines = [str(violation) for violation in found] or ["all rules hold"]
    show_result({"violations": [asdict(violation) for violation in found]}, lines, as_json)
    context.exit(1 if found else 0)


@design.command()
@morphology_argument
@spec_option
@twin_option
def score(morphology: Path, spec: Path | None, twin: Path | None) -> None:
    """Print every term of the objective as JSON.

    published_joint_entropy is that of all fibres over 49 presses, which limit it to log2 49 = 5.61 bits: straight
    fibres and all published pads are there.

    \b
    padforge design score out/pad/morphology.json
    padforge design score out/pad/morphology.json --twin out/pad/twin.json
    """
    from padforge.design.morphology import Morphology
    from padforge.design.objectives.rules import check_rules
    from padforge.design.objectives.score import score as score_terms
    from padforge.design.optimize.twin_search import settings_for_twin
    from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

    settings, pad = load_spec(spec), Morphology.load(morphology)
    if twin is not None:
        settings = settings_for_twin(settings, twin, pad)
    search, rules = settings.section(SearchSettings), settings.section(RulesSettings)
    size = settings.section(PadSettings, **pad.layout.settings)
    terms = score_terms(
        pad,
        settings.section(Contact),
        search.max_failures,
        rules=rules,
        size=size,
        scatter=search.response_scatter,
    )
    found = [asdict(violation) for violation in check_rules(pad, rules, size)]
    show_result({"terms": terms, "violations": found}, [], as_json=True)


design.add_command(edit)
design.add_command(import_)


def compare_command(making: "Making") -> click.Command:
    """`padforge design compare`, by what it takes to make a pad: the front door knows who does."""

    @click.command("compare")
    @click.argument("sources", metavar="[SPEC|MORPHOLOGY]...", nargs=-1, type=click.Path(exists=True, path_type=Path))
    @click.option(
        "--vary", metavar="KEY=V,V", multiple=True, help="Values a setting takes in turn, such as pad.grid=3,4."
    )
    @click.option("--time-budget", type=click.FloatRange(min=0), metavar="S", help="Seconds for each search.")
    @seed_option
    @out_option("out/comparison")
    @json_option
    @profile_option
    def command(
        sources: tuple[Path, ...],
        vary: tuple[str, ...],
        time_budget: float | None,
        seed: int | None,
        out: Path,
        as_json: bool,
    ) -> None:
        """Which pad to make: a table and a figure of variants, by fibres, length, mould and error with fibres lost.

        \b
        padforge design compare --vary pad.grid=3,4,5 --vary search.knots=6,21
        padforge design compare small.toml large.toml
        padforge design compare out/pad/morphology.json published.mat

        Every variant is designed into a folder of its own, with its mould; morphologies are taken as they are.
        """
        from padforge.design.common.files import locked_folder
        from padforge.design.compare import compare, comparison_lines, variants
        from padforge.design.optimize.search import SearchOptions

        pads = variants(sources, vary, load_spec)
        with locked_folder(out):
            document = compare(pads, out, SearchOptions(time_budget=time_budget), seed, making)
        show_result(document, [*comparison_lines(document), f"comparison -> {out / 'comparison.json'}"], as_json)

    return command
