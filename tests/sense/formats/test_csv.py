"""Recordings as CSV, of padforge and of other programs: every number comes back, and other tables are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import Recording, export_csv, import_csv
from padforge.sense.recording import csv_table
from padforge.sense.recording.press_plan import read_plan


def lines(rows: list[str], header: str = "time_s,a,b,x_mm,y_mm") -> str:
    return "\n".join([header, *rows]) + "\n"


FINE = ["0,1,2,,", "1,1,2,3,4", "2,1,2,3,4", "3,1,2,,", "4,1,2,-1,0", "5,1,2,,"]


def test_unknown_places_and_missing_readings_are_told_by_their_cells(tmp_path: Path) -> None:
    """A press lasts while its place stands on the line."""
    rows = ["0,1,2,,", "1,,2,?,?", "2,nan,2,?,?", "3,1,2,,", "4,1,2,-1,0", "5,1,,,", "6,1,2,?,?", "7,1,2,,", ""]
    (tmp_path / "r.csv").write_text(lines(rows))
    recording = import_csv(tmp_path / "r.csv")
    np.testing.assert_array_equal(recording.presses_mm, [[np.nan] * 2, [-1, 0], [np.nan] * 2])
    assert recording.down_command.tolist() == [1, 4, 6]
    assert recording.up_command.tolist() == [3, 5, 7]
    assert np.argwhere(np.isnan(recording.readings)).tolist() == [[1, 0], [2, 0], [5, 1]]


@pytest.mark.parametrize("header", ["time_s,a,b,c,d", "time_s,a,b,c,d,x_mm,y_mm"])
def test_presses_are_found_where_no_line_has_a_place(recording: Recording, tmp_path: Path, header: str) -> None:
    table = np.column_stack([recording.times_s, recording.readings])
    end = ",," if "x_mm" in header else ""
    rows = [",".join(map(str, row)) + end for row in table[:1000].tolist()]
    (tmp_path / "r.csv").write_text(lines(rows, header))
    found = import_csv(tmp_path / "r.csv")
    assert not found.has_position.any()
    assert len(found.down_command) == 25
    assert np.abs(found.down_command - recording.down_command[:25]).max() <= 3
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
        (lines([*FINE, "# here", "6,1,2,3,"]), "line 9 has one of x_mm and y_mm"),
        (lines([*FINE, "6,1,2,8,8", "7,1,2,9,9"]), "press 3 goes from"),
        (lines([*FINE, "6,?,2,,"]), "line 8 holds no numbers"),
        (lines([*FINE, ",1,2,,"]), r"times hold NaN.*row 6"),
        (lines([*FINE, "6,1,1e999,,"]), r"readings hold infinity.*row 6"),
        (lines([*FINE, "", "6,1,2,,"]), "line 8 has 0 values, expected 5"),
        (lines(["0,1", "1,1"], "time_s,a"), "has no press: no place or number tells one, and none is found"),
        (lines(["0,1,,1"], "time_s,x_mm,y_mm,a"), "line 2 has one of x_mm and y_mm"),
        (lines(FINE, "\x00" * 500), r"header is '\\x00.{0,40}', expected time_s"),
    ],
)
def test_other_csv_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(InputError, match=rf"r\.csv: .*{message}") as refused:
        import_csv(tmp_path / "r.csv")
    assert "\n" not in str(refused.value)


LAB = """# bench 2
t_ms;ch1;ch2;note;px;py;contact
0;1000,5;2000;begin;1,5;2;0
100;1001;2000;;1,5;2;1
200;;2000;loud;1,5;2;1
300;1000;2000;;-0,5;2;0
400;1000;2000;;-0,5;2;1
500;1000;2000;end;-0,5;2;0
"""


def test_a_mapping_tells_what_other_columns_hold_in_any_unit_and_by_names_with_separators(tmp_path: Path) -> None:
    (tmp_path / "lab.csv").write_text(LAB)
    mapping = "time=t_ms:ms,fibres=ch*:mV,x=px:cm,y=py:cm,press=contact"
    recording = import_csv(tmp_path / "lab.csv", mapping)
    np.testing.assert_allclose(recording.times_s, np.arange(6) / 10)
    np.testing.assert_allclose(recording.readings[:, 0], [1.0005, 1.001, np.nan, 1, 1, 1])
    assert recording.presses_mm.tolist() == [[15, 20], [-5, 20]]
    assert (recording.down_command.tolist(), recording.up_command.tolist()) == ([1, 4], [3, 5])
    assert recording.source == {"kind": "csv", "file": "lab.csv", "mapping": mapping}
    rows = ["0,1,,,12:30", "1,1,?,?,1_0", "2,1,,,?", "3,1,2,-1,", "4,1,,,"]
    (tmp_path / "lab.csv").write_text("\n".join(['"t;s;x","a;b",px,py,note', *rows]) + "\n")
    for unit, value in (("cm", 10.0), ("um", 1e-3)):
        recording = import_csv(tmp_path / "lab.csv", f"time=t;s;x,fibres=a;b,x=px:{unit},y=py:{unit}")
        np.testing.assert_allclose(recording.presses_mm, [[np.nan, np.nan], [2 * value, -value]])
    rows = [f"{0.1 * i},{1 + (i // 10 % 2)},{i // 10 % 2},{250 * (i // 20)},{0.1 * (i // 20)}" for i in range(60)]
    (tmp_path / "r.csv").write_text("\n".join(["t,a,down,force_mN,deep_cm", *rows]))
    mapping = "time=t,fibres=a,press=down,force=force_mN:mN,reached=deep_cm:cm"
    found = import_csv(tmp_path / "r.csv", mapping)
    assert found.forces_n.tolist() == [0, 0.25, 0.5]
    assert found.reached_mm == pytest.approx([0, 1, 2])
    assert np.isnan(found.depths_mm).all()


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ("time=note,fibres=ch*", "line 3 holds no numbers .could not convert string to float: 'begin'"),
        (
            "time=t_ms,fibres=ch*,down_command=px,up_command=py",
            "mapping has 'down_command=px'.* one of time, fibres, x, y, depth",
        ),
        ("time=px,fibres=ch*:mV", "times do not ascend"),
        ("time=t_ms,fibres=c*:mV,press=ch2", "press is nowhere 0"),
    ],
)
def test_a_mapping_that_does_not_fit_the_file_is_one_line(tmp_path: Path, mapping: str, message: str) -> None:
    (tmp_path / "lab.csv").write_text(LAB)
    with pytest.raises(InputError, match=message):
        import_csv(tmp_path / "lab.csv", mapping)


MEASURED = ("depth_mm", "reached_mm", "force_n")


def test_every_number_comes_back_and_measures_have_columns_where_they_are_known(
    brief: Recording, tmp_path: Path
) -> None:
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
        lambda text: "\ufeff" + text,
        lambda text: text.replace(",", ";").replace("-1", "-1,0"),
        lambda text: text.replace(",", ";").replace("-1", "-1.0"),
        lambda text: text.replace(",", "\t").replace("-1", "-1,0"),
        lambda text: "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.split()),
        lambda text: text.replace(",", " , ").replace("\n", "\r\n") + "\r\n\r\n",
        lambda text: text.strip().replace("\n", "\r"),
        lambda text: "# of a probe\n\n# 2024, spring; warm\n" + text.replace("\n3", "\n# knocked at\n3"),
        lambda text: f"# by hand\n# {text}",
        lambda text: "#" + text.replace(",", ";").replace("-1", "-1e0"),
    ],
)
def test_programs_write_the_same_table_in_many_ways(tmp_path: Path, change) -> None:
    (tmp_path / "plain.csv").write_text(lines(FINE))
    (tmp_path / "r.csv").write_text(change(lines(FINE)), encoding="utf-8", newline="")
    assert import_csv(tmp_path / "r.csv") == import_csv(tmp_path / "plain.csv")


CELLS = ["1_0", "\u0661", "\uff11", "0x10", "1 2", '"1,5"', "two", "1e", "--1", "?", "1d5", "?5", "5?"]


@pytest.mark.parametrize("separator", [",", ";"])
def test_what_only_some_programs_take_for_a_number_is_refused_with_its_line(tmp_path: Path, separator: str) -> None:
    for cell in CELLS if separator == "," else [cell for cell in CELLS if cell != '"1,5"']:
        for comment in ("", "# here\n"):
            rows = [separator.join(row) for row in (("x_mm", "y_mm"), ("1", "2"), ("3", cell))]
            text = "\n".join([*rows[:2], comment + rows[2]])
            (tmp_path / "t.csv").write_text(text, encoding="utf-8")
            with pytest.raises(InputError, match=rf"t\.csv: line {3 + bool(comment)} holds no numbers"):
                read_plan(tmp_path / "t.csv", 1.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"x_mm,y_mm\n1,\xff\n", "not a CSV file"),
        (b"\xff\xfe", "not a CSV file"),
        (b"x_mm,y_mm\n" + b"1" * (2**23 + 2**21), "a line has more than"),
        (b"a" * 3_000_000, "not a CSV file .field larger"),
        (b"x_mm,y_mm\n1," + b'"' + b"2" * 200_000, "line 2 is not CSV"),
        (b'x_mm,y_mm\n1,"2\n', "line 2 is not CSV .unexpected end"),
        (b'x_mm,y_mm\n1,"2"3\n', "line 2 is not CSV"),
        (b'x_mm,"y_mm\n1,2\n', "not a CSV file .unexpected end"),
    ],
)
def test_what_is_no_table_is_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "t.csv").write_bytes(content)
    with pytest.raises(InputError, match=rf"t\.csv: {message}") as refused:
        read_plan(tmp_path / "t.csv", 1.0)
    assert len(str(refused.value)) < 300 + len(str(tmp_path))


def test_a_table_that_is_read_in_pieces_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 10 MB most are notes; a line that is no number is named by its number wherever it stands."""
    rows = [f"{at},{at % 7},{at % 40 // 20},{'n' * 1000}" for at in range(10_000)]
    (tmp_path / "r.csv").write_text("\n".join(["t,a,down,note", *rows]))
    found = import_csv(tmp_path / "r.csv", "time=t,fibres=a,press=down")
    assert found.times_s.tolist() == list(range(10_000))
    rows[9000] = rows[9000].replace("9000", "9OOO")
    (tmp_path / "r.csv").write_text("\n".join(["t,a,down,note", *rows]))
    with pytest.raises(InputError, match="line 9002 holds no numbers"):
        import_csv(tmp_path / "r.csv", "time=t,fibres=a,press=down")
    monkeypatch.setattr(csv_table, "MAX_VALUES", 100)
    with pytest.raises(InputError, match="more than 100 values"):
        import_csv(tmp_path / "r.csv", "time=t,fibres=a,press=down")
