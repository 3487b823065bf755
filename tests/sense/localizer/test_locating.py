"""Places as CSV: every press has its line, with how sure it is."""

from pathlib import Path

import numpy as np
import pytest

from design.common.errors import InputError
from sense.localizer.localizer import Found, Measured
from sense.localizer.locating import write_places

FOUND = Found(
    np.array([[1.23456, -2.0], [0.0, 3.5]]), np.array([[0.5, 0.25], [1.0, 2.0]]), np.array([0.4, 1.5]), np.ones(2) * 3
)


def test_places_are_written_one_line_a_press(tmp_path: Path) -> None:
    write_places(FOUND, tmp_path / "places.csv")
    assert (tmp_path / "places.csv").read_text().splitlines() == [
        "press,x_mm,y_mm,sd_x_mm,sd_y_mm,r50_mm,r90_mm",
        "0,1.2346,-2.0000,0.5000,0.2500,0.4000,3.0000",
        "1,0.0000,3.5000,1.0000,2.0000,1.5000,3.0000",
    ]


def test_a_folder_in_the_way_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_places(FOUND, tmp_path)


def test_depth_and_force_have_columns_where_they_were_learnt(tmp_path: Path) -> None:
    measures = {"depth_mm": Measured(np.array([1.25]), np.array([0.5])), "force_n": Measured(np.ones(1), np.ones(1))}
    one = Found(FOUND.places_mm[:1], FOUND.sd_mm[:1], FOUND.r50_mm[:1], FOUND.r90_mm[:1], measures)
    write_places(one, tmp_path / "places.csv")
    header, line = (tmp_path / "places.csv").read_text().splitlines()
    assert header.endswith("r90_mm,depth_mm,depth_r90_mm,force_n,force_r90_n")
    assert line.endswith(",1.2500,0.5000,1.0000,1.0000")
