"""The files of a benchmark, JSON, CSV and a work-precision figure, and its tables for people."""

import csv
import io
import platform
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from padforge.benchmarks.harness import Bench, BenchRounds
from padforge.design.common.files import provenance, write_json, write_text
from padforge.design.common.plotting import CURVES, FAINT, INK, save_figure

FORMAT = "padforge-bench/1"
SUMMARY_FORMAT = "padforge-benches/1"

Row = dict[str, Any]
"""One line of a benchmark: "case", "way", "size", "repetition", "error", "seconds", "paces", "visited" and more."""


def write_bench(bench: Bench, measured: BenchRounds, out: Path) -> dict[str, Any]:
    """Write `NAME.json`, `NAME.csv` and `NAME.png` to `out`; each row gets its speed relative to the reference."""
    rows = [
        dict(zip(("case", "way", "size", "repetition"), key, strict=True))
        | {"error": None, "seconds": min(measured.times[key]), "paces": min(measured.paces[key])}
        | {"visited": None, **found}
        for key, found in measured.found.items()
    ]
    base = {row["case"]: row["seconds"] for row in medians(rows) if (row["way"], row["size"]) == bench.reference}
    table = [row | {"speed": base[row["case"]] / row["seconds"] if row["case"] in base else None} for row in rows]
    document = {
        "format": FORMAT,
        "bench": bench.name,
        "reference": list(bench.reference),
        "best": list(bench.best),
        "plain": sorted(bench.plain),
        "machine": f"{platform.machine()}, {platform.system()}",
        "pace_s": measured.pace_s,
        "rows": table,
        "provenance": provenance(f"padforge bench {bench.name}", packages=("numba",)),
    }
    write_csv(table, out / f"{bench.name}.csv")
    save_figure(_draw(bench.name, rows, bench.error), out / f"{bench.name}.png")
    write_json(out / f"{bench.name}.json", document)
    return document


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write rows of the same columns."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def medians(rows: Sequence[Row]) -> list[Row]:
    """One row for each case, way and size: medians over its repetitions."""
    alike: dict[tuple[str, str, float], list[Row]] = {}
    for row in rows:
        alike.setdefault((row["case"], row["way"], row["size"]), []).append(row)
    return [
        {"case": case, "way": way, "size": size}
        | {name: _median([row[name] for row in same]) for name in ("error", "seconds", "visited")}
        for (case, way, size), same in alike.items()
    ]


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def bench_lines(document: Mapping[str, Any]) -> list[str]:
    """A benchmark as a table for people."""
    way, size = document["reference"]
    rows = medians(document["rows"])
    base = {row["case"]: row["seconds"] for row in rows if (row["way"], row["size"]) == (way, size)}
    head = [f"{document['bench']}: speed relative to {way}{_at(size)}", ""]
    head.append(f"{'case':<20} {'way':<13} {'size':>7} {'error':>9} {'time':>10} {'speed':>8} {'visited':>8}")
    for row in rows:
        speed = f"{base[row['case']] / row['seconds']:.2f}x" if row["case"] in base else "-"
        visited = "-" if row["visited"] is None else f"{100 * row['visited']:.1f} %"
        head.append(
            f"{row['case']:<20} {row['way']:<13} {row['size']:>7g} {_error(row['error']):>9} "
            f"{_time(row['seconds']):>10} {speed:>8} {visited:>8}"
        )
    return head


def summary_rows(documents: Sequence[Mapping[str, Any]]) -> list[Row]:
    """The way the package goes by beside the reference of every case that has both: one row each."""
    found = []
    for document in documents:
        rows = {(row["case"], row["way"], row["size"]): row for row in medians(document["rows"])}
        best, reference = tuple(document["best"]), tuple(document["reference"])
        for case in dict.fromkeys(case for case, *_ in rows):
            if (ours := rows.get((case, *best))) and (theirs := rows.get((case, *reference))):
                found.append(
                    {
                        "bench": document["bench"],
                        "case": case,
                        "reference": f"{reference[0]}{_at(reference[1])}",
                        "reference_error": theirs["error"],
                        "reference_seconds": theirs["seconds"],
                        "way": f"{best[0]}{_at(best[1])}",
                        "error": ours["error"],
                        "seconds": ours["seconds"],
                        "speed": theirs["seconds"] / ours["seconds"],
                    }
                )
    return found


def summary_lines(rows: Sequence[Row]) -> list[str]:
    """`summary_rows` as a table for people."""
    return [
        f"{'bench':<10} {'case':<15} {'beside':<17} {'error':>9} {'time':>9}   "
        f"{'padforge':<17} {'error':>9} {'time':>9} {'speed':>7}",
        *(
            f"{row['bench']:<10} {row['case']:<15} {row['reference']:<17} {_error(row['reference_error']):>9} "
            f"{_time(row['reference_seconds']):>9}   {row['way']:<17} {_error(row['error']):>9} "
            f"{_time(row['seconds']):>9} {row['speed']:>6.3g}x"
            for row in rows
        ),
    ]


def _at(size: float) -> str:
    return f" at {size:g}" if size else ""


def _error(error: float | None) -> str:
    return "-" if error is None else f"{error:.1e}" if error < 1e-2 else f"{error:.3f}"


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{1e6 * seconds:.1f} us"
    return f"{1e3 * seconds:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"


def _draw(name: str, rows: Sequence[Row], error_label: str) -> Figure:
    measured = [row for row in medians(rows) if row["error"] is not None]
    scale, unit = (1e3, "ms") if min(row["seconds"] for row in measured) < 0.1 else (1, "s")
    cases = list(dict.fromkeys(row["case"] for row in measured))
    figure = Figure(figsize=(4 * len(cases), 3.8), layout="constrained")
    colours = dict(zip(dict.fromkeys(row["way"] for row in measured), cycle(CURVES), strict=False))
    panels = figure.subplots(1, len(cases), sharey=True, squeeze=False)[0]
    for axes, case in zip(panels, cases, strict=True):
        for way, colour in colours.items():
            points = [
                (scale * row["seconds"], max(row["error"], 1e-16))
                for row in measured
                if (row["case"], row["way"]) == (case, way)
            ]
            if points:
                marker = "o-" if len(points) > 1 else "D"
                size = 4 if len(points) > 1 else 8
                axes.loglog(*zip(*points, strict=True), marker, color=colour, label=way, markersize=size, linewidth=1.4)
        axes.set_title(case, loc="left", color=INK)
        axes.set_xlabel(f"run time ({unit})")
        _number(axes)
        axes.grid(color=FAINT, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel(error_label)
    shown = {label: curve for axes in panels for curve, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    panels[-1].legend(shown.values(), shown.keys(), frameon=False)
    figure.suptitle(f"{name}: error against run time", x=0.01, ha="left", color=INK)
    return figure


def _number(axes: Axes) -> None:
    """Plain numbers on logarithmic axes, at 1, 2 and 5 where a decade fills much of one."""
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
