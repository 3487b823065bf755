"""Import and export by extension, and arguments of all readers and writers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from padforge.common.validation import InputError
from padforge.sense import (
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


@pytest.mark.parametrize("name", ["run", "run.csv", "run.h5", "run.mcap"])
def test_export_file_round_trip_with_missing_values(eight: Recording, tmp_path: Path, name: str) -> None:
    if name == "run":
        eight.save(tmp_path / name, {})
    else:
        export_file(eight, tmp_path / name)
    imported = open_recording(tmp_path / name)
    assert imported == eight
    assert imported.digest == eight.digest
    assert imported.has_position.sum() == 7


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
    assert list(tmp_path.iterdir()) == []
