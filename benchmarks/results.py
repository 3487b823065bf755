"""Write the results of benchmarks as JSON, CSV, tables and work-precision figures, and compare two runs."""

import csv
import io
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from padforge.design.common.command_line import text_table
from padforge.design.common.files import provenance, read_json, write_json, write_text
from padforge.design.common.plotting import CURVES, FAINT, INK, add_title, save_figure, style_axes
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from padforge.benchmarks.harness import Bench, BenchRounds

FORMAT, SUMMARY_FORMAT = "padforge-bench/1", "padforge-benches/1"
"""Formats of NAME.json and bench.json; runs of earlier versions stay comparable, so keys must not change."""

Row = dict[str, Any]
"""A trial: "case", "way", "size", "repetition", "error", "seconds", "paces", "visited", "speed" and more."""
TrialKey = tuple[str, str, float, int]
KEY = ("case", "way", "size", "repetition")
"""Columns that identify a trial."""

SLOWER, LESS_ACCURATE, VISITS_MORE = "slower", "less accurate", "visits more"
MAX_RATIOS = {SLOWER: 1.25, LESS_ACCURATE: 1.25, VISITS_MORE: 1.1}
"""Ratios beyond which a trial counts as worse."""
SHORT_S = 1e-3
"""The time of shorter work depends on memory layout: it counts as slower only if another trial of its way does."""
MIN_ERROR, MIN_VISITED = 1e-15, 1e-3
"""Smaller errors (rounding) and shares count as equal."""


def write_bench(bench: "Bench", rounds: "BenchRounds", out: Path) -> dict[str, Any]:
    """Write `NAME.json`, `NAME.csv` and `NAME.png` of a benchmark, and return the content of the first.

    Args:
        bench: the benchmark.
        rounds: its measurements.
        out: folder of the files.
    """
    rows = [
        dict(zip(KEY, key, strict=True))
        | {"error": None, "seconds": min(rounds.seconds[key]), "paces": min(rounds.paces[key]), "visited": None}
        | dict(result)
        for key, result in rounds.results.items()
    ]
    medians = _medians(rows)
    reference_s = {row["case"]: row["seconds"] for row in medians if (row["way"], row["size"]) == bench.reference}
    for row in rows:
        row["speed"] = reference_s[row["case"]] / row["seconds"] if row["case"] in reference_s else None
    document = {
        "format": FORMAT,
        "bench": bench.name,
        "reference": list(bench.reference),
        "best": list(bench.default),
        "plain": sorted(bench.baselines),
        "machine": f"{platform.machine()}, {platform.system()}",
        "pace_s": rounds.pace_s,
        "rows": rows,
        "provenance": provenance(f"padforge bench {bench.name}", packages=("numba",)),
    }
    _write_csv(rows, out / f"{bench.name}.csv")
    save_figure(_draw(bench.name, medians, bench.error_label), out / f"{bench.name}.png")
    write_json(out / f"{bench.name}.json", document)
    return document


def write_summary(documents: Mapping[str, Mapping[str, Any]], out: Path) -> dict[str, Any]:
    """Write and return `bench.json` with all documents, and write `bench.csv`: the package's way beside the reference.

    Args:
        documents: documents of the benchmarks by name.
        out: folder of the files.
    """
    summary: list[Row] = []
    for name, document in documents.items():
        medians = {_key(row)[:3]: row for row in _medians(document["rows"])}
        for case in dict.fromkeys(case for case, *_ in medians):
            default, reference = (medians.get((case, *document[which])) for which in ("best", "reference"))
            if default and reference:
                row = {"bench": name, "case": case, "reference": _way(*document["reference"])}
                row |= {f"reference_{column}": reference[column] for column in ("error", "seconds")}
                row |= {"way": _way(*document["best"]), "error": default["error"], "seconds": default["seconds"]}
                summary.append(row | {"speed": reference["seconds"] / default["seconds"]})
    document = {"format": SUMMARY_FORMAT, "summary": summary, "benches": dict(documents)}
    _write_csv(summary, out / "bench.csv")
    write_json(out / "bench.json", document)
    return document


def _write_csv(rows: Sequence[Row], path: Path) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def _medians(rows: Sequence[Row]) -> list[Row]:
    """Return a row per case, way and size, with medians over its repetitions."""
    groups: dict[TrialKey, list[Row]] = {}
    for row in rows:
        groups.setdefault((*_key(row)[:3], 0), []).append(row)
    medians = [dict(zip(KEY, key, strict=True)) for key in groups]
    for row, group in zip(medians, groups.values(), strict=True):
        for name in ("error", "seconds", "visited"):
            values = [trial[name] for trial in group if trial[name] is not None]
            row[name] = median(values) if values else None
    return medians


def _key(row: Row) -> TrialKey:
    return row["case"], row["way"], row["size"], row["repetition"]


def bench_lines(document: Mapping[str, Any]) -> list[str]:
    """Format a benchmark as a table of text."""
    rows, reference = _medians(document["rows"]), tuple(document["reference"])
    reference_s = {row["case"]: row["seconds"] for row in rows if (row["way"], row["size"]) == reference}
    cells = [["case", "way", "size", "error", "time", "speed", "visited"]]
    for row in rows:
        speed = f"{reference_s[row['case']] / row['seconds']:.2f}x" if row["case"] in reference_s else "-"
        visited = "-" if row["visited"] is None else f"{100 * row['visited']:.1f} %"
        quantities = f"{row['size']:g}", _error(row["error"]), _time(row["seconds"]), speed, visited
        cells.append([row["case"], row["way"], *quantities])
    return [f"{document['bench']}: speed relative to {_way(*reference)}", "", *text_table(cells, (0, 1))]


def summary_lines(summary: Sequence[Row]) -> list[str]:
    """Format the summary as a table of text."""
    cells = [["bench", "case", "beside", "error", "time", "padforge", "error", "time", "speed"]]
    for row in summary:
        reference = row["reference"], _error(row["reference_error"]), _time(row["reference_seconds"])
        default = row["way"], _error(row["error"]), _time(row["seconds"]), f"{row['speed']:.3g}x"
        cells.append([row["bench"], row["case"], *reference, *default])
    return text_table(cells, (0, 1, 2, 5))


def _way(way: str, size: float) -> str:
    return f"{way} at {size:g}" if size else way


def _error(error: float | None) -> str:
    return "-" if error is None else f"{error:.1e}" if error < 1e-2 else f"{error:.3f}"


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{1e6 * seconds:.1f} us"
    return f"{1e3 * seconds:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"


def _draw(name: str, medians: Sequence[Row], error_label: str) -> Figure:
    """Draw a work-precision diagram: error against run time, a panel per case, a curve per way."""
    rows = [row for row in medians if row["error"] is not None]
    scale, unit = (1e3, "ms") if min(row["seconds"] for row in rows) < 0.1 else (1, "s")
    cases = list(dict.fromkeys(row["case"] for row in rows))
    colours = dict(zip(dict.fromkeys(row["way"] for row in rows), cycle(CURVES), strict=False))
    figure = Figure(figsize=(4 * len(cases), 3.8), layout="constrained")
    panels = figure.subplots(1, len(cases), sharey=True, squeeze=False)[0]
    handles: dict[str, Any] = {}
    for axes, case in zip(panels, cases, strict=True):
        for way, colour in colours.items():
            group = [row for row in rows if (row["case"], row["way"]) == (case, way)]
            if group:
                times, errors = [scale * row["seconds"] for row in group], [max(row["error"], 1e-16) for row in group]
                marker, size = ("o-", 4) if len(group) > 1 else ("D", 8)
                (handles[way],) = axes.loglog(times, errors, marker, color=colour, markersize=size, linewidth=1.4)
        axes.set_title(case, loc="left", color=INK)
        axes.set_xlabel(f"run time ({unit})")
        for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.grid(color=FAINT, linewidth=0.6)
        style_axes(axes)
    panels[0].set_ylabel(error_label)
    panels[-1].legend(list(handles.values()), list(handles), frameon=False)
    add_title(figure, f"{name}: error against run time")
    return figure


@dataclass(frozen=True)
class Worsening:
    """A trial that is worse than in an earlier run.

    Attributes:
        bench: name of the benchmark.
        key: identity of the trial.
        what: SLOWER, LESS_ACCURATE or VISITS_MORE.
        before: seconds per item, error or visited share in the earlier run.
        now: the same in this run.
        ratio: ratio of the two; of times as far as the pace of the machine does not explain it.
    """

    bench: str
    key: TrialKey
    what: str
    before: float
    now: float
    ratio: float

    def __str__(self) -> str:
        case, way, size, repetition = self.key
        trial = f"{self.bench}, {case}, {way}" + (f" {size:g}" if size else "") + f" #{repetition}" * bool(repetition)
        return f"{trial}: {self.what}, {self.ratio:.2f}x ({self.before:.3g} before, {self.now:.3g} now)"


def read_earlier(path: Path) -> dict[str, Mapping[str, Any]]:
    """Read the documents of an earlier run, by name of the benchmark, from `bench.json` or `NAME.json`."""
    content = read_json(path, SUMMARY_FORMAT, FORMAT)
    try:
        listed = content["benches"].values() if content["format"] == SUMMARY_FORMAT else [content]
        documents: dict[str, Mapping[str, Any]] = {document["bench"]: document for document in listed}
        find_worsenings(documents, documents)  # reads everything that a comparison reads
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: not as padforge bench writes it ({error!r})") from error
    return documents


def find_worsenings(before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]) -> list[Worsening]:
    """Return the trials of the package's own ways that are worse than before, the worst of each benchmark first.

    Args:
        before: documents of the earlier run by name of the benchmark.
        now: documents of this run.
    """
    worsenings: list[Worsening] = []
    for name in [name for name in now if name in before]:
        pace = before[name]["pace_s"] / now[name]["pace_s"]  # above 1 if the machine is faster now
        worse: list[Worsening] = []
        for key, (old, new) in _common_trials(before[name], now[name]).items():
            # a machine that is busy all the time never shows its best pace: the pace beside the trial counts as well
            slowdown = min(pace * new["seconds"] / old["seconds"], new["paces"] / old["paces"])
            changes = [(SLOWER, "seconds", slowdown)]
            for what, column, minimum in ((LESS_ACCURATE, "error", MIN_ERROR), (VISITS_MORE, "visited", MIN_VISITED)):
                if old[column] is not None and new[column] is not None:
                    changes.append((what, column, max(new[column], minimum) / max(old[column], minimum)))
            for what, column, ratio in changes:
                if not ratio <= MAX_RATIOS[what]:  # also NaN
                    worse.append(Worsening(now[name]["bench"], key, what, old[column], new[column], ratio))
        slower_ways = [change.key[1] for change in worse if change.what == SLOWER]
        certain = [w for w in worse if w.what != SLOWER or w.before >= SHORT_S or slower_ways.count(w.key[1]) > 1]
        worsenings += sorted(certain, key=lambda change: -change.ratio)
    return worsenings


def _common_trials(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[TrialKey, tuple[Row, Row]]:
    """Return the rows of the trials of the package's own ways that both documents have."""
    old, new = ({_key(row): row for row in document["rows"]} for document in (before, now))
    return {key: (old[key], new[key]) for key in new if key in old and key[1] not in now["plain"]}


def comparison_lines(
    changes: Sequence[Worsening], before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Format the comparison of two runs as text.

    Args:
        changes: what is worse.
        before: documents of the earlier run by name of the benchmark.
        now: documents of this run.
    """
    n_trials = sum(len(_common_trials(before[name], now[name])) for name in before.keys() & now.keys())
    if not changes:
        return [f"{n_trials} trials compared: none is slower, less accurate or visits more"]
    return [f"{n_trials} trials compared; worse than before:", *(f"  {change}" for change in changes)]
