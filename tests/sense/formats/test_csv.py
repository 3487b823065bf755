"""Recordings from and to CSV."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.sense import Recording, export_csv, import_csv


def lines(rows: list[str], header: str = "time_s,a,b,x_mm,y_mm") -> str:
    return "\n".join([header, *rows]) + "\n"


@pytest.mark.parametrize("header", ["time_s,a,b,c,d", "time_s,a,b,c,d,x_mm,y_mm"])
def test_import_csv_detects_presses_without_positions(recording: Recording, tmp_path: Path, header: str) -> None:
    table = np.column_stack([recording.times_s, recording.readings])
    end = ",," if "x_mm" in header else ""
    rows = [",".join(map(str, row)) + end for row in table[:1000].tolist()]
    (tmp_path / "r.csv").write_text(lines(rows, header))
    detected = import_csv(tmp_path / "r.csv")
    assert not detected.has_position.any()
    assert len(detected.down_command) == 25
    assert np.abs(detected.down_command - recording.down_command[:25]).max() <= 3
    export_csv(detected, tmp_path / "again.csv")
    assert import_csv(tmp_path / "again.csv") == detected


MEASURED = ("depth_mm", "reached_mm", "force_n")


def test_export_csv_round_trip_and_columns_of_measures(brief: Recording, tmp_path: Path) -> None:
    count = len(brief.down_command)
    forces = np.where(np.arange(count) < 9, np.nan, 2.5)
    for change, columns in (
        ({"depths_mm": np.empty(0)}, []),
        ({"depths_mm": np.full(count, 5.0)}, ["depth_mm"]),
        ({"depths_mm": np.full(count, 5.0), "reached_mm": np.linspace(4, 5, count), "forces_n": forces}, [*MEASURED]),
    ):
        changed = replace(brief, **change)
        export_csv(changed, tmp_path / "r.csv")
        with (tmp_path / "r.csv").open() as file:
            assert file.readline().strip().split(",")[7:] == columns
        assert import_csv(tmp_path / "r.csv") == changed
