"""Self-contained HTML pages, without network access, readable on a phone and on paper.

Their layout is in the templates `page.html`, `elements.html` and `page.css`.
"""

import base64
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.common.files import read_bytes

if TYPE_CHECKING:
    from jinja2 import Environment


def read_resource(package: str, name: str) -> str:
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


TEMPLATES = "padforge.common.templates"
_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}
_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?( ?%| mm| ml| g)?")  # right-aligned in a table


@dataclass(frozen=True)
class PageSection:
    """A section of a page, listed in its contents."""

    title: str  # heading, unique in the page
    body: Sequence[str]  # HTML elements, made by the functions of this module
    figures: Sequence[tuple[str, str]] = ()  # key figures for the head of the page, as (value, description)
    script: str = ""  # JavaScript that runs once the page is loaded

    @property
    def anchor(self) -> str:
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def page(title: str, lead: str, sections: Sequence[PageSection]) -> str:
    """Return an HTML document: title, first paragraph, contents, key figures, sections.

    Its content security policy forbids content from elsewhere, and scripts other than its own.
    """
    scripts = [read_resource(TEMPLATES, "page.js"), *(section.script for section in sections if section.script)]
    return (
        _templates()
        .get_template("page.html")
        .render(
            title=title,
            lead=lead,
            sections=sections,
            key_figures=[figure for section in sections for figure in section.figures],
            style=read_resource(TEMPLATES, "page.css"),
            scripts=scripts,
            digests=[base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts],
        )
    )


@cache
def _templates() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    lines = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    return Environment(loader=PackageLoader(TEMPLATES, ""), autoescape=True, undefined=StrictUndefined, **lines)


def _element(kind: str, *content: object) -> str:
    """Render a macro of `elements.html`."""
    elements: Any = _templates().get_template("elements.html").module
    return getattr(elements, kind)(*content)


def heading(text: str) -> str:
    return _element("heading", text)


def paragraph(text: str) -> str:
    return _element("paragraph", text)


def table(
    header: Sequence[str], rows: Sequence[Sequence[object]], shades: Mapping[tuple[int, int], float] | None = None
) -> str:
    """Return a table; the words pass, warn and fail are coloured, columns of numbers right-aligned.

    Of `shades`, cells by row and column have a background from white at 0 to red at 1.
    """
    cells = [[cell_text(value) for value in row] for row in rows]
    kinds = [_column_style(column) for column in zip(*cells, strict=True)] or [""] * len(header)
    body = [
        [
            (text, text if text in ("pass", "warn", "fail") else kind, (shades or {}).get((i, j)))
            for j, (text, kind) in enumerate(zip(row, kinds, strict=True))
        ]
        for i, row in enumerate(cells)
    ]
    return _element("table", list(zip(header, kinds, strict=True)), body)


def columns(*columns: Sequence[str]) -> str:
    """Return elements in columns, which stack on a narrow screen."""
    return _element("columns", columns)


def collapsible(summary: str, body: Sequence[str]) -> str:
    """Return elements that are visible after a click on `summary`, and on paper."""
    return _element("collapsible", summary, body)


def figures(pictures: Sequence[tuple[Path, str]]) -> str:
    """Return .png and .svg pictures side by side with their captions; skip missing files."""
    embedded = [_embed_picture(path, caption) for path, caption in pictures if path.is_file()]
    return _element("figures", embedded) if embedded else ""


def render_markdown(text: str) -> Iterator[str]:
    """Convert Markdown to HTML elements, without its title (level 1).

    It supports paragraphs, lists, tables, headings, **bold** and `code`; everything else, including HTML, is text.
    """
    from markdown_it import MarkdownIt
    from markdown_it.tree import SyntaxTreeNode

    reader = MarkdownIt("zero", {"html": False}).enable(["heading", "list", "table", "emphasis", "backticks"])
    for block in SyntaxTreeNode(reader.parse(text)).children:
        if block.type == "heading":
            if block.tag != "h1":
                yield heading(block.children[0].content)
        elif block.type == "table":
            head, *rows = ([cell.children[0].content for cell in row.children] for group in block for row in group)
            yield table(head, rows)
        else:
            yield reader.renderer.render(block.to_tokens(), reader.options, {})


def _embed_picture(path: Path, caption: str) -> dict[str, Any]:
    from PIL import Image

    content = read_bytes(path)
    size = None  # an SVG states its size
    if path.suffix == ".png":
        with Image.open(path) as picture:
            size = picture.size
    source = f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(content).decode()}"
    return {"caption": caption, "size": size, "source": source}


def cell_text(value: object) -> str:
    """Return a value as tables show it: "-" for None, numbers with four digits."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _column_style(column: Sequence[str]) -> str:
    """Return the CSS class of the cells of a column."""
    if any(column) and all(_NUMBER.fullmatch(text) for text in column if text not in ("", "-")):
        return "number"
    if max(map(len, column)) <= 16:  # not wrapped
        return "short"
    return "long" if any(len(word) > 30 for text in column for word in text.split()) else ""  # such words are broken
