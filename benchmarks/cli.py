"""`padforge bench`: run time against error, of whichever benches there are."""

from pathlib import Path

import click

from padforge.design.common.command_line import json_option, out_option, progress, show_result
from padforge.design.common.validation import InputError

BENCHES = ("contact", "objective", "search", "networks", "filter", "localizer", "twin", "mould")


@click.command()
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
    padforge bench                                all of them, some minutes
    padforge bench contact filter                 of contact, objective, search, networks, filter,
                                                  localizer, twin, mould
    padforge bench --against before/bench.json    what has become slower or less accurate, by ratio

    Writes NAME.json, NAME.csv and NAME.png for each, and bench.json and bench.csv with the summary.
    """
    from dataclasses import asdict
    from pkgutil import resolve_name

    from padforge.benchmarks.comparison import compared, comparison_lines, read_earlier
    from padforge.benchmarks.suite import run_benches
    from padforge.benchmarks.table import bench_lines, summary_lines

    before = read_earlier(against) if against else {}
    chosen = names or [name for name in BENCHES if not before or name in before]
    if not chosen:
        raise InputError(f"{against}: holds none of the benches {', '.join(BENCHES)}")
    with progress() as bar:
        task = bar.add_task("bench", total=None, note="")
        found = [resolve_name(f"padforge.benchmarks.{name}:BENCH") for name in dict.fromkeys(chosen)]
        summary, changes = run_benches(found, out, lambda step: bar.update(task, note=step), before)
    tables = [line for document in summary["benches"].values() for line in [*bench_lines(document), ""]]
    verdict = ["", *comparison_lines(changes, compared(before, summary["benches"]))] if against else []
    document = summary | {"worse": [asdict(change) for change in changes]}
    show_result(document, [*tables, *summary_lines(summary["summary"]), *verdict], as_json)
    context.exit(int(bool(changes)))
