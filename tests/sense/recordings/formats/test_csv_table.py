"""CSV files of any program: what they hold, and the line where they hold something else."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from sense.recordings.formats import csv_table
from sense.recordings.formats.csv_table import UNKNOWN, CsvTable
from tests.helpers.effort import few


def written(folder: Path, text: str) -> Path:
    (folder / "t.csv").write_text(text, encoding="utf-8", newline="")
    return folder / "t.csv"


def read(path: Path) -> list[list[float]]:
    table = CsvTable(path)
    return table.columns(range(len(table.names))).tolist()


@pytest.mark.parametrize(
    "text",
    [
        "a,b\n1.5,2\n-3,4e1\n",
        "a;b\n1,5;2\n-3;4e1\n",
        "a;b\n1.5;2\n-3;4e1\n",
        "a\tb\n1,5\t2\n-3\t4e1\n",
        '"a","b"\n"1.5","2"\n"-3","4e1"\n',
        "\ufeff a , b \r\n 1.5, 2\r\n-3 ,4e1\r\n\r\n\r\n",
        "a,b\r1.5,2\r-3,4e1",
        "# of a probe\n\n# 2024, spring; warm\na,b\n1.5,2\n# knocked at\n-3,4e1\n",
        "# by hand\n# a,b\n1.5,2\n-3,4e1\n",
        "#a;b\n1,5;2\n-3;4e1\n",
    ],
)
def test_programs_write_the_same_table_in_many_ways(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    assert CsvTable(path).names == ["a", "b"]
    assert read(path) == [[1.5, 2], [-3, 40]]


def test_names_may_hold_other_separators_in_quotes(tmp_path: Path) -> None:
    assert CsvTable(written(tmp_path, '"t;s;x",ch 1\n1,2\n')).names == ["t;s;x", "ch 1"]


@pytest.mark.parametrize("cell", ["1_0", "\u0661", "\uff11", "0x10", "1 2", "1,5", "two", "1e", "--1", "?", "1d5"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_what_only_some_programs_take_for_a_number_is_refused(tmp_path: Path, cell: str, separator: str) -> None:
    if cell == "1,5" and separator == ";":
        return
    cell = f'"{cell}"' if cell == "1,5" else cell
    rows = [separator.join(row) for row in (("a", "b"), ("1", "2"), ("3", cell))]
    with pytest.raises(InputError, match=r"t\.csv: line 3 holds no numbers"):
        read(written(tmp_path, "\n".join(rows)))


def test_cells_that_are_not_asked_for_may_hold_anything(tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path, "when,a,note,b\n12:30,1,warm,\n12:31,,1_0,2\n"))
    assert np.array_equal(table.columns([3, 1]), [[np.nan, 1], [2, np.nan]], equal_nan=True)


def test_a_question_mark_is_a_value_where_it_may_stand(tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path, "a,b\n1,?\n2, ? \n"))
    assert table.columns([0, 1], unknown=[1]).tolist() == [[1, UNKNOWN], [2, UNKNOWN]]
    for cell in ("?5", "5?", "-?", "??"):
        with pytest.raises(InputError, match="line 2 holds no numbers"):
            CsvTable(written(tmp_path, f"a,b\n1,{cell}\n")).columns([0, 1], unknown=[1])


@pytest.mark.parametrize("comment", ["", "# here\n"])
def test_errors_and_rows_name_their_line_in_the_file(tmp_path: Path, comment: str) -> None:
    more = bool(comment)
    for cell, message in (("two", "holds no numbers"), ("2,3", "has 3 values, expected 2")):
        path = written(tmp_path, f"# note\na,b\n1,2\n{comment}3,{cell}\n")
        with pytest.raises(InputError, match=f"line {4 + more} {message}"):
            read(path)
    table = CsvTable(written(tmp_path, f"# note\na,b\n1,2\n{comment}3,4\n"))
    table.columns([0])
    assert [table.line(row) for row in (0, 1)] == [3, 4 + more]


def test_an_empty_line_is_one_without_values_unless_gaps_are_nothing(tmp_path: Path) -> None:
    path = written(tmp_path, "a,b\n1,2\n\n3,4\n\n")
    with pytest.raises(InputError, match="line 3 has 0 values, expected 2"):
        read(path)
    assert CsvTable(path, gaps=True).columns([0, 1]).tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,b\n1,\xff\n", "not a CSV file"),
        (b"\xff\xfe", "not a CSV file"),
        (b"a,b\n" + b"1" * 3_000_000, "a line has more than"),
        (b"a" * 3_000_000, "not a CSV file .field larger"),
        (b"a,b\n1," + b'"' + b"2" * 200_000, "line 2 is not CSV"),
        (b'a,b\n1,"2\n', "line 2 is not CSV .unexpected end"),
        (b'a,b\n1,"2"3\n', "line 2 is not CSV"),
        (b'a,"b\n1,2\n', "not a CSV file .unexpected end"),
    ],
)
def test_what_is_no_table_is_one_line(tmp_path: Path, monkeypatch, content: bytes, message: str) -> None:
    monkeypatch.setattr(csv_table, "_PIECE", 2**16)
    (tmp_path / "t.csv").write_bytes(content)
    with pytest.raises(InputError, match=rf"t\.csv: {message}") as refused:
        read(tmp_path / "t.csv")
    assert len(str(refused.value)) < 300 + len(str(tmp_path))


def test_more_than_is_allowed_is_refused_before_all_is_read(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(csv_table, "MOST_VALUES", 100)
    with pytest.raises(InputError, match="more than 100 values"):
        read(written(tmp_path, "a,b\n" + "1,2\n" * 51))


cells = st.one_of(
    st.floats().map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.sampled_from(["", "?", "nan", "inf", "-Infinity", " 1", "2 ", "1e5", ".5", "5.", "+1", "1_0", '"1"', "a"]),
    st.text(max_size=4),
)


@few(60)
@given(
    rows=st.lists(st.lists(cells, min_size=2, max_size=3), max_size=8),
    separator=st.sampled_from(",;\t"),
    end=st.sampled_from(["\n", "\r\n"]),
    piece=st.sampled_from([1, 7, 2**20]),
)
def test_lines_read_at_once_are_those_read_one_by_one(tmp_path_factory, rows, separator, end, piece) -> None:
    text = separator.join("ab") + end + end.join(separator.join(row) for row in rows)
    path = written(tmp_path_factory.getbasetemp(), text.encode("utf-8", "replace").decode())

    def result(table: CsvTable) -> str:
        try:
            return repr(table.columns([0, 1], unknown=[1]).tolist())
        except InputError as error:
            return str(error)

    slow = CsvTable(path)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(CsvTable, "_at_once", lambda *_: None)
        expected = result(slow)
        patched.undo()
        patched.setattr(csv_table, "_PIECE", piece)
        assert result(CsvTable(path)) == expected
