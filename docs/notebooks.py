"""Make notebooks of their scripts, with what the cells print and draw: `python docs/notebooks.py`.

A script has a cell after each line `# %%`, and text, in comments, after `# %% [markdown]`, as editors know them.
"""

import os
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent / "notebooks"
SCRIPTS = ("pad",)
TIMEOUT_S = 600
_METADATA = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}


def make_notebook(script: str) -> Any:
    """Convert a script, without running it."""
    cells = []
    for text in re.split(r"^# %% ?", (FOLDER / f"{script}.py").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        kind, _, body = text.partition("\n")
        body = body.strip()
        is_text = kind == "[markdown]"
        cell = nbformat.v4.new_markdown_cell(re.sub(r"^# ?", "", body, flags=re.MULTILINE)) if is_text else None
        cells.append(cell or nbformat.v4.new_code_cell(body))
        cells[-1].id = f"cell-{len(cells)}"
    return nbformat.v4.new_notebook(cells=cells, metadata=_METADATA)


def run_notebook(notebook: Any, folder: Path) -> None:
    """Run a notebook in a folder; raises nbclient.exceptions.CellExecutionError where a cell fails."""
    client = NotebookClient(
        notebook,
        timeout=TIMEOUT_S,
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env=os.environ | {"TTY_COMPATIBLE": "0"})  # no progress bars


if __name__ == "__main__":
    for script in SCRIPTS:
        made = make_notebook(script)
        with TemporaryDirectory() as name:
            run_notebook(made, Path(name))
        nbformat.write(made, FOLDER / f"{script}.ipynb")
        print(FOLDER / f"{script}.ipynb")
