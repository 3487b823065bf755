"""Places found, as CSV: one line a press, with how sure it is."""

from pathlib import Path

import numpy as np

from design.files import write_text
from design.output import writing

from .localizer import Found

COLUMNS = ("press", "x_mm", "y_mm", "sd_x_mm", "sd_y_mm", "r50_mm", "r90_mm")
"""Press, counted from 0; place from the pad's centre; standard deviations; radii that hold 50 % and 90 % of presses."""


def write_places(found: Found, path: str | Path) -> None:
    """Write what was found for Q presses as CSV with the columns `COLUMNS`, atomically.

    Raises:
        InputError: `path` cannot be written.
    """
    table = np.column_stack([found.places_mm, found.sd_mm, found.r50_mm, found.r90_mm])
    lines = [",".join([str(press), *(f"{value:.4f}" for value in row)]) for press, row in enumerate(table.tolist())]
    with writing(Path(path)):
        write_text(Path(path), "\n".join([",".join(COLUMNS), *lines]) + "\n")
