"""Import and export: the published recording, CSV, and files that are neither."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from design.common.errors import InputError
from sense import (
    Recorder,
    Recording,
    export_bag,
    export_csv,
    export_hdf5,
    export_lerobot,
    import_bag,
    import_csv,
    import_hdf5,
    import_mat,
    open_recording,
)
from sense.cli.main import sense
from sense.recordings.import_export import arm_states, export_file
from tests.helpers.effort import few


def holed(recording: Recording) -> Recording:
    """The recording with a reading, a row and a fibre's readings missing, and two places unknown."""
    readings, places = np.array(recording.readings), np.array(recording.presses_mm)
    readings[5, 1] = readings[70] = readings[:, 2] = np.nan
    places[[0, 7]] = np.nan
    return Recording(readings, recording.times_s, places, recording.begun, recording.lifted, recording.source)


@pytest.mark.parametrize("name", ["run", "run.csv", "run.h5", "run.mcap"])
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


@pytest.mark.parametrize("end", ["mat", "csv", "h5", "mcap", "db3"])
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


def test_states_of_an_arm_are_read_from_a_run_directory_that_has_them(tmp_path: Path) -> None:
    states = np.arange(30.0).reshape(3, 10)
    with Recorder(tmp_path / "run", 1, {}, {}) as recorder:
        recorder.append([0.0, 1.0], [[1.0], [2.0]])
        recorder.append_states(states)
    np.testing.assert_array_equal(arm_states(tmp_path / "run"), states)
    with Recorder(tmp_path / "none", 1, {}, {}) as recorder:
        recorder.append([0.0, 1.0], [[1.0], [2.0]])
    assert arm_states(tmp_path / "none") is None
    assert arm_states(tmp_path / "run.csv") is None


OTHERS: tuple[Any, ...] = (None, 3, np.nan, b"x", ["a"], {"radius": 0.5}, np.ones((2, 2)), object())
"""What is no path, no text, no recording."""


@pytest.mark.parametrize(
    "read", [import_csv, import_mat, import_hdf5, import_bag, open_recording, Recording.open, Recorder.resume]
)
def test_what_is_no_path_is_refused_in_one_line(read: Callable[..., Any]) -> None:
    for other in OTHERS:
        with pytest.raises(InputError, match=r"path is .*, expected a path"):
            read(other)


@pytest.mark.parametrize(
    ("read", "name"), [(import_csv, "a.csv"), (import_mat, "a.mat"), (import_hdf5, "a.h5"), (import_bag, "a.mcap")]
)
def test_a_mapping_that_is_no_text_is_refused_in_one_line(read: Callable[..., Any], name: str) -> None:
    for other in OTHERS:
        with pytest.raises(InputError, match=r"mapping is .*, expected a str"):
            read("file", other)


@pytest.mark.parametrize("write", [export_csv, export_hdf5, export_bag, export_lerobot])
def test_what_cannot_be_exported_is_refused_in_one_line(
    recording: Recording, tmp_path: Path, write: Callable[..., Any]
) -> None:
    for other in OTHERS:
        with pytest.raises(InputError, match=r"recording is .*, expected a Recording"):
            write(other, tmp_path / "x")
        with pytest.raises(InputError, match=r"path is .*, expected a path"):
            write(recording, other)
    if write in (export_bag, export_lerobot):
        with pytest.raises(InputError, match="findings is 3, expected a ModelFindings"):
            write(recording, tmp_path / "x", 3)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("states", [np.ones((3, 9)), np.ones(10), "a", 3.0])
def test_states_that_no_arm_has_are_refused(recording: Recording, tmp_path: Path, states: Any) -> None:
    with pytest.raises(InputError, match="states"):
        export_bag(recording, tmp_path / "x.mcap", states=states)


def test_a_recording_is_written_only_to_a_path_and_with_tables(recording: Recording, tmp_path: Path) -> None:
    for other in OTHERS:
        with pytest.raises(InputError, match=r"path is .*, expected a path"):
            recording.save(other, {})
        with pytest.raises(InputError, match=r"path is .*, expected a path"):
            Recorder(other, 4, {}, {})
    for other in ("a", 3, [1], {1: 2}):
        with pytest.raises(InputError, match=r"source is .*, expected a table"):
            Recorder(tmp_path / "x", 4, other, {})  # pyright: ignore[reportArgumentType]
        with pytest.raises(InputError, match=r"provenance is .*, expected a table"):
            Recorder(tmp_path / "x", 4, {}, other)  # pyright: ignore[reportArgumentType]
    assert list(tmp_path.iterdir()) == []
