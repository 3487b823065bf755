"""Make notebooks of tutorials, with what their commands print and draw: `python docs/notebooks.py`.

A notebook is its page: blocks with a title are cells that write a file, blocks after a comment `<!-- run -->` are cells
that run commands, `<!-- figure: FILE -->` shows a picture that these wrote, and all else is text. Every notebook runs
in the folder that the one before it has left.
"""

import os
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from nbclient import NotebookClient

DOCS = Path(__file__).resolve().parent
FOLDER = DOCS / "notebooks"
PAGES = ("tutorial-design", "tutorial-sense")
TIMEOUT_S = 600
_CELL = re.compile(
    r"^```\w+ title=\"(?P<file>[^\"\n]+)\"\n(?P<lines>.*?)^```$"
    r"|<!-- run[^\n]*-->\n+```sh\n(?P<commands>.*?)^```$(?:\n+```text\n.*?^```$)?"
    r"|<!-- figure: (?P<figure>\S+) -->",
    re.MULTILINE | re.DOTALL,
)
_LINK = re.compile(r"(\]\()(?!\w+:|#)")
_METADATA = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}


def make_notebook(page: str) -> Any:
    """Convert a page, without running it."""
    text = _LINK.sub(r"\1../", (DOCS / f"{page}.md").read_text(encoding="utf-8"))
    cells, end = [], 0
    for match in _CELL.finditer(text):
        cells.append(nbformat.v4.new_markdown_cell(text[end : match.start()].strip()))
        cells.append(nbformat.v4.new_code_cell(_make_code(match)))
        end = match.end()
    cells.append(nbformat.v4.new_markdown_cell(text[end:].strip()))
    cells = [cell for cell in cells if cell.source]
    for number, cell in enumerate(cells):
        cell.id = f"cell-{number}"
    return nbformat.v4.new_notebook(cells=cells, metadata=_METADATA)


def _make_code(match: re.Match[str]) -> str:
    """Return the code of a cell, which IPython runs alike on all systems."""
    if match["file"]:
        return f"%%writefile {match['file']}\n{match['lines'].rstrip()}"
    if match["commands"]:
        return "\n".join(f"!{line}" for line in match["commands"].replace("\\\n", " ").splitlines())
    return f'import IPython.display\n\nIPython.display.Image("{match["figure"]}")'


def run_notebook(notebook: Any, folder: Path) -> None:
    """Run a notebook in a folder; raises nbclient.exceptions.CellExecutionError where a cell fails."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    client = NotebookClient(
        notebook,
        timeout=TIMEOUT_S,
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env=os.environ | {"PATH": path, "COLUMNS": "80", "TTY_COMPATIBLE": "0"})  # no progress bars
    for output in (output for cell in notebook.cells for output in cell.get("outputs", [])):
        if output.output_type == "stream":
            output.text = output.text.replace("\r\n", "\n")  # of a terminal


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        for page in PAGES:
            made = make_notebook(page)
            run_notebook(made, Path(name))
            nbformat.write(made, FOLDER / f"{page}.ipynb")
            print(FOLDER / f"{page}.ipynb")
