"""LeRobot datasets, checked for what the reader of lerobot 0.6 requires of format v3.0."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.formats import lerobot
from padforge.sense.formats.annotations import ModelAnnotations
from padforge.sense.formats.import_export import export_file
from padforge.sense.formats.lerobot import export_lerobot
from tests.helpers.power_cut import ON_LINUX, Disk

COUNTED = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


@pytest.fixture(scope="module")
def eight(eight: Recording) -> Recording:
    """Eight presses of known depth, one at an unknown position, with missing readings."""
    return replace(eight, depths_mm=np.where(np.isnan(eight.depths_mm), 1.5, eight.depths_mm))


def check_dataset(folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray], list[dict[str, Any]]]:
    """Check a dataset; return its info, columns and episodes."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert {name: info["features"][name]["dtype"] for name in COUNTED} == COUNTED
    episodes = pq.read_table(sorted((folder / "meta" / "episodes").glob("*/*.parquet"))).to_pylist()
    tasks = pq.read_table(folder / "meta" / "tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]  # pandas has the text as index
    columns = read_columns(folder, info, episodes)
    assert columns["index"].tolist() == list(range(info["total_frames"]))
    end = 0
    for number, episode in enumerate(episodes):
        assert (episode["episode_index"], episode["tasks"]) == (number, tasks["task"].to_pylist())
        assert (episode["dataset_from_index"], episode["dataset_to_index"]) == (end, end + episode["length"])
        rows = slice(end, end := end + episode["length"])
        assert set(columns["episode_index"][rows]) == {number}
        assert columns["frame_index"][rows].tolist() == list(range(episode["length"]))
        np.testing.assert_allclose(columns["timestamp"][rows] * info["fps"], np.arange(episode["length"]), atol=1e-4)
        assert episode["meta/episodes/chunk_index"] == episode["meta/episodes/file_index"] == 0
    assert (end, len(episodes)) == (info["total_frames"], info["total_episodes"])
    overall = json.loads((folder / "meta" / "stats.json").read_text())
    for name, values in columns.items():
        check_statistics(overall[name], values)
        for each in episodes:
            part = values[each["dataset_from_index"] : each["dataset_to_index"]]
            check_statistics({key: each[f"stats/{name}/{key}"] for key in STATISTICS}, part)
    return info, columns, episodes


def read_columns(folder: Path, info: dict[str, Any], episodes: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return all frames, from the files that the episodes name, one row group an episode."""
    tables = []
    for chunk, file in sorted({(each["data/chunk_index"], each["data/file_index"]) for each in episodes}):
        path = folder / info["data_path"].format(chunk_index=chunk, file_index=file)
        tables.append(pq.read_table(path))
        held = [each for each in episodes if (each["data/chunk_index"], each["data/file_index"]) == (chunk, file)]
        assert [each["episode_index"] for each in held] == sorted(set(tables[-1]["episode_index"].to_pylist()))
        assert pq.ParquetFile(path).num_row_groups == len(held)
    assert len(tables) == len(list((folder / "data").glob("*/*.parquet")))
    assert set(tables[0].column_names) == set(info["features"])
    for name, about in info["features"].items():
        (width,), number = about["shape"], {"float32": "float", "int64": "int64"}[about["dtype"]]
        expected = number if width == 1 else f"fixed_size_list<element: {number}>[{width}]"
        assert {str(table.schema.field(name).type) for table in tables} == {expected}
        assert about["names"] is None or len(about["names"]) == width
    return {name: np.concatenate([np.array(table[name].to_pylist()) for table in tables]) for name in info["features"]}


def check_statistics(statistics: dict[str, Any], values: np.ndarray) -> None:
    rows = values.reshape(len(values), -1).astype(float)
    assert (set(statistics), statistics["count"]) == (STATISTICS, [len(rows)])
    for key, expected in (("min", np.nanmin), ("max", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
        np.testing.assert_allclose(statistics[key], expected(rows, axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(statistics["q90"], np.nanquantile(rows, 0.9, axis=0), rtol=1e-5)


def test_export_lerobot_writes_the_format(eight: Recording, tmp_path: Path) -> None:
    """Of presses at known positions, from the middle of the pause before to that of the pause after."""
    export_file(eight, tmp_path / "set", "lerobot")
    _, columns, episodes = check_dataset(tmp_path / "set")
    middle = (eight.up_command[:-1] + eight.down_command[1:]) // 2
    spans = np.delete(np.column_stack([np.append(0, middle), np.append(middle, len(eight.readings))]), 2, axis=0)
    frames = np.concatenate([np.arange(*span) for span in spans])
    presses = np.repeat(np.delete(np.arange(8), 2), np.diff(spans).ravel())
    assert [each["length"] for each in episodes] == np.diff(spans).ravel().tolist()
    np.testing.assert_array_equal(columns["observation.state"], eight.readings[frames].astype(np.float32))
    down = (frames >= eight.down_command[presses]) & (frames < eight.up_command[presses])
    expected = np.column_stack([eight.presses_mm[presses], eight.depths_mm[presses], down])
    np.testing.assert_allclose(columns["action"], expected, rtol=1e-6)


@ON_LINUX
def test_export_lerobot_outlasts_a_power_cut(eight: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, path = Disk(monkeypatch), tmp_path / "new" / "data"
    export_file(eight, path, "lerobot")
    files = [file for file in path.rglob("*") if file.is_file()]
    assert all(disk.read(file) == file.read_bytes() for file in files)
    assert all(disk.has_name(folder) for folder in (path.parent, path, *path.rglob("*")))


def test_export_lerobot_puts_every_frame_in_an_episode(eight: Recording, tmp_path: Path) -> None:
    """With what a model predicts only once a press is over."""
    positioned, nan = replace(eight, presses_mm=np.nan_to_num(eight.presses_mm)), np.full(8, np.nan)
    touches = ModelAnnotations(np.full((8, 2), 3.0), np.ones((8, 2)), np.full(8, 2.5), nan, nan)
    export_lerobot(positioned, tmp_path / "set", touches)
    info, columns, _ = check_dataset(tmp_path / "set")
    assert info["total_frames"] == len(positioned.readings)
    over = np.any(np.asarray(columns["observation.touch"]), axis=1)
    assert set(map(tuple, columns["observation.touch"][over])) == {(3.0, 3.0, 2.5, 1.0)}
    assert not np.any(np.asarray(columns["action"])[over, -1] == 1)
    assert np.all(np.take(over, positioned.up_command[:-1]))


@pytest.mark.parametrize(("slower", "fps"), [(1.0, 13), (10.0, 1.34), (0.05, 268)])
def test_export_lerobot_rounds_rates_and_splits_files(
    eight: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slower: float, fps: float
) -> None:
    monkeypatch.setattr(lerobot, "FILE_MB", 100 * 50 / 2**20)
    monkeypatch.setattr(lerobot, "CHUNK_FILES", 2)
    changed = replace(eight, readings=eight.readings[:, :1], times_s=eight.times_s * slower)
    export_lerobot(changed, tmp_path / "set")
    info, _, episodes = check_dataset(tmp_path / "set")
    assert info["fps"] == pytest.approx(fps, rel=0.02)
    assert isinstance(info["fps"], int) == (slower < 2)
    assert info["features"]["observation.state"]["shape"] == [1]
    files = {(each["data/chunk_index"], each["data/file_index"]) for each in episodes}
    assert files == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_export_lerobot_writes_all_or_nothing(
    eight: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(lerobot, "write_json", full)
        with pytest.raises(InputError, match=r"set: cannot be written \(No space left"):
            export_lerobot(eight, tmp_path / "set")
    assert not list(tmp_path.iterdir())
    (tmp_path / "set").mkdir()
    export_lerobot(eight, tmp_path / "set")
    with pytest.raises(InputError, match="set: exists and is not empty"):
        export_lerobot(eight, tmp_path / "set")
    unknown = replace(eight, presses_mm=np.full((8, 2), np.nan))
    with pytest.raises(InputError, match="no position of a press is known"):
        export_lerobot(unknown, tmp_path / "other")
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"more: LeRobot needs pyarrow: pip install 'padforge\[formats\]'"):
        export_lerobot(eight, tmp_path / "more")
