"""Self-contained HTML pages: pictures inlined, no network, readable on a phone and on paper."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

_TYPES = {".png": "image/png", ".svg": "image/svg+xml"}

_STYLE = """
:root { --ink: #37352f; --soft: #787774; --line: #e3e2de; --good: #2b7a4b; --bad: #c4161c; --warn: #a15c07 }
* { box-sizing: border-box }
body { margin: 0 auto; max-width: 68rem; padding: 1.5rem; color: var(--ink); background: #fff;
  font: 16px/1.55 system-ui, sans-serif }
h1 { font-size: 1.8rem; margin: .5rem 0 0 }
h2 { font-size: 1.25rem; margin: 2.5rem 0 .75rem; padding-top: 1rem; border-top: 1px solid var(--line) }
p { max-width: 46rem }
.lead, figcaption { color: var(--soft) }
.tiles, .figures { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)) }
.figures { grid-template-columns: repeat(auto-fit, minmax(18rem, 1fr)) }
.tile { border: 1px solid var(--line); border-radius: .5rem; padding: .75rem 1rem }
.tile b { display: block; font-size: 1.5rem }
figure { margin: 0; break-inside: avoid }
figure img { width: 100%; height: auto }
.scroll { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem }
th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); text-align: left }
.pass { color: var(--good) } .fail { color: var(--bad); font-weight: 600 } .warn { color: var(--warn) }
@media print { body { max-width: none; padding: 0; font-size: 11pt } h2 { break-after: avoid } }
"""


def page(title: str, lead: str, body: Sequence[str]) -> str:
    """A whole HTML document of `body`, pieces made by the functions of this module."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="data:,">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>\n' + "\n".join(body) + "\n</body></html>\n"
    )


def heading(text: str) -> str:
    """A section's heading."""
    return f"<h2>{escape(text)}</h2>"


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def tiles(values: Sequence[tuple[str, str]]) -> str:
    """Key figures side by side, as (value, what it is)."""
    cells = "".join(f'<div class="tile"><b>{escape(value)}</b>{escape(name)}</div>' for value, name in values)
    return f'<div class="tiles">{cells}</div>'


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; cells that say pass, warn or fail are coloured."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    lines = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table></div>'


def figures(pictures: Sequence[tuple[Path, str]]) -> str:
    """Pictures (.png, .svg) side by side with their captions; those whose file is missing are left out."""
    found = [_figure(path, caption) for path, caption in pictures if path.is_file()]
    return f'<div class="figures">{"".join(found)}</div>'


def _figure(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    image = f'<img alt="{escape(caption)}" src="data:{_TYPES[path.suffix]};base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _cell(value: object) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    style = f' class="{text}"' if text in ("pass", "warn", "fail") else ""
    return f"<td{style}>{escape(text)}</td>"
