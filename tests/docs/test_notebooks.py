from pathlib import Path

import nbformat
import pytest

from docs import notebooks

SHORTER = {"steps=100": "steps=5", "epochs=20": "epochs=2", "epochs=3": "epochs=1"}
"""What takes most of the time of the notebook, and what does the same with less."""


@pytest.mark.parametrize("script", notebooks.SCRIPTS)
def test_notebook_is_that_of_its_script(script: str) -> None:
    """`python docs/notebooks.py` makes them anew; each shows figures, and no progress of what it waited for."""
    stored = nbformat.read(notebooks.FOLDER / f"{script}.ipynb", as_version=4)
    made = notebooks.make_notebook(script)
    kept, now = ([(cell.cell_type, cell.source) for cell in each.cells] for each in (stored, made))
    assert kept == now
    outputs = [output for cell in stored.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 4
    assert {output.output_type for output in outputs} <= {"stream", "execute_result", "display_data"}
    assert {output.name for output in outputs if output.output_type == "stream"} == {"stdout"}


@pytest.mark.slow
@pytest.mark.parametrize("script", notebooks.SCRIPTS)
def test_notebook_runs(script: str, tmp_path: Path) -> None:
    """Every cell that printed or drew something does so again, here after a shorter search and training."""
    stored = nbformat.read(notebooks.FOLDER / f"{script}.ipynb", as_version=4)
    notebook = notebooks.make_notebook(script)
    for long, short in SHORTER.items():
        (cell,) = (cell for cell in notebook.cells if long in cell.source)
        cell.source = cell.source.replace(long, short)
    notebooks.run_notebook(notebook, tmp_path)
    kinds = [[output.output_type for output in cell.get("outputs", [])] for cell in notebook.cells]
    assert kinds == [[output.output_type for output in cell.get("outputs", [])] for cell in stored.cells]
