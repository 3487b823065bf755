"""Self-contained HTML pages: everything inlined, no network, readable on a phone and on paper.

How they look is in `page.html`, `elements.html` and `page.css`; here is what goes into them.
"""

import base64
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from jinja2 import Environment, PackageLoader, StrictUndefined
from markdown_it import MarkdownIt
from markdown_it.tree import SyntaxTreeNode

from padforge.design.common.files import read_bytes
from padforge.design.common.validation import InputError


def read_resource(package: str, name: str) -> str:
    """The text of a file that a package ships."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


_HERE = "padforge.design.common.templates"
_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}

_MOST_PICTURE = 2**25
"""Bytes of a picture at most: a page holds it as it is."""
_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?( ?%| mm| ml| g)?")
"""What stands flush right in a table."""
_SHORT = 16
"""Columns of cells with no more letters are not wrapped."""
_LONG = 30
"""Words of more letters are broken."""
_VERDICTS = ("pass", "warn", "fail")
"""Cells of these words are coloured."""


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
    scripts = [read_resource(_HERE, "page.js"), *(section.script for section in sections if section.script)]
    content = {
        "title": title,
        "lead": lead,
        "sections": sections,
        "key_figures": [figure for section in sections for figure in section.figures],
        "style": read_resource(_HERE, "page.css"),
        "scripts": scripts,
        "digests": [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts],
    }
    return _templates().get_template("page.html").render(content)


@cache
def _templates() -> Environment:
    return Environment(
        loader=PackageLoader(_HERE, ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _element(kind: str, *content: object) -> str:
    """An element of `elements.html`."""
    elements: Any = _templates().get_template("elements.html").module
    return getattr(elements, kind)(*content)


def heading(text: str) -> str:
    """A heading within a section."""
    return _element("heading", text)


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return _element("paragraph", text)


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; cells that say pass, warn or fail are coloured, columns of numbers stand flush right."""
    cells = [[_text(value) for value in row] for row in rows]
    kinds = [_kind(column) for column in zip(*cells, strict=True)] or [""] * len(header)
    body = [
        [(text, text if text in _VERDICTS else kind) for text, kind in zip(row, kinds, strict=True)] for row in cells
    ]
    return _element("table", list(zip(header, kinds, strict=True)), body)


def columns(*columns: Sequence[str]) -> str:
    """Pieces in columns, below each other where there is no room."""
    return _element("beside", columns)


def collapsible(summary: str, body: Sequence[str]) -> str:
    """Pieces that are seen once `summary` is clicked, and on paper."""
    return _element("folded", summary, body)


def figures(pictures: Sequence[tuple[Path, str]]) -> str:
    """Pictures (.png, .svg) side by side with their captions; those whose file is missing are left out.

    Raises:
        InputError: a file that is no such picture, or is torn.
    """
    found = [_picture(path, caption) for path, caption in pictures if path.is_file()]
    return _element("figures", found) if found else ""


def render_markdown(text: str) -> Iterator[str]:
    """HTML of Markdown: paragraphs, lists, tables, headings, **bold** and `code`; its title is left out.

    What is no such mark is text, HTML too.
    """
    reader = MarkdownIt("zero", {"html": False}).enable(["heading", "list", "table", "emphasis", "backticks"])
    for block in SyntaxTreeNode(reader.parse(text)).children:
        if block.type == "heading":
            if block.tag != "h1":
                yield heading(block.children[0].content)
        elif block.type == "table":
            head, *rows = ([cell.children[0].content for cell in row.children] for part in block for row in part)
            yield table(head, rows)
        else:
            yield reader.renderer.render(block.to_tokens(), reader.options, {})


def _picture(path: Path, caption: str) -> dict[str, Any]:
    from PIL import Image

    content = read_bytes(path, _MOST_PICTURE)
    try:
        size = None  # an SVG says its own; but it must be one
        if path.suffix == ".png":
            with Image.open(path, formats=["PNG"]) as picture:
                size = picture.size
                picture.verify()
        else:
            ElementTree.fromstring(content)
    except Exception as error:  # readers of broken pictures raise whatever comes
        raise InputError(f"{path}: not a picture that can be read ({error})") from error
    source = f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(content).decode()}"
    return {"caption": caption, "size": size, "source": source}


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
