"""Self-contained HTML pages: everything inlined, no network, readable on a phone and on paper."""

import base64
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

from design.common.errors import InputError
from design.common.files import read_bytes

_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}

_MOST_PICTURE = 2**25
"""Bytes of a picture at most: a page holds it as it is."""

_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?( ?%| mm| ml| g)?")
"""What stands flush right in a table."""

_SHORT = 16
"""Columns of cells with no more letters are not wrapped."""

_LONG = 30
"""Words of more letters are broken."""

_CLASSES = ("pass", "warn", "fail", "number", "short", "long")
"""Styles of cells."""


@dataclass(frozen=True)
class PageSection:
    """A part of a page, which its contents line links to.

    Attributes:
        title: its heading, unlike that of any other section of the page.
        body: HTML pieces, made by the functions of this module.
        figures: what the head of the page has of it, as (value, what it is).
        script: JavaScript that runs when the page is there.
    """

    title: str
    body: Sequence[str]
    figures: Sequence[tuple[str, str]] = field(default=())
    script: str = ""

    @property
    def anchor(self) -> str:
        """Its id in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def page(title: str, lead: str, sections: Sequence[PageSection]) -> str:
    """A whole HTML document: title, contents, key figures, sections.

    Nothing is let in from elsewhere, and no script runs but those of the sections and of the page itself.
    """
    scripts = [resource("design.common.page", "page.js"), *(section.script for section in sections if section.script)]
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
        f"script-src {allowed}"
    )
    links = "".join(f'<li><a href="#{section.anchor}">{escape(section.title)}</a></li>' for section in sections)
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light"><link rel="icon" href="data:,">',
            f"<title>{escape(title)}</title><style>\n{resource('design.common.page', 'page.css')}</style></head><body>",
            f'<header><h1>{escape(title)}</h1><p class="lead">{escape(lead)}</p>',
            f'<nav aria-label="Contents"><ul>{links}</ul></nav></header><main>',
            tiles([figure for section in sections for figure in section.figures]),
            *map(_section, sections),
            "</main>",
            *(f"<script>{script}</script>" for script in scripts),
            "</body></html>\n",
        ]
    )


def resource(package: str, name: str) -> str:
    """The text of a file that a package ships."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


def heading(text: str) -> str:
    """A heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def tiles(values: Sequence[tuple[str, str]]) -> str:
    """Key figures side by side, as (value, what it is)."""
    cells = "".join(f'<div class="tile"><b>{escape(value)}</b> {escape(name)}</div>' for value, name in values)
    return f'<div class="tiles">{cells}</div>'


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; cells that say pass, warn or fail are coloured, columns of numbers stand flush right."""
    cells = [[_text(value) for value in row] for row in rows]
    kinds = [_kind(column) for column in zip(*cells, strict=True)] or [""] * len(header)
    head = "".join(
        f'<th scope="col"{_class(kind)}>{escape(name)}</th>' for name, kind in zip(header, kinds, strict=True)
    )
    lines = (
        "".join(f"<td{_class(text, kind)}>{escape(text)}</td>" for text, kind in zip(row, kinds, strict=True))
        for row in cells
    )
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def beside(*columns: Sequence[str]) -> str:
    """Pieces in columns, below each other where there is no room."""
    return f'<div class="columns">{"".join(f"<div>{chr(10).join(column)}</div>" for column in columns)}</div>'


def folded(summary: str, body: Sequence[str]) -> str:
    """Pieces that are seen once `summary` is clicked, and on paper."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(body)}</details>"


def figures(pictures: Sequence[tuple[Path, str]]) -> str:
    """Pictures (.png, .svg) side by side with their captions; those whose file is missing are left out.

    Raises:
        InputError: a file that is no such picture, or is torn.
    """
    found = [_figure(path, caption) for path, caption in pictures if path.is_file()]
    return f'<div class="figures">{"".join(found)}</div>' if found else ""


def _section(section: PageSection) -> str:
    head = f'<h2 id="{section.anchor}">{escape(section.title)}</h2>'
    return f'<section aria-labelledby="{section.anchor}">{head}\n' + "\n".join(section.body) + "</section>"


def _figure(path: Path, caption: str) -> str:
    content = read_bytes(path, _MOST_PICTURE)
    try:
        size = _png_size(path) if path.suffix == ".png" else _svg_size(content)
    except Exception as error:  # readers of broken pictures raise whatever comes
        raise InputError(f"{path}: not a picture that can be read ({error})") from error
    source = f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(content).decode()}"
    image = f'<img alt="{escape(caption)}"{size} src="{source}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _png_size(path: Path) -> str:
    from PIL import Image

    with Image.open(path, formats=["PNG"]) as picture:
        width, height = picture.size
        picture.verify()
    return f' width="{width}" height="{height}"'


def _svg_size(content: bytes) -> str:
    """None: an SVG says its own; but it must be one."""
    ElementTree.fromstring(content)
    return ""


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _kind(column: Sequence[str]) -> str:
    """How the cells of a column are set."""
    if any(column) and all(_NUMBER.fullmatch(text) for text in column if text not in ("", "-")):
        return "number"
    if max(map(len, column)) <= _SHORT:
        return "short"
    return "long" if any(len(word) > _LONG for text in column for word in text.split()) else ""


def _class(*names: str) -> str:
    """The first of the names that stands for a style."""
    known = [name for name in names if name in _CLASSES]
    return f' class="{known[0]}"' if known else ""


_ITEM = re.compile(r"(-|\d+\.) (.*)")

_MARKS = ((re.compile(r"\*\*(.+?)\*\*"), r"<b>\1</b>"), (re.compile(r"`(.+?)`"), r"<code>\1</code>"))


def html_pieces(text: str) -> Iterator[str]:
    """HTML of paragraphs, lists, tables, headings below the title, **bold** and `code`; the title is left out.

    A paragraph and an item of a list are a line each; what is no such mark is text.
    """
    for block in text.strip().split("\n\n"):
        lines = block.strip().split("\n")
        if block.startswith("# "):
            continue
        if block.startswith("## "):
            yield heading(block[3:])
        elif block.startswith("| "):
            head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
            yield table(head, rows)
        elif items := [item for item in map(_ITEM.fullmatch, lines) if item]:
            kind = "ul" if items[0][1] == "-" else "ol"
            yield f"<{kind}>{''.join(f'<li>{_inline(item[2])}</li>' for item in items)}</{kind}>"
        else:
            yield from (f"<p>{_inline(line)}</p>" for line in lines)


def _inline(text: str) -> str:
    text = escape(text)
    for mark, element in _MARKS:
        text = mark.sub(element, text)
    return text
