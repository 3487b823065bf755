"""Notebooks are those of their pages, and run."""

from pathlib import Path

import nbformat
import pytest

from docs import notebooks


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


@pytest.mark.slow
def test_notebooks_run(tmp_path: Path) -> None:
    """One after another, in one folder."""
    for page in notebooks.PAGES:
        notebooks.run_notebook(notebooks.make_notebook(page), tmp_path)
    assert (tmp_path / "out" / "pad" / "calibration.json").is_file()
