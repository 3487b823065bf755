"""Whole outputs are kept in `tests/golden` and compared; `pytest --renew` writes them as they are now.

What a person or a program reads is kept as text, so that a reviewer reads the difference: printed lines, JSON, CSV and
Markdown as they are, a page as its words and tables (`page_text`), a figure as what it shows (`figure_text`).
"""

import difflib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lxml.html
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Annotation

FOLDER = Path(__file__).parents[1] / "golden"

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\d)", re.IGNORECASE)
DIGEST = re.compile(r"\b[0-9a-f]{64}\b")
TIME = re.compile(r"\b\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|[+-]\d\d:\d\d)?")
ROUNDING = 0.08  # relative difference that rounding may make: 0.14 may be 0.13, but 0.1 is not 0.2
MANY_DIGITS = 8  # from here on the last digits are those of a processor
MAX_VALUES = 12  # of a list or table of JSON on one line


class Golden:
    """Compares outputs, which may state the path of a folder, with those that are kept, or renews these."""

    def __init__(self, folder: Path, renew: bool) -> None:
        self._folder, self._renew = folder, renew

    def __call__(self, name: str, output: Any, *, forget: Iterable[str] = (), rtol: float = 1e-6) -> None:
        """Compare an output with the one that is kept.

        Words must be the same. Numbers may differ by one in the last decimal that is printed, if that is at most
        `ROUNDING` of them, or by `rtol`; whole numbers by `rtol` alone. Digests, times of the day and the test's folder
        are left out.

        Args:
            name: of the file in `tests/golden`, as "design/score.txt".
            output: a text, a figure, or what JSON can hold.
            forget: regular expressions of what else differs from run to run, such as seconds.
            rtol: relative tolerance of numbers: more than the default for what was trained.
        """
        if isinstance(output, Figure):
            output = figure_text(output)
        text = output if isinstance(output, str) else json.dumps(output, indent=1, ensure_ascii=False, default=_plain)
        text = TIME.sub("<time>", DIGEST.sub("<digest>", text.replace(str(self._folder), "<folder>")))
        for pattern in forget:
            text = re.sub(pattern, "<differs>", text)

        file = FOLDER / name
        kept = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        lines = settle([line.rstrip() for line in text.splitlines()], kept, rtol)
        if self._renew and lines != kept:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
        elif lines != kept:
            difference = list(difflib.unified_diff(kept, lines, f"kept {name}", "now", lineterm="", n=1))
            pytest.fail("\n".join([*difference[:80], "(pytest --renew keeps what is now)"]), pytrace=False)


def settle(lines: list[str], kept: list[str], rtol: float) -> list[str]:
    """Lines, with those that are close enough to a kept one as they are kept."""
    settled = list(lines)
    words = [[NUMBER.sub("#", line) for line in text] for text in (kept, lines)]
    for i, j, size in difflib.SequenceMatcher(None, *words, autojunk=False).get_matching_blocks():
        for k in range(size):
            if _same_line(lines[j + k], kept[i + k], rtol):
                settled[j + k] = kept[i + k]
    return settled


def _same_line(new: str, old: str, rtol: float) -> bool:
    if new == old:
        return True
    if NUMBER.split(new) != NUMBER.split(old):
        return False
    return all(_same_number(a, b, rtol) for a, b in zip(NUMBER.findall(new), NUMBER.findall(old), strict=True))


def _same_number(a: str, b: str, rtol: float) -> bool:
    difference, largest = abs(float(a) - float(b)), max(abs(float(a)), abs(float(b)))
    mantissas = [re.split("[eE]", number)[0] for number in (a, b)]
    decimals = [len(mantissa.partition(".")[2]) for mantissa in mantissas]
    if max(decimals) >= MANY_DIGITS:  # as computers write numbers, of which rounding leaves any number of digits
        return difference <= max(rtol * largest, 1e-12)
    exponent = int(re.split("[eE]", a)[1]) if "e" in a.lower() else 0
    last = 1.001 * 10.0 ** (exponent - decimals[0]) if decimals[0] else 0.0
    return decimals[0] == decimals[1] and difference <= max(rtol * largest, min(last, ROUNDING * largest), 1e-12)


def _plain(value: Any) -> Any:
    """What JSON can hold of an array or a number of NumPy."""
    return value.tolist()


def json_text(document: Any, indent: str = "") -> str:
    """JSON with a line for each list or table of at most `MAX_VALUES` values, and a line a member of longer ones.

    Lines break by the numbers of values alone, so that no digit more or less moves one.
    """
    document = document if indent else json.loads(json.dumps(document, default=_plain))
    if _size(document) <= MAX_VALUES:
        return json.dumps(document, ensure_ascii=False)
    is_table = isinstance(document, dict)
    names = [f"{json.dumps(name)}: " if is_table else "" for name in document]
    members = document.values() if is_table else document
    lines = [f"{indent} {name}{json_text(part, indent + ' ')}" for name, part in zip(names, members, strict=True)]
    begin, end = "{}" if is_table else "[]"
    return f"{begin}\n" + ",\n".join(lines) + f"\n{indent}{end}"


def _size(document: Any) -> int:
    members = document.values() if isinstance(document, dict) else document
    return sum(map(_size, members)) if isinstance(document, dict | list) else 1


def page_text(page: str) -> str:
    """The words of a HTML page as a reader meets them: headings, paragraphs, tables by row, and what pictures hold."""
    root, lines = lxml.html.fromstring(page), []
    for element in root.iter():
        if not isinstance(element.tag, str):
            continue
        tag, words = element.tag, " ".join(element.text_content().split())
        if tag in ("h1", "h2", "h3", "h4"):
            lines.append(f"{'#' * int(tag[1])} {words}")
        elif tag == "tr":
            lines.append(" | ".join(" ".join(cell.text_content().split()) for cell in element))
        elif tag in ("p", "li", "pre", "summary", "figcaption", "button", "label", "title") and words:
            lines.append(f"{tag}: {words}")
        elif tag == "div" and element.get("class") == "tile":
            lines.append(f"tile: {words}")
        elif tag == "img":
            lines.append(f"img: {element.get('alt')}")
        elif tag == "svg":
            parts = sorted({child.tag for child in element.iter() if isinstance(child.tag, str)})
            counts = ", ".join(f"{len(element.findall(f'.//{part}'))} {part}" for part in parts if part != "svg")
            lines.append(f"svg: {element.get('viewbox') or element.get('viewBox')} {counts}")
        elif tag == "a" and element.get("href", "").startswith(("#", "http")):
            lines.append(f"a: {words} -> {element.get('href')}")
    return "\n".join(lines)


def figure_text(figure: Figure) -> str:
    """What a figure shows: titles, axes, limits, and the data and colours of lines, marks, images and texts."""
    lines = [f"figure {figure.get_figwidth():.3g} x {figure.get_figheight():.3g} in: {figure.get_suptitle()!r}"]
    lines += [f"text {text.get_text()!r}" for text in figure.texts if text.get_text() != figure.get_suptitle()]
    lines += [f"legend {_legend_text(legend)}" for legend in figure.legends]
    for axes in figure.axes:
        title = axes.get_title() or axes.get_title(loc="left")
        limits = f"x {_numbers(axes.get_xlim())} {axes.get_xscale()}, y {_numbers(axes.get_ylim())} {axes.get_yscale()}"
        lines.append(f"axes {title!r}: {axes.get_xlabel()!r}, {axes.get_ylabel()!r}; {limits}")
        for name in ("x", "y"):
            ticks = [label.get_text() for label in getattr(axes, f"get_{name}ticklabels")()]
            if any(ticks) and axes.axison:
                lines.append(f"  {name} ticks {' '.join(ticks)}")
        for line in axes.lines:
            xy = np.asarray(line.get_xydata(), dtype=float)
            colour = line.get_markeredgecolor() if line.get_linestyle() == "None" else line.get_color()
            style = f"{to_hex(colour)} {line.get_linestyle()} {line.get_marker()}"
            lines.append(f"  line {line.get_label()!r} {style}: {_summary(xy)}")
        for collection in axes.collections:
            data = collection.get_offsets()
            if np.size(data) <= 2:
                data = np.concatenate([np.empty((0, 2)), *(path.vertices for path in collection.get_paths())])
            values = collection.get_array()
            shown = "" if values is None else f", {collection.get_cmap().name} {_numbers(collection.get_clim())}: "
            shown += "" if values is None else _summary(np.asarray(values, dtype=float).reshape(-1, 1))
            shades: Any = collection.get_facecolor() if values is None else []
            faces = sorted({to_hex(shade) for shade in shades})
            kind = type(collection).__name__
            lines.append(f"  {kind} {collection.get_label()!r} {' '.join(faces)}: {_summary(data)}{shown}")
        for image in axes.images:
            values = np.asarray(image.get_array(), dtype=float)
            extent = f"{_numbers(image.get_extent())} {image.get_cmap().name} {_numbers(image.get_clim())}"
            lines.append(f"  image {values.shape} {extent}: {_summary(values.reshape(-1, 1))}")
        alphas = [patch.get_alpha() or 1.0 for patch in axes.patches]
        for patch, alpha in zip(axes.patches, alphas, strict=True):
            corners = patch.get_patch_transform().transform_path(patch.get_path()).vertices
            shade = to_hex(patch.get_facecolor()) + (f" alpha {alpha:.2g}" if len(set(alphas)) > 1 else "")
            lines.append(f"  {type(patch).__name__} {shade}: {_summary(corners)}")
        for text in axes.texts:
            place = text.xy if isinstance(text, Annotation) else text.get_position()
            lines.append(f"  text {text.get_text()!r} at {_numbers(place)}")
        if legend := axes.get_legend():
            lines.append(f"  legend {[text.get_text() for text in legend.get_texts()]}")
    return "\n".join(lines)


def _legend_text(legend: Any) -> list[str]:
    """The entries of a figure's legend with the colours of their signs."""
    entries = []
    for text, sign in zip(legend.get_texts(), legend.legend_handles, strict=True):
        colour = sign.get_facecolor() if hasattr(sign, "get_facecolor") else sign.get_markeredgecolor()
        if not len(colour):  # lines of error bars have no faces
            colour = sign.get_edgecolor()
        entries.append(f"{text.get_text()} {to_hex(colour)}")
    return entries


def _summary(data: Any) -> str:
    """The number of rows, and of each column first, last, least, mean and greatest values."""
    data = np.asarray(np.ma.filled(data, np.nan), dtype=float)
    if not data.size or not np.isfinite(data).any():
        return f"{len(data)} rows"
    parts = [data[0], data[-1], np.nanmin(data, axis=0), np.nanmean(data, axis=0), np.nanmax(data, axis=0)]
    return f"{len(data)} rows, " + " | ".join(_numbers(part) for part in parts)


def _numbers(values: Any) -> str:
    return " ".join(f"{value:#.4g}" for value in np.ravel(np.asarray(values, dtype=float)) + 0.0)
