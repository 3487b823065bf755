"""Make notebooks of tutorials, with what their commands print and draw: `python docs/notebooks.py`.

A notebook is its page: blocks after a comment `<!-- run -->` are cells, `<!-- figure: FILE -->` shows a picture that
they wrote, and all else is text. Every notebook runs in the folder that the one before it has left.
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
    r"<!-- run[^\n]*-->\n+```sh\n(?P<commands>.*?)^```$(?:\n+```text\n.*?^```$)?|<!-- figure: (?P<figure>\S+) -->",
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
        show = f'import IPython.display\n\nIPython.display.Image("{match["figure"]}")'
        code = f"%%sh\n{match['commands'].strip()}" if match["commands"] else show
        cells.append(nbformat.v4.new_code_cell(code))
        end = match.end()
    cells.append(nbformat.v4.new_markdown_cell(text[end:].strip()))
    cells = [cell for cell in cells if cell.source]
    for number, cell in enumerate(cells):
        cell.id = f"cell-{number}"
    return nbformat.v4.new_notebook(cells=cells, metadata=_METADATA)


def run_notebook(notebook: Any, folder: Path) -> None:
    """Run a notebook in a folder; raises nbclient.exceptions.CellExecutionError where a command fails."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    client = NotebookClient(
        notebook, timeout=TIMEOUT_S, record_timing=False, resources={"metadata": {"path": str(folder)}}
    )
    client.execute(env=os.environ | {"PATH": path, "COLUMNS": "80"})


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        for page in PAGES:
            made = make_notebook(page)
            run_notebook(made, Path(name))
            nbformat.write(made, FOLDER / f"{page}.ipynb")
            print(FOLDER / f"{page}.ipynb")
