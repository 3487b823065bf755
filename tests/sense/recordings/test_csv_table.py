"""Recordings as CSV: every number comes back, and other tables are refused."""

from pathlib import Path

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Recording, export_csv, import_csv


def test_csv_gives_back_every_number(recording: Recording, tmp_path: Path) -> None:
    export_csv(recording, tmp_path / "r.csv")
    assert import_csv(tmp_path / "r.csv") == recording


def lines(rows: list[str], header: str = "time_s,a,b,x_mm,y_mm") -> str:
    return "\n".join([header, *rows]) + "\n"


FINE = ["0,1,2,,", "1,1,2,3,4", "2,1,2,3,4", "3,1,2,,", "4,1,2,-1,0", "5,1,2,,"]


def test_a_press_lasts_while_its_place_stands_on_the_line(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text(lines(FINE))
    recording = import_csv(tmp_path / "r.csv")
    assert recording.presses_mm.tolist() == [[3, 4], [-1, 0]]
    assert recording.begun.tolist() == [1, 4]
    assert recording.lifted.tolist() == [3, 5]


def test_unknown_places_and_missing_readings_are_told_by_their_cells(tmp_path: Path) -> None:
    rows = ["0,1,2,,", "1,,2,?,?", "2,nan,2,?,?", "3,1,2,,", "4,1,2,-1,0", "5,1,,,", "6,1,2,?,?", "7,1,2,,", ""]
    (tmp_path / "r.csv").write_text(lines(rows))
    recording = import_csv(tmp_path / "r.csv")
    assert recording.known.tolist() == [False, True, False]
    assert recording.begun.tolist() == [1, 4, 6]
    assert recording.lifted.tolist() == [3, 5, 7]
    assert np.argwhere(np.isnan(recording.readings)).tolist() == [[1, 0], [2, 0], [5, 1]]


@pytest.mark.parametrize("header", ["time_s,a,b,c,d,e,f", "time_s,a,b,c,d,e,f,x_mm,y_mm"])
def test_presses_are_found_where_no_line_has_a_place(recording: Recording, tmp_path: Path, header: str) -> None:
    table = np.column_stack([recording.times_s, recording.readings])
    end = "," * (header.count(",") - recording.fibres)
    names = header.replace("a,b,c,d,e,f", ",".join("abcdefgh"[: recording.fibres]))
    end = ",," if "x_mm" in header else ""
    rows = [",".join(map(str, row)) + end for row in table[:1000].tolist()]
    (tmp_path / "r.csv").write_text(lines(rows, names))
    found = import_csv(tmp_path / "r.csv")
    assert not found.known.any()
    assert len(found.begun) == 25
    assert np.abs(found.begun - recording.begun[:25]).max() <= 3
    export_csv(found, tmp_path / "again.csv")
    assert import_csv(tmp_path / "again.csv") == found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header is 'nothing'"),
        (lines([], "a,b,c"), "header is 'a,b,c', expected time_s"),
        (lines(FINE, "time_s,x_mm,y_mm"), "header is"),
        (lines([]), "readings have shape"),
        (lines(["0,1,2,,", "1,1,2,,", "2,1,2,,"]), "has no press"),
        (lines([*FINE, "6,1,2"]), "line 8 has 3 values, expected 5"),
        (lines([*FINE, "6,1,two,,"]), "line 8 holds no numbers"),
        (lines([*FINE, "6,1,2,3,"]), "line 8 has one of x_mm and y_mm"),
        (lines([*FINE, "6,1,-inf,,"]), r"readings hold infinity.*row 6"),
        (lines([*FINE, "2,1,2,,"]), "do not ascend at reading 6"),
        (lines(FINE[1:]), "press 0 goes from reading 0"),
        (lines([*FINE, "6,1,2,8,8", "7,1,2,9,9"]), "press 3 goes from"),
        (lines([*FINE, "6,1,2,inf,8"]), "presses hold infinity"),
        (lines([*FINE, "6,1,2,?,8"]), "press 2 has one of x and y"),
        (lines([*FINE, "6,?,2,,"]), "line 8 holds no numbers"),
        (lines([*FINE, ",1,2,,"]), r"times hold NaN.*row 6"),
        (lines([*FINE, "6,1,1e999,,"]), r"readings hold infinity.*row 6"),
        (lines([*FINE, "", "6,1,2,,"]), "line 8 has 0 values, expected 5"),
        (lines(["0,1", "1,1"], "time_s,a"), "has no press: no line has x_mm and y_mm, and none is found"),
        (lines(["0,1", "0,1"], "time_s,a"), "do not ascend at reading 1"),
        (lines(["0,,", "1,,"], "time_s,a,b"), "readings are all missing"),
        (lines(["0,1,,1"], "time_s,x_mm,y_mm,a"), "readings have shape"),
        (lines(FINE, "\x00" * 500), r"header is '\\x00.{0,40}', expected time_s"),
    ],
)
def test_other_csv_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        import_csv(tmp_path / "r.csv")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-8"])
def test_csv_may_begin_with_a_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "r.csv").write_text(lines(FINE), encoding=encoding)
    assert import_csv(tmp_path / "r.csv").presses_mm.tolist() == [[3, 4], [-1, 0]]


def test_csv_with_semicolons_is_told_of_commas(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text(lines(FINE).replace(",", ";"))
    with pytest.raises(InputError, match="separated by commas, not by semicolons"):
        import_csv(tmp_path / "r.csv")


@pytest.mark.parametrize(
    ("row", "message"),
    [("6,1,1e30,,", "readings hold 1e"), ("6,1,2,1e200,8", "presses hold 1e"), ("1e300,1,2,,", "times hold 1e")],
)
def test_implausible_numbers_are_refused(tmp_path: Path, row: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(lines([*FINE, row]))
    with pytest.raises(InputError, match=rf"r\.csv: {message}.*allowed is"):
        import_csv(tmp_path / "r.csv")
