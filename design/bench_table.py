"""The files of a benchmark: JSON, CSV and a work-precision figure."""

import csv
import io
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from .files import provenance, write_json, write_text
from .palette import ALARM, FAINT, HORIZONTAL, INK, VERTICAL
from .plan import save_figure

FORMAT = "padforge-bench/1"


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        case: what was computed. way: how. size: the way's own parameter (samples, tolerance; 0 if it has none).
        error: against the reference of the case; None where only time is asked for.
        seconds: median wall time. visited: share of the scene that was looked at.
    """

    case: str
    way: str
    size: float
    error: float | None
    seconds: float
    visited: float


def write_bench(
    name: str, rows: Sequence[Row], out: Path, error_label: str, reference: tuple[str, float]
) -> dict[str, Any]:
    """Write `NAME.json`, `NAME.csv` and `NAME.png` to `out`; each row gets its speed relative to `reference`.

    Args:
        reference: (way, size) of the row of the same case that counts as 1.
    """
    base = {row.case: row.seconds for row in rows if (row.way, row.size) == reference}
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


def lines(document: dict[str, Any]) -> list[str]:
    """A benchmark as a table for people."""
    way, size = document["reference"]
    head = [f"{document['bench']}: speed relative to {way} at {size:g}", ""]
    head.append(f"{'case':<20} {'way':<10} {'size':>7} {'error':>9} {'time':>10} {'speed':>8} {'visited':>8}")
    for row in document["rows"]:
        error = "-" if row["error"] is None else f"{row['error']:.1e}"
        speed = "-" if row["speed"] is None else f"{row['speed']:.2f}x"
        head.append(
            f"{row['case']:<20} {row['way']:<10} {row['size']:>7g} {error:>9} {1e6 * row['seconds']:>7.1f} us "
            f"{speed:>8} {100 * row['visited']:>6.1f} %"
        )
    return head


def _draw(name: str, rows: Sequence[Row], error_label: str) -> Figure:
    measured = [row for row in rows if row.error is not None]
    cases = list(dict.fromkeys(row.case for row in measured))
    figure = Figure(figsize=(4 * len(cases), 3.8), layout="constrained")
    colours = dict(zip(dict.fromkeys(row.way for row in rows), (INK, VERTICAL, HORIZONTAL, ALARM), strict=False))
    panels = figure.subplots(1, len(cases), sharey=True, squeeze=False)[0]
    for axes, case in zip(panels, cases, strict=True):
        for way, colour in colours.items():
            points = [(1e3 * r.seconds, max(r.error or 0, 1e-16)) for r in measured if (r.case, r.way) == (case, way)]
            if points:
                marker = "o-" if len(points) > 1 else "D"
                size = 4 if len(points) > 1 else 8
                axes.loglog(*zip(*points, strict=True), marker, color=colour, label=way, markersize=size, linewidth=1.4)
        axes.set_title(case, loc="left", color=INK)
        axes.set_xlabel("run time (ms)")
        axes.grid(color=FAINT, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel(error_label)
    panels[-1].legend(frameon=False)
    figure.suptitle(f"{name}: error against run time", x=0.01, ha="left", color=INK)
    return figure
