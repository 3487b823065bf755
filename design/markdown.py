"""The little Markdown that padforge writes, as HTML for its pages."""

import re
from collections.abc import Iterator
from html import escape

from .page import heading, table

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
