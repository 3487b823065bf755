"""Notebooks are those of their pages, and run."""

import shutil
from pathlib import Path

import nbformat
import pytest

from docs import notebooks
from tests.docs.test_tutorials import followed
from tests.helpers.once import Once


@pytest.mark.parametrize("page", notebooks.PAGES)
def test_notebook_is_that_of_its_page(page: str) -> None:
    """`python docs/notebooks.py` makes them anew; each shows what its commands print, and a figure."""
    stored = nbformat.read(notebooks.FOLDER / f"{page}.ipynb", as_version=4)
    made = notebooks.make_notebook(page)
    assert [(cell.cell_type, cell.source) for cell in stored.cells] == [
        (cell.cell_type, cell.source) for cell in made.cells
    ]
    outputs = [output for cell in stored.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert all(output.output_type != "error" for output in outputs)
    assert "padforge: " not in "".join(output.get("text", "") for output in outputs)  # how a command says what is wrong


@pytest.mark.slow
@pytest.mark.parametrize("page", notebooks.PAGES)
def test_notebook_runs_in_the_folder_of_its_page(page: str, once: Once, tmp_path: Path) -> None:
    """Its commands are those of the page, which `test_tutorials.py` runs: here their cells only call padforge."""
    folder = shutil.copytree(followed(page, once)[0], tmp_path / "followed")
    notebook = notebooks.make_notebook(page)
    commands = [cell for cell in notebook.cells if cell.source.startswith("!")]
    for cell in commands:
        cell.source = "!padforge --version"
    notebooks.run_notebook(notebook, folder)
    assert [cell.outputs[0].text.split(",")[0] for cell in commands] == ["padforge"] * len(commands)
    shown = [output.data for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    assert shown
    assert all("image/png" in data for data in shown)
