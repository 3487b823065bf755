"""LeRobot datasets of many episodes and files; what format v3.0 requires of one file, `test_exports.py` keeps whole."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from padforge.common.validation import InputError
from padforge.sense import Localization, Recording
from padforge.sense.formats import lerobot
from padforge.sense.formats.import_export import export_file
from padforge.sense.formats.lerobot import export_lerobot
from tests.helpers.power_cut import ON_LINUX, Disk


@pytest.fixture(scope="module")
def eight(eight: Recording) -> Recording:
    """Eight presses of known depth, one at an unknown position, with missing readings."""
    return replace(eight, depths_mm=np.where(np.isnan(eight.depths_mm), 1.5, eight.depths_mm))


def read_dataset(folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray], list[dict[str, Any]]]:
    """Return the info, the columns and the episodes of a dataset whose episodes are each a row group of their file."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    episodes = pq.read_table(folder / "meta" / "episodes").to_pylist()
    groups, opened = [], dict[Path, int]()
    for number, episode in enumerate(episodes):
        chunk, file = episode["data/chunk_index"], episode["data/file_index"]
        path = folder / info["data_path"].format(chunk_index=chunk, file_index=file)
        groups.append(pq.ParquetFile(path).read_row_group(opened.setdefault(path, 0)))
        opened[path] += 1
        assert set(groups[-1]["episode_index"].to_pylist()) == {number}
        assert groups[-1]["frame_index"].to_pylist() == list(range(episode["length"]))
    assert opened == {path: pq.ParquetFile(path).num_row_groups for path in (folder / "data").glob("*/*.parquet")}
    columns = {name: np.concatenate([np.array(each[name].to_pylist()) for each in groups]) for name in info["features"]}
    ends = np.cumsum([episode["length"] for episode in episodes])
    assert [episode["dataset_to_index"] for episode in episodes] == ends.tolist()
    assert columns["index"].tolist() == list(range(info["total_frames"])) == list(range(ends[-1]))
    return info, columns, episodes


@ON_LINUX
def test_export_lerobot_outlasts_a_power_cut(eight: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, path = Disk(monkeypatch), tmp_path / "new" / "data"
    export_file(eight, path, "lerobot")
    files = [file for file in path.rglob("*") if file.is_file()]
    assert all(disk.read(file) == file.read_bytes() for file in files)
    assert all(disk.has_name(folder) for folder in (path.parent, path, *path.rglob("*")))


def test_export_lerobot_puts_every_frame_in_an_episode(eight: Recording, tmp_path: Path) -> None:
    """With what a model predicts only once a press is over."""
    positioned = replace(eight, presses_mm=np.nan_to_num(eight.presses_mm))
    touches = Localization(np.full((8, 2), 3.0), np.ones((8, 2)), np.ones(8), np.full(8, 2.5))
    export_lerobot(positioned, tmp_path / "set", touches)
    info, columns, _ = read_dataset(tmp_path / "set")
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
    info, _, episodes = read_dataset(tmp_path / "set")
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
