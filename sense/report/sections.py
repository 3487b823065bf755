"""Sections of the HTML report on recording, calibration, fibre loss and studies.

If a document is not as padforge writes it, they raise errors of Python, which the caller converts to an InputError
(`reraise_as_input_error`). A figure that cannot be read raises InputError.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from math import isnan
from pathlib import Path
from statistics import median
from typing import Any

from padforge.common.files import read_bytes
from padforge.common.page import PageSection, collapsible, columns, figures, heading, paragraph, table
from padforge.common.validation import InputError
from padforge.sense.localizer.evaluation import SIMULATED_NOTE, reserve_lines
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import JOURNAL, read_journal

MAP, BY_LOSS, BY_MOMENT = (f"figures/error_{name}.png" for name in ("map", "by_loss", "by_moment"))
NUMBERS = ("one", "two", "three")

Errors = Mapping[tuple[int, ...], float]  # mean error, mm, by indices of failed fibres, ascending


def recording_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Write the section on the recording in `folder`, from its `start.json`."""
    source = document["source"]
    kind = source.get("kind")
    names = {"simulated": "the simulated rig", "rig": "a rig", "hand": "presses by hand"}
    origin = names.get(kind) or source.get("file", kind)
    if "twin" in source:
        origin = f"{origin}, by the twin of a printed pad"
    rig = source.get("rig", {})
    cycle = f", {rig['rate_hz']:g} a second" if rig else ""
    if rig and kind != "hand":
        depths = rig.get("depths_mm") or [rig["depth_mm"]]
        depth = f"{min(depths):g} to {max(depths):g}" if len(depths) > 1 else f"{depths[0]:g}"
        cycle += f"; presses {depth} mm deep"
    body = [paragraph(f"Readings of {document['fibres']} fibres, from {origin}{cycle}.")]
    return [PageSection("Recording", [*body, *_measures_table(folder)])]


def recording_digest(folder: Path) -> str | None:
    """Return the digest of the recording in `folder`; None if there is none that can be read."""
    try:
        return Recording.open(folder / "recording").digest
    except InputError:
        return None


def _measures_table(folder: Path) -> list[str]:
    """Write a table of depth and force by the journal of the recording, if it has them."""
    journal = folder / "recording" / JOURNAL
    presses = list(read_journal(journal).values()) if journal.is_file() else []
    names = {"depth_mm": "depth commanded (mm)", "reached_mm": "depth reached (mm)", "force_n": "force (N)"}
    rows = []
    for key, name in names.items():
        if values := [value for press in presses if not isnan(value := getattr(press, key))]:
            statistics = (f"{statistic(values):.2f}" for statistic in (min, median, max))
            rows.append([name, len(values), *statistics])
    return [table(["", "presses", "minimum", "median", "maximum"], rows)] if rows else []


def calibration_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Write the section on a `calibration.json` in `folder`; and one on fibre loss, if `fibre_loss.json` is missing."""
    rows = document["errors"]
    idle = [f"{share:.0%}" for share in document["idle_share"]]
    simulated = document["provenance"].get("recording_kind") == "simulated"
    presses = "simulated presses" if simulated else "presses"
    split = {"random": "drawn at random", "chronological": "the last ones"}.get(document["split"], document["split"])
    one_network = " One network serves all failures." if len(rows) > 1 else ""
    head = ["failed", "sets", "mean (mm)", "std", "worst", "median", "95 %", "in r50", "in r90"]
    shares = [[f"{row[f'within_r{k}']:.1%}" for k in (50, 90)] for row in rows]
    errors = [_error_cells(row, "median_mm", "p95_mm") + cells for row, cells in zip(rows, shares, strict=True)]
    note = f"Errors are {SIMULATED_NOTE} with 0 / 1 / 2 / 3 of 6 fibres failed, after 4500 presses."
    pictures = [
        (folder / MAP, "True positions of presses, and the errors of the predicted ones."),
        (folder / BY_LOSS, "Error by number of failed fibres."),
    ]
    body = [
        paragraph(
            f"Errors on {document['test_presses']} {presses} never trained on ({split}).{one_network} Every position"
            " has two radii that ought to hold the true one in 50 % and in 90 % of cases."
        ),
        table(head, errors),
        *_measure_errors(rows),
        *_moment_errors(folder, document.get("by_moment", [])),
        *map(paragraph, [*([note] if simulated else []), *reserve_lines(document)]),
        paragraph(
            "Mean, standard deviation and worst are over the sets of failed fibres; median and 95th percentile over all"
            " their presses."
        ),
        figures(pictures),
        heading("Idle share"),
        paragraph("The share of presses in which a fibre changes by less than 2 % of its range."),
        table(["fibre", *map(str, range(1, len(idle) + 1))], [["idle", *idle]]),
    ]
    results = []
    for row in rows if len(rows) == 1 else (rows[0], rows[-1]):
        failures = f"{n} fibre{'s' if n > 1 else ''} failed" if (n := row["n_failed"]) else "all fibres"
        results.append((f"{row['mean_mm']:.2f} mm", f"mean error on {presses}, {failures}"))
    section = PageSection("Calibration", body, results)
    return [section, *([] if (folder / "fibre_loss.json").exists() else fibre_loss_sections(folder, document))]


def _moment_errors(folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Write a table of the errors during a press by time and number of failed fibres, and their figure."""
    if not rows:
        return []
    levels = sorted({row["n_failed"] for row in rows})
    cells = []
    for first in range(0, len(rows), len(levels)):
        of_moment = rows[first : first + len(levels)]
        errors = [cell for row in of_moment for cell in (f"{row['mean_mm']:.2f}", f"{row['within_r90']:.1%}")]
        cells.append([of_moment[0]["since"], f"{of_moment[0]['time_s']:.2f}", *errors])
    head = ["since", "time (s)", *(name for level in levels for name in (f"{level} failed (mm)", "in r90"))]
    caption = "Error by time since the touch and since the lift, and a touch that comes into focus."
    return [
        heading("While a press is read"),
        table(head, cells),
        figures([(folder / BY_MOMENT, caption)]),
    ]


def _measure_errors(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Write tables of the errors of depth and force by failed fibres, where they are estimated."""
    tables = []
    for kind, unit in (("depth", "mm"), ("force", "N")):
        mean, p95 = (f"{kind}_{statistic}_{unit.lower()}" for statistic in ("mean", "p95"))
        if mean in rows[0]:
            cells = [
                [row["n_failed"], f"{row[mean]:.2f}", f"{row[p95]:.2f}", f"{row[f'{kind}_within_r90']:.1%}"]
                for row in rows
            ]
            tables.append(table(["failed", f"{kind}, mean ({unit})", "95 %", "in r90"], cells))
    return tables


def fibre_loss_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Write the section on fibre loss, from a `fibre_loss.json` or `calibration.json`; none if no fibre failed."""
    methods: Mapping[str, Any] = document.get("methods") or {"": document}
    body = []
    for name, method in methods.items():
        errors = {tuple(row["failed"]): float(row["mean_mm"]) for row in method["by_subset"]}
        if errors.keys() - {()}:  # a fibre has failed in one of the sets
            body += [*([heading(name.capitalize())] if name else []), *_describe_losses(errors)]
    if not body:
        return []
    if "" not in methods:
        rows = [[name, *_error_cells(row)] for name, method in methods.items() for row in method["errors"]]
        picture = (folder / "fibre_loss.png", "Error by number of failed fibres; every dot is a set of them.")
        body = [
            paragraph(f"Errors on {document['test_presses']} presses never trained on, without every set of fibres."),
            table(["method", "failed", "sets", "mean (mm)", "std", "worst"], rows),
            figures([picture]),
            *body,
        ]
    return [PageSection("Fibre loss", body)]


def _describe_losses(errors: Errors) -> Iterator[str]:
    """Describe the errors by set of failed fibres: the worst ones in words, all as tables."""
    # 1. The worst set of each size, in words
    fibres = 1 + max(fibre for failed in errors for fibre in failed)
    counts = sorted({len(failed) for failed in errors} - {0})
    worst_sets = [max((each for each in errors if len(each) == count), key=errors.__getitem__) for count in counts]
    losses = [f"of {_fibre_count(len(each))}, {_names(each)} ({errors[each]:.2f} mm)" for each in worst_sets]
    intact = f" With all fibres the error is {errors[()]:.2f} mm." if () in errors else ""
    yield paragraph(f"The worst loss: {'; '.join(losses)}.{intact}")
    # 2. Errors without one and two fibres, and mean errors without each fibre
    pairs: list[str] = []
    if {1, 2} <= set(counts):
        few = {failed: error for failed, error in errors.items() if len(failed) <= 2}
        caption = (
            "Mean error in mm without two fibres, given by the row and the column; on the diagonal, without one. Darker"
            " is worse."
        )
        pairs = [_loss_table(few, fibres), paragraph(caption)]
    head = ["fibre", *("alone (mm)" if count == 1 else f"with {_fibre_count(count - 1)} more" for count in counts)]

    def mean_with(fibre: int, count: int) -> str:
        values = [error for failed, error in errors.items() if len(failed) == count and fibre in failed]
        return f"{sum(values) / len(values):.2f}" if values else "-"

    rows = [[fibre + 1, *(mean_with(fibre, count) for count in counts)] for fibre in range(fibres)]
    means = [table(head, rows), paragraph("Mean error over the sets of failed fibres that a fibre is in.")]
    yield columns(*([pairs] if pairs else []), means)
    # 3. The ten worst sets
    ranked = sorted(errors.items(), key=lambda item: -item[1])[:10]
    rows = [[_names(failed), f"{error:.2f}"] for failed, error in ranked if failed]
    yield collapsible("The worst sets", [table(["failed", "mean (mm)"], rows)])


def _error_cells(row: Mapping[str, Any], *more: str) -> list[object]:
    return [row["n_failed"], row["subsets"], *(f"{row[name]:.2f}" for name in ("mean_mm", "std_mm", "max_mm", *more))]


def _fibre_count(count: int) -> str:
    return f"{NUMBERS[count - 1] if count <= len(NUMBERS) else count} fibre{'s' if count > 1 else ''}"


def _names(failed: Sequence[int]) -> str:
    *first, last = (str(fibre + 1) for fibre in failed)
    return f"{', '.join(first)} and {last}" if first else last


def _loss_table(errors: Errors, fibres: int) -> str:
    """Write a triangle: the error without one fibre on its diagonal, without two below it; darker is worse."""
    low, high = min(errors.values()), max(errors.values())
    # row and column in the table, whose first column has the numbers of the fibres
    cells = {(failed[-1], failed[0] + 1): error for failed, error in errors.items() if failed}
    numbers = range(1, fibres + 1)
    rows = [
        [row + 1, *(f"{cells[row, column]:.2f}" if (row, column) in cells else "" for column in numbers)]
        for row in range(fibres)
    ]
    shades = {cell: (error - low) / ((high - low) or 1.0) for cell, error in cells.items()}
    return table(["", *map(str, numbers)], rows, shades)


def find_studies(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the studies in `folder` and its folder `studies`, by path; InputError for a .json that cannot be read."""
    paths = sorted([*folder.glob("[!.]*.json"), *(folder / "studies").glob("[!.]*.json")])
    for path in filter(Path.is_file, paths):
        content = read_bytes(path)
        try:
            document = json.loads(content.decode())
        except ValueError as error:
            raise InputError(f"{path}: not a JSON file ({error})") from error
        if isinstance(document, dict) and str(document.get("format")).startswith("padforge-study-"):
            yield path, document


def study_pieces(path: Path, document: Mapping[str, Any]) -> list[str]:
    """Write the HTML of a study: its text, the figure NAME.png beside NAME.json, if it is there, and its table."""
    title, text, rows = document["title"], document["text"], document["rows"]
    return [
        heading(title),
        *map(paragraph, text),
        figures([(path.with_suffix(".png"), title)]),
        *([table(list(rows[0]), [list(row.values()) for row in rows])] if rows else []),
    ]
