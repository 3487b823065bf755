"""Recordings from and to CSV."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording, export_csv, import_csv


def lines(rows: list[str], header: str = "time_s,a,b,x_mm,y_mm") -> str:
    return "\n".join([header, *rows]) + "\n"


FINE = ["0,1,2,,", "1,1,2,3,4", "2,1,2,3,4", "3,1,2,,", "4,1,2,-1,0", "5,1,2,,"]


def test_import_csv_reads_unknown_positions_and_missing_readings(tmp_path: Path) -> None:
    rows = ["0,1,2,,", "1,,2,?,?", "2,nan,2,?,?", "3,1,2,,", "4,1,2,-1,0", "5,1,,,", "6,1,2,?,?", "7,1,2,,", ""]
    (tmp_path / "r.csv").write_text(lines(rows))
    recording = import_csv(tmp_path / "r.csv")
    np.testing.assert_array_equal(recording.presses_mm, [[np.nan] * 2, [-1, 0], [np.nan] * 2])
    assert recording.down_command.tolist() == [1, 4, 6]
    assert recording.up_command.tolist() == [3, 5, 7]
    assert np.argwhere(np.isnan(recording.readings)).tolist() == [[1, 0], [2, 0], [5, 1]]


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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (lines([*FINE, *["6,1,two,,"] * 4]), "line 8: column 'b' holds no number but 'two'"),
        (lines([*FINE, "# here", "6,1,2,3,"]), "line 9 has one of x_mm and y_mm"),
        (lines([*FINE, *["6,1"] * 4]), "line 8 has 2 values, expected 5"),
        (lines(["0,1", "1,1"], "time_s,a"), "has no press: no position or number tells of one, and none is detected"),
    ],
)
def test_import_csv_refuses_other_tables(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(InputError, match=rf"r\.csv: .*{message}") as refused:
        import_csv(tmp_path / "r.csv")
    assert "\n" not in str(refused.value)


LAB = """# bench 2
t_ms;ch1;ch2;note;px;py;contact;f
0;1000,5;2000;begin;1,5;2;0;0
100;1001;2000;;1,5;2;1;200
200;;2000;loud;1,5;2;1;250
300;1000;2000;;-0,5;2;0;0
400;1000;2000;;-0,5;2;1;500
500;1000;2000;end;-0,5;2;0;0
"""


def test_import_csv_by_columns(tmp_path: Path) -> None:
    (tmp_path / "lab.csv").write_text(LAB)
    mapping = "time=t_ms:ms,fibres=ch*:mV,x=px:cm,y=py:cm,press=contact,force=f:mN"
    recording = import_csv(tmp_path / "lab.csv", mapping)
    np.testing.assert_allclose(recording.times_s, np.arange(6) / 10)
    np.testing.assert_allclose(recording.readings[:, 0], [1.0005, 1.001, np.nan, 1, 1, 1])
    assert recording.presses_mm.tolist() == [[15, 20], [-5, 20]]
    assert recording.forces_n.tolist() == [0.25, 0.5]
    assert np.isnan(recording.depths_mm).all()
    assert (recording.down_command.tolist(), recording.up_command.tolist()) == ([1, 4], [3, 5])
    names = {"fibre_names": ["ch1", "ch2"]}
    assert recording.source == {"kind": "csv", "file": "lab.csv", "columns": mapping, **names}


def test_import_csv_by_names_with_separators(tmp_path: Path) -> None:
    rows = ["0,1,,,12:30", "1,1,?,?,1_0", "2,1,,,?", "3,1,2,-1,", "4,1,,,"]
    (tmp_path / "lab.csv").write_text("\n".join(['"t;s;x","a;b",px,py,note', *rows]) + "\n")
    for unit, value in (("cm", 10.0), ("um", 1e-3)):
        recording = import_csv(tmp_path / "lab.csv", f"time=t;s;x,fibres=a;b,x=px:{unit},y=py:{unit}")
        np.testing.assert_allclose(recording.presses_mm, [[np.nan, np.nan], [2 * value, -value]])


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


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text.replace(",", ";").replace("-1", "-1,0"),
        lambda text: "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.split()),
        lambda text: text.replace(",", " , ").replace("\n", "\r\n") + "\r\n\r\n",
        lambda text: "# of a probe\n\n# 2024, spring; warm\n" + text.replace("\n3", "\n# knocked at\n\n3"),
        lambda text: "# by hand\n#" + text.replace(",", "\t").replace("-1", "-1e0"),
    ],
)
def test_import_csv_reads_tables_of_other_programs(tmp_path: Path, change) -> None:
    (tmp_path / "plain.csv").write_text(lines(FINE))
    (tmp_path / "r.csv").write_text(change(lines(FINE)), encoding="utf-8", newline="")
    assert import_csv(tmp_path / "r.csv") == import_csv(tmp_path / "plain.csv")


def test_import_csv_counts_ambiguous_numbers_as_missing(tmp_path: Path) -> None:
    for cell in ("1_0", "1 2", "1e", "?"):
        (tmp_path / "r.csv").write_text(lines([*FINE[:2], f"2,1,{cell},3,4", *FINE[3:]]))
        recording = import_csv(tmp_path / "r.csv")
        assert np.argwhere(np.isnan(recording.readings)).tolist() == [[2, 1]]
        assert recording.source["note"] == f"line 4 is a value missing: column 'b' holds no number but {cell!r}"
