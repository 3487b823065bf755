"""Import and export: the published recording, CSV, and files that are neither."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from design.common.errors import InputError
from sense import Recording, export_csv, import_csv, import_mat, open_recording
from sense.cli.main import sense
from sense.recordings.import_export import export_file
from tests.helpers.effort import few

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
        ("voltage", np.ones((39, 4)), r"voltage has shape \(39, 4\), expected at least 40 rows"),
        ("voltage", np.ones((20, 6, 4)), "voltage has shape"),
        ("voltage", scipy.sparse.csc_matrix(np.ones((120, 4))), "voltage is a csc_.*, expected a full matrix"),
        ("voltage", {"volts": 1.0}, "expected real numbers"),
        ("voltage", np.full((120, 4), 1e200), "readings hold 1e"),
        ("pos", np.ones((3, 3)), r"pos has shape \(3, 3\)"),
        ("pos", np.ones((1, 3)), r"pos has shape \(1, 3\), expected \(2, presses\)"),
        ("pos", np.ones((2, 0)), "pos has shape"),
        ("pos", np.ones((2, 2)), "expected 40 rows for each of the 2 presses"),
        ("pos", np.ones((2, 4)), "expected 40 rows for each of the 4 presses"),
        ("pos", np.array([[1, 2, np.nan], [1, 2, 3]]), "press 2 has one of x and y"),
        ("tim", np.where(np.arange(120) == 7, np.nan, np.arange(120)), r"times hold NaN .*first in row 7"),
        ("tim", np.where(np.arange(120) == 7, 6, np.arange(120)), "times do not ascend at reading 7"),
        ("tim", np.zeros((1, 120)), "do not ascend at reading 1"),
        ("tim", np.arange(100.0), "times have shape"),
    ],
)
def test_variables_that_do_not_fit_are_refused(tmp_path: Path, name: str, value: np.ndarray, message: str) -> None:
    scipy.io.savemat(tmp_path / "bad.mat", good() | {name: value})
    with pytest.raises(InputError, match=message) as caught:
        import_mat(tmp_path / "bad.mat")
    assert "\n" not in str(caught.value)


def test_a_mat_may_hold_what_real_rigs_give(tmp_path: Path) -> None:
    content = good()
    volts = content["voltage"]
    holed = volts.copy()
    holed[:, 1] = 3.3
    holed[:, 2] = np.nan
    holed[50:55] = np.nan
    uneven = np.cumsum(np.random.default_rng(1).exponential(0.07, 120))[None]
    for change in (
        {"voltage": np.rint(volts * 1000 / 5).astype(np.uint16)},
        {"voltage": volts.astype(np.float32)},
        {"voltage": holed},
        {"tim": uneven},
        {"tim": content["tim"].T},
        {"pos": content["pos"].T},
    ):
        scipy.io.savemat(tmp_path / "r.mat", content | change)
        recording = import_mat(tmp_path / "r.mat")
        assert np.array_equal(recording.readings, (content | change)["voltage"], equal_nan=True)
        assert np.array_equal(recording.times_s, (content | change)["tim"].ravel())
        assert np.array_equal(recording.presses_mm, content["pos"].T)


def test_a_mat_of_one_press_comes_in(tmp_path: Path) -> None:
    content = {name: values[..., :40] for name, values in good().items() if name == "tim"}
    scipy.io.savemat(tmp_path / "r.mat", content | {"voltage": good()["voltage"][:40], "pos": [[1.0], [2.0]]})
    recording = import_mat(tmp_path / "r.mat")
    assert recording.presses_mm.tolist() == [[1, 2]]
    assert (recording.begun.tolist(), recording.lifted.tolist()) == ([20], [40])


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
    found = open_recording(tmp_path / name)
    assert found == holes
    assert found.digest == holes.digest
    assert found.known.sum() == len(holes.known) - 2


def unrelated(folder: Path) -> dict[str, bytes]:
    """What files of other kinds hold, by their names."""
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8))
    for kind in ("png", "jpeg", "bmp", "tiff"):
        image.save(folder / f"image.{kind}")
    return {path.suffix: path.read_bytes() for path in folder.iterdir()} | {
        "empty": b"",
        "zeros": bytes(2000),
        "text": b"dear all,\nplease find attached\n",
        "zip": b"PK\x03\x04" + np.random.default_rng(1).bytes(2000),
        "people": b"name,age\nAda,36\n",
        "newer mat": b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(384) + b"\x89HDF\r\n\x1a\n" + bytes(600),
        "larger than any memory": np.array([0, 2**30, 2**30, 0, 2], "<i4").tobytes() + b"a\x00" + bytes(99),
    }


@pytest.mark.parametrize("end", ["mat", "csv", "h5"])
def test_files_of_another_kind_are_one_line_and_no_recording(tmp_path: Path, end: str) -> None:
    for name, content in unrelated(tmp_path).items():
        file = tmp_path / f"{name.strip('.')}.{end}"
        file.write_bytes(content)
        result = CliRunner().invoke(sense, ["import", str(file), "--out", str(tmp_path / "out")])
        assert isinstance(result.exception, InputError), (name, result.exception)
        message = str(result.exception)
        assert file.name in message
        assert "\n" not in message
        assert len(message) < 300 + len(str(file))
        assert not (tmp_path / "out").exists()


@few(20)
@given(content=st.binary(max_size=300))
def test_bytes_at_random_are_an_input_error_and_nothing_else(tmp_path_factory, content: bytes) -> None:
    folder = tmp_path_factory.mktemp("noise")
    for name, read in (("r.csv", import_csv), ("r.mat", import_mat)):
        (folder / name).write_bytes(content)
        with pytest.raises(InputError):
            read(folder / name)


def test_a_folder_for_a_file_and_a_file_for_a_folder_are_one_line(recording: Recording, tmp_path: Path) -> None:
    for read in (import_csv, import_mat):
        with pytest.raises(InputError, match=r"directory|folder"):
            read(tmp_path)
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "r.csv"):
        with pytest.raises(InputError, match="cannot be written"):
            export_csv(recording, path)
