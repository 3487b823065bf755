"""Recordings as CSV: every number comes back, and other tables are refused."""

from dataclasses import replace
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
        (lines(["0,1", "1,1"], "time_s,a"), "has no press: no place or number tells one, and none is found"),
        (lines(["0,1", "0,1"], "time_s,a"), "do not ascend at reading 1"),
        (lines(["0,,", "1,,"], "time_s,a,b"), "readings are all missing"),
        (lines(["0,1,,1"], "time_s,x_mm,y_mm,a"), "line 2 has one of x_mm and y_mm"),
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


@pytest.mark.parametrize(
    ("row", "message"),
    [("6,1,1e30,,", "readings hold 1e"), ("6,1,2,1e200,8", "presses hold 1e"), ("1e300,1,2,,", "times hold 1e")],
)
def test_implausible_numbers_are_refused(tmp_path: Path, row: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(lines([*FINE, row]))
    with pytest.raises(InputError, match=rf"r\.csv: {message}.*allowed is"):
        import_csv(tmp_path / "r.csv")


LAB = """# bench 2
t_ms;ch1;ch2;note;px;py;contact
0;1000,5;2000;begin;1,5;2;0
100;1001;2000;;1,5;2;1
200;;2000;loud;1,5;2;1
300;1000;2000;;-0,5;2;0
400;1000;2000;;-0,5;2;1
500;1000;2000;end;-0,5;2;0
"""


def test_a_mapping_tells_what_other_columns_hold(tmp_path: Path) -> None:
    (tmp_path / "lab.csv").write_text(LAB)
    mapping = "time=t_ms:ms,fibres=ch*:mV,x=px:cm,y=py:cm,press=contact"
    recording = import_csv(tmp_path / "lab.csv", mapping)
    np.testing.assert_allclose(recording.times_s, np.arange(6) / 10)
    np.testing.assert_allclose(recording.readings[:, 0], [1.0005, 1.001, np.nan, 1, 1, 1])
    assert recording.presses_mm.tolist() == [[15, 20], [-5, 20]]
    assert recording.begun.tolist() == [1, 4]
    assert recording.lifted.tolist() == [3, 5]
    assert recording.source == {"kind": "csv", "file": "lab.csv", "mapping": mapping}


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ("time=t,fibres=ch*", "time is 't', expected one of 't_ms', 'ch1', 'ch2', 'note', 'px', 'py', 'contact'"),
        ("time=note,fibres=ch*", "line 3 holds no numbers .could not convert string to float: 'begin'"),
        (
            "time=t_ms,fibres=ch*,begun=px,lifted=py",
            "mapping has 'begun=px'.* one of time, fibres, x, y, depth",
        ),
        ("time=px,fibres=ch*:mV", "times do not ascend"),
        ("time=t_ms,fibres=c*:mV,press=ch2", "press is nowhere 0"),
    ],
)
def test_a_mapping_that_does_not_fit_the_file_is_one_line(tmp_path: Path, mapping: str, message: str) -> None:
    (tmp_path / "lab.csv").write_text(LAB)
    with pytest.raises(InputError, match=message):
        import_csv(tmp_path / "lab.csv", mapping)


def test_the_form_of_padforge_may_be_written_with_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text(lines(FINE))
    rows = [";".join(cell and f"{cell},0" for cell in row.split(",")) for row in FINE]
    (tmp_path / "s.csv").write_text(lines(rows, "time_s;a;b;x_mm;y_mm"))
    assert import_csv(tmp_path / "s.csv") == import_csv(tmp_path / "r.csv")


def test_digits_that_only_python_reads_are_no_numbers(tmp_path: Path) -> None:
    for cell in ("1_0", "\u0661"):
        (tmp_path / "r.csv").write_text(lines([*FINE, f"6,1,{cell},,"]), encoding="utf-8")
        with pytest.raises(InputError, match="line 8 holds no numbers"):
            import_csv(tmp_path / "r.csv")


MEASURED = ("depth_mm", "reached_mm", "force_n")


def test_depth_and_force_have_columns_where_they_are_known(recording: Recording, tmp_path: Path) -> None:
    count = len(recording.begun)
    for change, columns in (
        ({"depths_mm": np.empty(0)}, []),
        ({}, ["depth_mm"]),
        (
            {"reached_mm": np.linspace(4, 5, count), "forces_n": np.where(np.arange(count) < 9, np.nan, 2.5)},
            [*MEASURED],
        ),
    ):
        changed = replace(recording, **change)
        export_csv(changed, tmp_path / "r.csv")
        with (tmp_path / "r.csv").open() as file:
            assert file.readline().strip().split(",")[7:] == columns
        assert import_csv(tmp_path / "r.csv") == changed


def test_a_mapping_names_depth_and_force(tmp_path: Path) -> None:
    rows = [f"{0.1 * i},{1 + (i // 10 % 2)},{i // 10 % 2},{250 * (i // 20)},{0.1 * (i // 20)}" for i in range(60)]
    (tmp_path / "r.csv").write_text("\n".join(["t,a,down,force_mN,deep_cm", *rows]))
    mapping = "time=t,fibres=a,press=down,force=force_mN:mN,reached=deep_cm:cm"
    found = import_csv(tmp_path / "r.csv", mapping)
    assert found.forces_n.tolist() == [0, 0.25, 0.5]
    assert found.reached_mm == pytest.approx([0, 1, 2])
    assert np.isnan(found.depths_mm).all()


@pytest.mark.parametrize(("unit", "value"), [("cm", 10.0), ("um", 1e-3)])
def test_an_unknown_place_is_unknown_in_any_unit(tmp_path: Path, unit: str, value: float) -> None:
    rows = ["0,1,,", "1,1,?,?", "2,1,,", "3,1,2,-1", "4,1,,"]
    (tmp_path / "lab.csv").write_text("\n".join(["t,a,px,py", *rows]) + "\n")
    recording = import_csv(tmp_path / "lab.csv", f"time=t,fibres=a,x=px:{unit},y=py:{unit}")
    np.testing.assert_allclose(recording.presses_mm, [[np.nan, np.nan], [2 * value, -value]])
