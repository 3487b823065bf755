"""Import and export: the published recording, CSV, and files that are neither."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from design.errors import InputError
from sense import Recording, export_csv, import_csv, import_mat
from sense.exchange import export_file

MAT = "para5_long_first4500.mat"


def test_the_published_recording_comes_in_as_it_is(published: Path) -> None:
    recording = import_mat(published / MAT)
    content = scipy.io.loadmat(published / MAT)
    assert np.array_equal(recording.readings, content["voltage"])
    assert np.array_equal(recording.presses_mm, content["pos"].T)
    assert np.array_equal(recording.times_s, content["tim"].ravel())
    assert recording.begun[:3].tolist() == [20, 60, 100]
    assert recording.lifted[:3].tolist() == [40, 80, 120]


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.99999])
def test_a_truncated_recording_is_refused(published: Path, tmp_path: Path, share: float) -> None:
    content = (published / MAT).read_bytes()
    (tmp_path / "cut.mat").write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"cut\.mat"):
        import_mat(tmp_path / "cut.mat")


def good() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "voltage": rng.uniform(1, 2, (120, 4)),
        "pos": rng.uniform(-9, 9, (2, 3)),
        "tim": np.arange(120.0)[None] / 13,
    }


def test_readings_of_an_unfinished_last_press_are_kept(tmp_path: Path) -> None:
    content = good()
    scipy.io.savemat(
        tmp_path / "r.mat",
        content | {"pos": content["pos"][:, :2], "voltage": content["voltage"][:100], "tim": content["tim"][:, :100]},
    )
    recording = import_mat(tmp_path / "r.mat")
    assert recording.readings.shape == (100, 4)
    assert recording.lifted.tolist() == [40, 80]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("voltage", np.ones((119, 4)), r"voltage has shape \(119, 4\), expected 40 rows for each of the 3 presses"),
        ("voltage", np.ones((4, 120)), "voltage has shape"),
        ("voltage", np.full((120, 4), np.nan), "readings are all missing"),
        ("voltage", np.ones((120, 4)) * 1j, "expected real numbers"),
        ("voltage", np.array(["a", "b"], dtype=object), "expected real numbers"),
        ("pos", np.ones((3, 3)), r"pos has shape \(3, 3\)"),
        ("pos", np.ones((2, 0)), "pos has shape"),
        ("tim", np.zeros((1, 120)), "do not ascend at reading 1"),
        ("tim", np.arange(100.0), "times have shape"),
    ],
)
def test_variables_that_do_not_fit_are_refused(tmp_path: Path, name: str, value: np.ndarray, message: str) -> None:
    scipy.io.savemat(tmp_path / "bad.mat", good() | {name: value})
    with pytest.raises(InputError, match=message) as caught:
        import_mat(tmp_path / "bad.mat")
    assert "\n" not in str(caught.value)


def test_an_unrelated_mat_is_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "other.mat", {"apples": 3})
    with pytest.raises(InputError, match=r"no variable voltage, tim \(found apples\)"):
        import_mat(tmp_path / "other.mat")


def test_a_mat_without_places_has_presses_of_unknown_place(tmp_path: Path) -> None:
    content = good()
    scipy.io.savemat(tmp_path / "blind.mat", {name: content[name] for name in ("voltage", "tim")})
    blind = import_mat(tmp_path / "blind.mat")
    assert not blind.known.any()
    assert blind.begun.tolist() == [20, 60, 100]
    pos = np.array(content["pos"], dtype=float)
    pos[:, 1] = np.nan
    scipy.io.savemat(tmp_path / "partly.mat", content | {"pos": pos})
    assert import_mat(tmp_path / "partly.mat").known.tolist() == [True, False, True]


def holed(recording: Recording) -> Recording:
    """The recording with a reading, a row and a fibre's readings missing, and two places unknown."""
    readings, places = np.array(recording.readings), np.array(recording.presses_mm)
    readings[5, 1] = readings[70] = readings[:, 2] = np.nan
    places[[0, 7]] = np.nan
    return Recording(readings, recording.times_s, places, recording.begun, recording.lifted, recording.source)


@pytest.mark.parametrize("name", ["run", "run.csv", "run.h5"])
def test_what_is_missing_stays_missing_and_nothing_else_is(recording: Recording, tmp_path: Path, name: str) -> None:
    holes = holed(recording)
    if name == "run":
        holes.save(tmp_path / name, {})
    else:
        export_file(holes, tmp_path / name)
    found = Recording.open(tmp_path / name)
    assert found == holes
    assert found.digest == holes.digest
    assert found.known.sum() == len(holes.known) - 2


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
    ],
)
def test_other_csv_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        import_csv(tmp_path / "r.csv")


@given(content=st.binary(max_size=300))
def test_bytes_at_random_are_an_input_error_and_nothing_else(tmp_path_factory, content: bytes) -> None:
    folder = tmp_path_factory.mktemp("noise")
    for name, read in (("r.csv", import_csv), ("r.mat", import_mat)):
        (folder / name).write_bytes(content)
        with pytest.raises(InputError):
            read(folder / name)


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


def test_a_folder_for_a_file_and_a_file_for_a_folder_are_one_line(recording: Recording, tmp_path: Path) -> None:
    for read in (import_csv, import_mat):
        with pytest.raises(InputError, match=r"directory|folder"):
            read(tmp_path)
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "r.csv"):
        with pytest.raises(InputError, match="cannot be written"):
            export_csv(recording, path)
