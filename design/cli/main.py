"""`padforge design`: the edge where settings come in and morphologies go out."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

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

from .drawing import import_
from .editing import edit

if TYPE_CHECKING:
    from padforge.design.report.comparison import Making

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
    from padforge.design.common.computing import cluster
    from padforge.design.common.files import claimed
    from padforge.design.optimisers.search import SearchRun
    from padforge.design.pad.twin import Twin
    from padforge.design.report.files import run_search, search_lines

    overrides = {"method": method, "knots": knots, "starts": starts, "seed": seed, "device": device}
    with claimed(out), cluster(scheduler) as executor:
        how = SearchRun(resume=resume, time_budget=time_budget, executor=executor)
        document, result = run_search(load_spec(spec), out, overrides, origin, how, twin, force=force)
    if twin is not None and (left := Twin.load(twin).left_out()):
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
    from padforge.design.pad.morphology import Morphology
    from padforge.design.report.files import write_plan

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
    from padforge.design.criteria.rules import check_rules
    from padforge.design.pad.morphology import Morphology
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
    from padforge.design.criteria.rules import check_rules
    from padforge.design.criteria.score import score as score_terms
    from padforge.design.evaluation.expected_error import error_terms, expected_errors
    from padforge.design.pad.morphology import Morphology
    from padforge.design.report.twin_settings import settings_for_twin
    from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

    settings, pad = load_spec(spec), Morphology.load(morphology)
    if twin is not None:
        settings = settings_for_twin(settings, twin, pad)
    search, rules = settings.section(SearchSettings), settings.section(RulesSettings)
    size = settings.section(PadSettings, **pad.layout.settings)
    asked = settings.section(Contact), search.lost
    terms = error_terms(expected_errors(pad, settings.section(Contact), search, size))
    terms |= score_terms(pad, *asked, rules=rules, size=size)
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
        from padforge.design.common.files import claimed
        from padforge.design.optimisers.search import SearchRun
        from padforge.design.report.comparison import compare, comparison_lines, variants

        pads = variants(sources, vary, load_spec)
        with claimed(out):
            document = compare(pads, out, SearchRun(time_budget=time_budget), seed, making)
        show_result(document, [*comparison_lines(document), f"comparison -> {out / 'comparison.json'}"], as_json)

    return command
