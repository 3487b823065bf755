"""`padforge design`: the edge where settings come in and morphologies go out."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.common.command_line import (
    INTERRUPTED,
    json_option,
    load_spec,
    out_option,
    profile_option,
    progress,
    seed_option,
    show_result,
    spec_option,
)

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from design.common.settings import Spec
    from design.optimisers.search import SearchResult

morphology_argument = click.argument("morphology", type=click.Path(path_type=Path))


@click.group(invoke_without_command=True)
@spec_option
@click.option("--method", type=click.Choice(["descent", "genetic"]), help="Gradient search, or the published one.")
@click.option("--knots", type=int, help="Inner knots per fibre.")
@click.option("--starts", type=int, help="Random starts of the gradient search.")
@click.option("--from", "origin", metavar="random|straight|FILE", default="random", help="What to start from.")
@click.option("--device", type=click.Choice(["cpu", "cuda"]), help="Where presses are told apart.")
@click.option("--time-budget", type=click.FloatRange(min=0), metavar="S", help="End with the best after S seconds.")
@click.option("--resume", is_flag=True, help="Go on where a search into the same folder was broken off.")
@click.option("--scheduler", metavar="ADDRESS", help="Run the starts on a Dask cluster.")
@seed_option
@out_option("out/pad")
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
    device: str | None,
    time_budget: float | None,
    resume: bool,
    scheduler: str | None,
    seed: int | None,
    out: Path,
    as_json: bool,
) -> None:
    """Optimise the course of the fibres, or look at a finished morphology.

    \b
    padforge design                                   into out/pad, with the settings of pad.toml or the defaults
    padforge design --knots 8 --seed 1 --out out/pad
    padforge design --from out/pad/morphology.json    improves on a pad
    padforge design check out/pad/morphology.json     exit 1 if a rule is broken

    Writes morphology.json, design.json, design.svg and design.png. Exit 1 if the best pad breaks a rule. Ctrl-C ends
    with the best so far (exit 130); that and a kill leave what --resume goes on from.
    """
    if context.invoked_subcommand is not None:
        return
    from design.common.files import claimed

    overrides = {"method": method, "knots": knots, "starts": starts, "seed": seed, "device": device}
    with claimed(out), cluster(scheduler) as executor:
        document, result = run_search(
            load_spec(spec), out, overrides, origin, time_budget=time_budget, resume=resume, executor=executor
        )
    show_result(document, search_lines(result, out), as_json)
    context.exit(INTERRUPTED if result.stopped == "interrupted" else 1 if result.violations else 0)


def run_search(
    spec: "Spec", out: Path, overrides: dict[str, Any], origin: str = "random", **how: Any
) -> tuple[dict[str, Any], "SearchResult"]:
    """Search with the settings of `spec`, write all results to `out`, and return `design.json` with the result.

    Args:
        origin: "random", "straight" or the file of a morphology to start from, which also says how many knots a fibre
            has unless `overrides` does. how: more arguments of `search`.
    """
    from design.common.figures import save_figure
    from design.common.files import provenance, write_json
    from design.common.profiling import stage
    from design.optimisers.search import search
    from design.pad.morphology import Morphology
    from design.report.plan_drawing import draw_plan

    from .settings import Contact, PadSettings, RulesSettings, SearchSettings

    pad, contact, rules = spec.section(PadSettings), spec.section(Contact), spec.section(RulesSettings)
    begin, inputs = None, []
    if origin == "straight":
        begin = Morphology.straight(pad.grid, pad.pitch_mm)
    elif origin != "random":
        begin, inputs = Morphology.load(origin), [Path(origin)]
        overrides = overrides | {"knots": overrides.get("knots") or (begin.knots.shape[1] - 2 or None)}
    settings = spec.section(SearchSettings, **overrides)
    with progress() as bar:
        tasks: dict[str, Any] = {}
        best: list[float] = []

        def report(run: str, done: int, total: int, objective: float) -> None:
            if run not in tasks:
                tasks[run] = bar.add_task(run, total=total, note="")
            best[:] = [min([objective, *best])]
            bar.update(tasks[run], completed=done, note=f"objective {objective:.4f}, best {best[0]:.4f}")

        result = search(pad, contact, settings, rules, origin=begin, report=report, keep_in=out / "search", **how)
    origin_of = provenance("padforge design", settings.seed, inputs, packages=("torch", "pymoo"))
    used = {"pad": pad, "contact": contact, "search": settings, "rules": rules}
    origin_of["settings"] = {name: section.model_dump(mode="json") for name, section in used.items()}
    Morphology(result.morphology.knots, pad.pitch_mm, origin_of).save(out / "morphology.json")
    document = {
        "format": "padforge-design/1",
        "terms": result.terms,
        "violations": [asdict(violation) for violation in result.violations],
        "history": result.history,
        "seconds": round(result.seconds, 3),
        "stopped": result.stopped,
        "provenance": origin_of,
    }
    with stage("figures"):
        figure = draw_plan(result.morphology, contact, result.violations)
        save_figure(figure, out / "design.svg")
        save_figure(figure, out / "design.png")
    write_json(out / "design.json", document)
    return document, result


@contextmanager
def cluster(address: str | None) -> "Iterator[Executor | None]":
    """Slices of the starts on the Dask cluster at `address`, or None for this machine.

    Raises:
        InputError: Dask is not installed, or no scheduler answers there.
    """
    if address is None:
        yield None
        return
    from design.common.errors import InputError

    try:
        from distributed import Client
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'padforge[cluster]'") from error
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler is {address}: no Dask scheduler answers there ({error})") from error
    with client, client.get_executor(pure=False, retries=10) as executor:
        yield executor


def search_lines(result: "SearchResult", out: Path) -> list[str]:
    """What a person wants to know of a search, in a few lines."""
    spread = [v for name, v in result.terms.items() if name.startswith("ambiguity")]
    lost = " / ".join(f"{value:.3f}" for value in spread)
    broken = [f"  broken  {violation}" for violation in result.violations[:10]]
    more = len(result.violations) - len(broken)
    return [
        f"design: {len(result.morphology.knots)} fibres in {result.seconds:.1f} s -> {out / 'morphology.json'}"
        + (f" ({result.stopped}: the best so far)" if result.stopped else ""),
        f"  ambiguity {lost} grid units under noise, with {' / '.join(map(str, range(len(spread))))} fibres lost",
        *(broken or ["  all rules hold" if result.enforced else "  rules are not enforced"]),
        *([f"  ... and {more} more"] if more > 0 else []),
    ]


@design.command()
@morphology_argument
@spec_option
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="Picture to write, .svg or .png.")
def show(morphology: Path, spec: Path | None, out: Path | None) -> None:
    """Draw the plan: fibres, crossings, broken rules and the contact to scale.

    \b
    padforge design show out/pad/morphology.json --out plan.png
    """
    from design.common.errors import InputError
    from design.common.figures import save_figure
    from design.criteria.rules import check_rules
    from design.pad.morphology import Morphology
    from design.report.plan_drawing import draw_plan

    from .settings import Contact, RulesSettings

    settings, pad = load_spec(spec), Morphology.load(morphology)
    path = out or Path(f"{morphology.stem}.svg")
    if path.suffix.lower() not in (".svg", ".png"):
        raise InputError(f"--out is {path}, allowed are .svg and .png")
    save_figure(draw_plan(pad, settings.section(Contact), check_rules(pad, settings.section(RulesSettings))), path)
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
    from design.criteria.rules import check_rules
    from design.pad.morphology import Morphology

    from .settings import RulesSettings

    found = check_rules(Morphology.load(morphology), load_spec(spec).section(RulesSettings))
    lines = [str(violation) for violation in found] or ["all rules hold"]
    show_result({"violations": [asdict(violation) for violation in found]}, lines, as_json)
    context.exit(1 if found else 0)


@design.command()
@morphology_argument
@spec_option
def score(morphology: Path, spec: Path | None) -> None:
    """Print every term of the objective as JSON.

    \b
    padforge design score out/pad/morphology.json
    """
    from design.criteria.rules import check_rules
    from design.criteria.score import score as score_terms
    from design.pad.morphology import Morphology

    from .settings import Contact, RulesSettings, SearchSettings

    settings, pad = load_spec(spec), Morphology.load(morphology)
    contact, search, rules = (
        settings.section(Contact),
        settings.section(SearchSettings),
        settings.section(RulesSettings),
    )
    terms = score_terms(pad, contact, search.lost, search.noise, rules)
    found = [asdict(violation) for violation in check_rules(pad, rules)]
    show_result({"terms": terms, "violations": found}, [], as_json=True)
