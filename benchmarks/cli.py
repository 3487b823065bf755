"""`padforge bench`: measure run time against error."""

from pathlib import Path

import click

from padforge.common.command_line import json_option, out_option, progress_bar, show_result
from padforge.common.validation import InputError

BENCHES = {
    "contact": "contact:CONTACT",
    "objective": "contact:OBJECTIVE",
    **{name: f"{name}:BENCH" for name in ("search", "networks", "filter", "localizer", "twin", "mould")},
}
"""Where each benchmark is defined."""


@click.command()
@click.argument("names", nargs=-1, metavar="[NAME]...", type=click.Choice(list(BENCHES)))
@click.option(
    "--against",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE",
    help="bench.json of an earlier run; exit code 1 if anything is worse now.",
)
@out_option("out/bench")
@json_option
@click.pass_context
def bench(context: click.Context, names: tuple[str, ...], against: Path | None, out: Path, as_json: bool) -> None:
    """Compare run time and error with published and plain methods.

    \b
    padforge bench                                all benchmarks, some minutes
    padforge bench contact filter                 some of contact, objective,
                                                  search, networks, filter,
                                                  localizer, twin, mould
    padforge bench --against before/bench.json    what is slower or worse now

    Writes bench.json with all results and their summary, and NAME.png for each.
    """
    from dataclasses import asdict
    from pkgutil import resolve_name

    from padforge.benchmarks.harness import bench_lines, comparison_lines, read_earlier, run_benches, summary_lines

    earlier = read_earlier(against) if against else {}
    names = tuple(dict.fromkeys(names)) or tuple(name for name in BENCHES if not earlier or name in earlier)
    if not names:
        raise InputError(f"{against}: has none of the benchmarks {', '.join(BENCHES)}")
    with progress_bar("bench") as show:
        benches = [resolve_name(f"padforge.benchmarks.{BENCHES[name]}") for name in names]
        summary, changes = run_benches(benches, out, show, earlier)
    lines = [line for document in summary["benches"].values() for line in [*bench_lines(document), ""]]
    lines += summary_lines(summary["summary"])
    if against:
        lines += ["", *comparison_lines(changes, earlier, summary["benches"])]
    show_result(summary | {"worse": [asdict(change) for change in changes]}, lines, as_json)
    context.exit(int(bool(changes)))
