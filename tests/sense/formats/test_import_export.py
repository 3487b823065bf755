"""Import and export by extension, and arguments of all readers and writers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from padforge.common.validation import InputError
from padforge.sense import (
    Localization,
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
from padforge.sense.cli.main import sense
from padforge.sense.formats.import_export import arm_states, export_file


@pytest.mark.parametrize("are_measured", [True, False])
@pytest.mark.parametrize("name", ["run", "run.csv", "run.h5", "run.mcap"])
def test_recordings_with_missing_values_are_read_back_from_each_format(
    eight: Recording, tmp_path: Path, name: str, are_measured: bool
) -> None:
    """The same recording gives the same bytes, and tables have no column of what no press has."""
    if not are_measured:
        eight = replace(eight, depths_mm=np.empty(0), reached_mm=np.empty(0))
    paths = [tmp_path / folder / name for folder in ("one", "other")]
    for path in paths:
        path.parent.mkdir()
        eight.save(path, {}) if name == "run" else export_file(eight, path)
    imported = open_recording(paths[0])
    assert imported == eight
    assert imported.digest == eight.digest
    assert imported.has_position.sum() == 7
    if name != "run":
        content, again = (path.read_bytes() for path in paths)
        assert content == again
        assert (b"reached" in content) is are_measured or name == "run.mcap"
    if name != "run.csv":
        assert imported.source == eight.source


def unrelated_files() -> dict[str, bytes]:
    """Return the content of files of other kinds, by name."""
    return {
        "image": b"\x89PNG\r\n\x1a\n" + np.random.default_rng(1).bytes(2000),
        "empty": b"",
        "text": b"dear all,\nplease find attached\n",
        "people": b"name,age\nAda,36\n",
    }


@pytest.mark.parametrize("end", ["mat", "csv", "h5", "mcap", "db3"])
def test_import_refuses_files_of_another_kind(tmp_path: Path, end: str) -> None:
    for name, content in unrelated_files().items():
        file = tmp_path / f"{name}.{end}"
        file.write_bytes(content)
        result = CliRunner().invoke(sense, ["import", str(file), "--out", str(tmp_path / "out")])
        assert isinstance(result.exception, InputError), (name, result.exception)
        message = str(result.exception)
        assert (file.name in message, "\n" in message, len(message) < 300 + len(str(file))) == (True, False, True)
        assert not (tmp_path / "out").exists()


def test_readers_and_writers_refuse_folders_for_files(brief: Recording, tmp_path: Path) -> None:
    for read, end in ((import_csv, "csv"), (import_mat, "mat"), (import_hdf5, "h5"), (import_bag, "mcap")):
        (tmp_path / f"folder.{end}").mkdir()
        for path in (tmp_path / f"folder.{end}", tmp_path / f"absent.{end}"):
            with pytest.raises(InputError, match=rf"{path.name}.*: .*(folder|directory|[Nn]o such|cannot be read)"):
                read(path)
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "r.csv"):
        with pytest.raises(InputError, match="cannot be written"):
            export_csv(brief, path)


def test_arm_states_of_a_run_directory(tmp_path: Path) -> None:
    states = np.arange(30.0).reshape(3, 10)
    with Recorder(tmp_path / "run", 1, {}, {}) as recorder:
        recorder.append([0.0, 1.0], [[1.0], [2.0]])
        recorder.append_states(states)
    np.testing.assert_array_equal(arm_states(tmp_path / "run"), states)
    assert arm_states(tmp_path / "run.csv") is None


def test_readers_and_writers_refuse_other_arguments(brief: Recording, tmp_path: Path) -> None:
    other: Any = 3
    with pytest.raises(InputError, match=r"columns is 3, expected a str"):
        import_csv("file", other)
    for write in (export_csv, export_hdf5, export_bag, export_lerobot):
        with pytest.raises(InputError, match=r"recording is 3, expected a Recording"):
            write(other, tmp_path / "x")
    ones = np.ones((40, 2))
    touches = Localization(ones, ones, ones[:, 0], ones[:, 0])
    with pytest.raises(InputError, match=r"predictions of a model can be written as \.mcap"):
        export_file(brief, tmp_path / "r.csv", localization=touches)
    assert list(tmp_path.iterdir()) == []
