"""The files of a benchmark: JSON, CSV and a work-precision figure."""

import csv
import io
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from .files import provenance, write_json, write_text
from .palette import CURVES, FAINT, INK
from .plan import save_figure

FORMAT = "padforge-bench/1"


@dataclass(frozen=True)
class Row:
    """One measurement; those alike in case, way and size are repetitions, of which tables and figures show the median.

    Attributes:
        case: what was computed. way: how. size: the way's own parameter (samples, steps; 0 if it has none).
        error: what the figure's axis says; None where only time is asked for.
        seconds: median wall time. visited: share of the scene that was looked at; None where that means nothing.
    """

    case: str
    way: str
    size: float
    error: float | None
    seconds: float
    visited: float | None


def write_bench(
    name: str, rows: Sequence[Row], out: Path, error_label: str, reference: tuple[str, float]
) -> dict[str, Any]:
    """Write `NAME.json`, `NAME.csv` and `NAME.png` to `out`; each row gets its speed relative to `reference`.

    Args:
        reference: (way, size) of the rows of the same case whose median time counts as 1.
    """
    base = {row.case: row.seconds for row in medians(rows) if (row.way, row.size) == reference}
    table = [asdict(row) | {"speed": base[row.case] / row.seconds if row.case in base else None} for row in rows]
    document = {
        "format": FORMAT,
        "bench": name,
        "reference": list(reference),
        "machine": f"{platform.machine()}, {platform.system()}",
        "rows": table,
        "provenance": provenance(f"padforge bench {name}", packages=("numba",)),
    }
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]))
    writer.writeheader()
    writer.writerows(table)
    write_text(out / f"{name}.csv", text.getvalue())
    save_figure(_draw(name, rows, error_label), out / f"{name}.png")
    write_json(out / f"{name}.json", document)
    return document


def medians(rows: Sequence[Row]) -> list[Row]:
    """One row for each case, way and size: medians over its repetitions."""
    alike: dict[tuple[str, str, float], list[Row]] = {}
    for row in rows:
        alike.setdefault((row.case, row.way, row.size), []).append(row)
    return [
        Row(*key, _median([r.error for r in same]), median(r.seconds for r in same), _median([r.visited for r in same]))
        for key, same in alike.items()
    ]


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def lines(document: dict[str, Any]) -> list[str]:
    """A benchmark as a table for people."""
    way, size = document["reference"]
    rows = medians([Row(**{field.name: row[field.name] for field in fields(Row)}) for row in document["rows"]])
    base = {row.case: row.seconds for row in rows if (row.way, row.size) == (way, size)}
    head = [f"{document['bench']}: speed relative to {way} at {size:g}", ""]
    head.append(f"{'case':<20} {'way':<13} {'size':>7} {'error':>9} {'time':>10} {'speed':>8} {'visited':>8}")
    for row in rows:
        error = "-" if row.error is None else f"{row.error:.1e}" if row.error < 1e-2 else f"{row.error:.3f}"
        time = f"{1e6 * row.seconds:.1f} us" if row.seconds < 0.1 else f"{row.seconds:.2f} s"
        speed = f"{base[row.case] / row.seconds:.2f}x" if row.case in base else "-"
        visited = "-" if row.visited is None else f"{100 * row.visited:.1f} %"
        head.append(f"{row.case:<20} {row.way:<13} {row.size:>7g} {error:>9} {time:>10} {speed:>8} {visited:>8}")
    return head


def _draw(name: str, rows: Sequence[Row], error_label: str) -> Figure:
    measured = [row for row in medians(rows) if row.error is not None]
    scale, unit = (1e3, "ms") if min(row.seconds for row in measured) < 0.1 else (1, "s")
    cases = list(dict.fromkeys(row.case for row in measured))
    figure = Figure(figsize=(4 * len(cases), 3.8), layout="constrained")
    colours = dict(zip(dict.fromkeys(row.way for row in measured), cycle(CURVES), strict=False))
    panels = figure.subplots(1, len(cases), sharey=True, squeeze=False)[0]
    for axes, case in zip(panels, cases, strict=True):
        for way, colour in colours.items():
            points = [(scale * r.seconds, max(r.error or 0, 1e-16)) for r in measured if (r.case, r.way) == (case, way)]
            if points:
                marker = "o-" if len(points) > 1 else "D"
                size = 4 if len(points) > 1 else 8
                axes.loglog(*zip(*points, strict=True), marker, color=colour, label=way, markersize=size, linewidth=1.4)
        axes.set_title(case, loc="left", color=INK)
        axes.set_xlabel(f"run time ({unit})")
        axes.grid(color=FAINT, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel(error_label)
    shown = {label: curve for axes in panels for curve, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    panels[-1].legend(shown.values(), shown.keys(), frameon=False)
    figure.suptitle(f"{name}: error against run time", x=0.01, ha="left", color=INK)
    return figure
