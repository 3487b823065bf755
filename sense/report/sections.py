"""Which lost fibres hurt: the errors without every one and every two fibres, as a drawing that stands in a page.

What a report has to say of how well a pad locates, with all its fibres and without some, and of studies.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from math import isnan
from pathlib import Path
from statistics import median
from typing import Any

from padforge.design.common.files import read_bytes
from padforge.design.common.page import PageSection, collapsible, columns, figures, heading, paragraph, table
from padforge.design.common.plotting import ALARM, INK
from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_FIBRES
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import JOURNAL, read_journal

_CELL = 40
_MOST_NUMBERS = 16
"""With more fibres, cells are too small for numbers to be read on a phone."""
_EVERY = 5
"""So many cells are then between two numbers of fibres."""
_WIDEST = 1.7
"""The drawing is not stretched beyond this."""

Errors = Mapping[tuple[int, ...], float]


def loss_chart(errors: Errors, fibres: int) -> str:
    """An SVG of a triangle: on its diagonal the error without one fibre, below it without two; darker is worse.

    Args:
        errors: mean error, mm, of sets of one and of two lost fibres, by index, ascending, and of none if known.
        fibres: how many there are.
    """
    low, high = min(errors.values()), max(errors.values())
    size = 14 if fibres <= _MOST_NUMBERS else 3 * fibres // 2
    left, top = 2 * size, 6
    side = left + fibres * _CELL + size // 2
    height = top + fibres * _CELL + 4 * size
    shapes = [*_axes(fibres, size, left, top), *_scale(low, high, size, left, height)]
    for lost, error in errors.items():
        if lost:
            at = left + lost[0] * _CELL, top + lost[-1] * _CELL
            shapes += _cell(lost, error, (error - low) / ((high - low) or 1.0), at, fibres <= _MOST_NUMBERS)
    return (
        f'<svg viewBox="0 0 {side} {height}" style="max-width:{_WIDEST * side:.0f}px" role="img"'
        f' aria-label="{escape(_told(errors))}" font-family="system-ui, sans-serif" text-anchor="middle" fill="{INK}">'
        f"{''.join(shapes)}</svg>"
    )


def _cell(lost: Sequence[int], error: float, share: float, at: tuple[int, int], numbered: bool) -> Iterator[str]:
    x, y = at
    names = " and ".join(str(fibre + 1) for fibre in lost)
    yield (
        f'<rect x="{x + 1}" y="{y + 1}" width="{_CELL - 2}" height="{_CELL - 2}" rx="3" fill="{_shade(share)}">'
        f"<title>without {names}: {error:.2f} mm</title></rect>"
    )
    if numbered:
        bold = ' font-weight="700"' if len(lost) == 1 else ""
        colour = f' fill="{INK if share < 0.65 else "#ffffff"}" pointer-events="none"'
        text = f"{error:.2f}" if error < 10 else f"{error:.1f}"
        yield _text(text, x + _CELL / 2, y + _CELL / 2 + 5, 14, bold + colour)


def _axes(fibres: int, size: int, left: int, top: int) -> Iterator[str]:
    for fibre in range(fibres):
        if fibres <= _MOST_NUMBERS or (fibre + 1) % _EVERY == 0:
            middle = (fibre + 0.5) * _CELL
            yield _text(str(fibre + 1), left - 0.7 * size, top + middle + size / 3, size)
            yield _text(str(fibre + 1), left + middle, top + fibres * _CELL + 1.2 * size, size)


def _scale(low: float, high: float, size: int, left: int, height: int) -> Iterator[str]:
    """The colours from the least error to the greatest, in the lower left corner."""
    y = height - 1.4 * size
    yield _text(f"{low:.2f}", left + 1.3 * size, y + 0.9 * size, size)
    for step in range(5):
        x = left + (2.9 + 1.4 * step) * size
        yield f'<rect x="{x:.1f}" y="{y:.1f}" width="{1.4 * size:.1f}" height="{size}" fill="{_shade(step / 4)}"/>'
    yield _text(f"{high:.2f} mm", left + 10.3 * size, y + 0.9 * size, size, ' text-anchor="start"')


def _text(text: str, x: float, y: float, size: int, style: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}"{style}>{text}</text>'


def _shade(share: float) -> str:
    """White for 0, the colour of alarm for 1."""
    pale = 1 - (0.06 + 0.94 * share)
    return "#" + "".join(f"{round(part + pale * (255 - part)):02x}" for part in bytes.fromhex(ALARM[1:]))


def _told(errors: Errors) -> str:
    """What somebody who cannot see it is told."""
    worst = {count: max((lost for lost in errors if len(lost) == count), key=errors.__getitem__) for count in (1, 2)}
    told = (f"worst without {' and '.join(str(i + 1) for i in lost)}: {errors[lost]:.2f} mm" for lost in worst.values())
    return f"Error without one and without two fibres; {'; '.join(told)}."


STUDY = "padforge-study-"
"""Formats of studies begin with this."""
_HARDEST = 10
"""So many sets of lost fibres are listed."""
_COUNTED = ("one fibre", "two fibres", "three fibres")


def recording_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Where the readings of a recording in `folder` came from, by its `start.json`.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
    """
    source = document["source"]
    kind = source.get("kind")
    origin = {"simulated": "the simulated rig", "rig": "a rig", "hand": "presses by hand"}.get(kind) or source.get(
        "file", kind
    )
    origin = f"{origin}, by the twin of a printed pad" if "twin" in source else origin
    rig = source.get("rig", {})
    how = f", {rig['rate_hz']:g} a second" if rig else ""
    if rig and kind != "hand":
        depths = rig.get("depths_mm") or [rig["depth_mm"]]
        deep = f"{min(depths):g} to {max(depths):g}" if len(depths) > 1 else f"{depths[0]:g}"
        how += f"; presses {deep} mm deep"
    body = [paragraph(f"Readings of {document['fibres']} fibres, from {origin}{how}.")]
    return [PageSection("Recording", [*body, *_measures(folder)])]


def recording_digest(folder: Path) -> str | None:
    """Digest of the recording in `folder`, None where there is none that can be read."""
    try:
        return Recording.open(folder / "recording").digest
    except InputError:
        return None


def _measures(folder: Path) -> list[str]:
    """What the journal of the recording in `folder` knows of depth and force, as a table; none where it is silent."""
    journal = folder / "recording" / JOURNAL
    presses = list(read_journal(journal).values()) if journal.is_file() else []
    names = {"depth_mm": "depth commanded (mm)", "reached_mm": "depth reached (mm)", "force_n": "force (N)"}
    known = {text: [x for press in presses if not isnan(x := getattr(press, key))] for key, text in names.items()}
    rows = [
        [text, len(values), f"{min(values):.2f}", f"{median(values):.2f}", f"{max(values):.2f}"]
        for text, values in known.items()
        if values
    ]
    return [table(["", "presses", "least", "median", "most"], rows)] if rows else []


def calibration_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Errors of a `calibration.json` in `folder`, by lost fibres and by place, and how often each fibre is idle.

    Where no `fibre_loss.json` says more, what the loss of which fibres does follows.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: a picture beside it cannot be read.
    """
    rows = document["errors"]
    first, last = rows[0], rows[-1]
    idle = [f"{share:.0%}" for share in document["idle_share"]]
    simulated = document["provenance"].get("recording_kind") == "simulated"
    of = "simulated presses" if simulated else "presses"
    held = {"random": "drawn at random", "chronological": "the last ones"}.get(document["split"], document["split"])
    section = PageSection(
        "Calibration",
        [
            paragraph(
                f"Errors on {document['test_presses']} {of} never trained on ({held})."
                f"{' One network serves every loss.' if len(rows) > 1 else ''} With every place come two radii that"
                " ought to hold it in 50 % and in 90 % of cases."
            ),
            table(
                ["lost", "sets", "mean (mm)", "std", "worst", "median", "95 %", "in r50", "in r90"],
                [
                    _errors(row, "median_mm", "p95_mm") + [f"{row[f'within_r{k}']:.1%}" for k in (50, 90)]
                    for row in rows
                ],
            ),
            *_measure_errors(rows),
            paragraph(
                "Mean, spread and worst are over the sets of lost fibres; median and 95th percentile over all their"
                " presses."
            ),
            figures(
                [
                    (folder / "error_map.png", "Where presses were, and how far off they were found."),
                    (folder / "error_by_loss.png", "Error by number of lost fibres."),
                ]
            ),
            heading("Idle share"),
            paragraph("The share of presses in which a fibre changes by less than 2 % of its range."),
            table(["fibre", *map(str, range(1, len(idle) + 1))], [["idle", *idle]]),
        ],
        [
            (f"{first['mean_mm']:.2f} mm", f"mean error on {of}, " + _lost(first["n_failed"])),
            *(
                [(f"{last['mean_mm']:.2f} mm", f"mean error on {of}, " + _lost(last["n_failed"]))]
                if len(rows) > 1
                else []
            ),
        ],
    )
    return [section, *([] if (folder / "fibre_loss.json").exists() else fibre_loss_sections(folder, document))]


def _measure_errors(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Errors of depth and force, by lost fibres, where these were learnt."""
    out = []
    for kind, unit in (("depth", "mm"), ("force", "N")):
        names = [f"{kind}_{what}_{unit.lower()}" for what in ("mean", "p95")]
        if names[0] in rows[0]:
            numbers = [[row["n_failed"], *(f"{row[name]:.2f}" for name in names)] for row in rows]
            within = [[*line, f"{row[f'{kind}_within_r90']:.1%}"] for line, row in zip(numbers, rows, strict=True)]
            out.append(table(["lost", f"{kind}, mean ({unit})", "95 %", "in r90"], within))
    return out


def fibre_loss_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """What the loss of which fibres does, from a `fibre_loss.json` or `calibration.json`; none if none was lost.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: a picture beside it cannot be read.
    """
    ways: Mapping[str, Any] = document.get("ways") or {"": document}
    found = {
        name: {tuple(each["failed"]): float(each["mean_mm"]) for each in way["by_subset"]} for name, way in ways.items()
    }
    body = []
    for name, errors in found.items():
        if any(errors):
            body += [*([heading(name.capitalize())] if name else []), *_losses(errors)]
    if not body:
        return []
    if "" not in found:
        rows = [[name, *_errors(row)] for name, way in ways.items() for row in way["errors"]]
        head = ["way", "lost", "sets", "mean (mm)", "std", "worst"]
        picture = figures([(folder / "fibre_loss.png", "Error by number of lost fibres; every dot is a set of them.")])
        body = [
            paragraph(f"Errors on {document['test_presses']} presses never trained on, without every set of fibres."),
            table(head, rows),
            picture,
            *body,
        ]
    return [PageSection("Lost fibres", body)]


def find_studies(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Studies in `folder` and in its folder `studies`, by path, with their documents.

    Raises:
        InputError: a .json file among them is none that can be read, so that nobody knows whether it is a study.
    """
    found = sorted([*folder.glob("[!.]*.json"), *(folder / "studies").glob("[!.]*.json")])
    for path in filter(Path.is_file, found):
        content = read_bytes(path)
        try:
            document = json.loads(content.decode())
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not a JSON file ({error})") from error
        if isinstance(document, dict) and str(document.get("format")).startswith(STUDY):
            yield path, document


def study_pieces(path: Path, document: Mapping[str, Any]) -> list[str]:
    """HTML pieces of a study: what it shows in words, its figure if NAME.png lies beside NAME.json, and its table.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: the figure cannot be read.
    """
    title, text, rows = document["title"], document["text"], document["rows"]
    if not isinstance(title, str) or not isinstance(text, list) or not isinstance(rows, list):
        raise TypeError("title, text or rows is of another kind")
    if any(list(row) != list(rows[0]) for row in rows):
        raise ValueError("rows differ in their keys")
    return [
        heading(title),
        *map(paragraph, text),
        figures([(path.with_suffix(".png"), title)]),
        *([table(list(rows[0]), [list(row.values()) for row in rows])] if rows else []),
    ]


def _losses(errors: Errors) -> Iterator[str]:
    """Which sets of lost fibres are worst, in words, as a drawing and as a table."""
    fibres = 1 + max(fibre for lost in errors for fibre in lost)
    if fibres > MAX_FIBRES:
        raise ValueError(f"fibre {fibres} is lost, of at most {MAX_FIBRES}")
    counts = sorted({len(lost) for lost in errors} - {0})
    worst = {count: max((lost for lost in errors if len(lost) == count), key=errors.__getitem__) for count in counts}
    told = [f"of {_count(count)}, {_names(lost)} ({errors[lost]:.2f} mm)" for count, lost in worst.items()]
    whole = f" With all fibres the error is {errors[()]:.2f} mm." if () in errors else ""
    yield paragraph(f"The loss that hurts most: {'; '.join(told)}.{whole}")
    few = {lost: error for lost, error in errors.items() if len(lost) <= 2}
    chart: list[str] = []
    if {1, 2} <= {len(lost) for lost in few}:
        caption = (
            "Mean error in mm without two fibres, given by the row and the column; on the diagonal, without one."
            " Darker is worse."
        )
        chart = [f"<figure>{loss_chart(few, fibres)}<figcaption>{caption}</figcaption></figure>"]
    head = ["fibre", *("alone (mm)" if count == 1 else f"with {_count(count - 1)} more" for count in counts)]
    rows = [[fibre + 1, *(_mean(errors, fibre, count) for count in counts)] for fibre in range(fibres)]
    listed = [table(head, rows), paragraph("Mean error over the sets of lost fibres that a fibre is in.")]
    yield columns(*([chart] if chart else []), listed)
    hardest = sorted(errors.items(), key=lambda each: -each[1])[:_HARDEST]
    rows = [[_names(lost), f"{error:.2f}"] for lost, error in hardest if lost]
    yield collapsible("The sets that hurt most", [table(["lost", "mean (mm)"], rows)])


def _mean(errors: Errors, fibre: int, count: int) -> str:
    found = [error for lost, error in errors.items() if len(lost) == count and fibre in lost]
    return f"{sum(found) / len(found):.2f}" if found else "-"


def _errors(row: Mapping[str, Any], *more: str) -> list[object]:
    names = ("mean_mm", "std_mm", "max_mm", *more)
    return [row["n_failed"], row["subsets"], *(f"{row[name]:.2f}" for name in names)]


def _lost(count: int) -> str:
    return "all fibres" if count == 0 else f"{count} fibre{'s' if count > 1 else ''} lost"


def _count(count: int) -> str:
    return _COUNTED[count - 1] if count <= len(_COUNTED) else f"{count} fibres"


def _names(lost: Sequence[int]) -> str:
    *rest, last = (str(fibre + 1) for fibre in lost)
    return f"{', '.join(rest)} and {last}" if rest else last
