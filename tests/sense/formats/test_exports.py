"""What every format holds of one small recording, what `import --show` says of files, and datasets of many files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import scipy.io
from rosbags.rosbag2 import Reader

from padforge.common.validation import InputError
from padforge.sense import FibreFault, Localization, Recording, export_bag, export_csv, export_hdf5, export_lerobot
from padforge.sense.formats import lerobot
from padforge.sense.formats.import_export import describe_file, export_file, import_file
from padforge.sense.localizer.model import MeasureEstimate
from tests.helpers.golden import Golden, json_text
from tests.helpers.power_cut import ON_LINUX, Disk

from .foreign import STORE, array, as_json, make, pose, write_bag

NAN = float("nan")


@pytest.fixture
def three() -> Recording:
    """Three presses of two fibres in fifteen readings at 8 Hz; a position and a force are not known."""
    readings = np.round(2 - np.outer(np.arange(15) % 5 > 2, [0.25, 0.125]) + np.arange(15)[:, None] / 100, 3)
    readings[1, 1] = NAN
    return Recording(
        readings,
        100 + np.arange(15) / 8,
        np.array([[1.0, -2.0], [3.5, 4.0], [NAN, NAN]]),
        np.array([3, 8, 13]),
        np.array([5, 10, 15]),
        {"kind": "test", "rig": {"mirrored": False}},
        depths_mm=np.array([5.0, 2.5, 4.0]),
        reached_mm=np.array([4.75, 2.25, NAN]),
        forces_n=np.array([1.5, NAN, 0.75]),
    )


@pytest.fixture
def localization() -> Localization:
    """A model that predicts depth for two of the presses."""
    positions = np.array([[1.5, -2.5], [3.0, 4.5], [0.0, 1.0]]), np.array([[0.5, 0.25], [1.0, 2.0], [3.0, 4.0]])
    depth = MeasureEstimate(np.array([4.0, 2.0, NAN]), np.array([0.5, 0.25, NAN]))
    return Localization(*positions, np.ones(3), np.array([1.25, 2.25, 9.0]), {"depth_mm": depth})


def test_csv_and_hdf5(three: Recording, golden: Golden, tmp_path: Path) -> None:
    export_csv(three, tmp_path / "three.csv")
    golden("formats/export.csv", (tmp_path / "three.csv").read_text())
    export_hdf5(three, tmp_path / "three.h5")
    with h5py.File(tmp_path / "three.h5") as file:
        about = {name: f"{data.dtype} {data.shape} {data[()].ravel()[:4].tolist()}" for name, data in file.items()}
        golden("formats/hdf5.json", {"attributes": dict(file.attrs), "datasets": about})


@pytest.mark.parametrize("mirrored", [False, True])
def test_bag(three: Recording, localization: Localization, golden: Golden, tmp_path: Path, mirrored: bool) -> None:
    """All messages, but for readings beyond the first two; of a mirrored pad those with a z; and they are read back."""
    states = np.array([[100.0, 100, 200, 300, 0, 0, np.pi / 2, 1, 0, 0], [101.0, 400, 500, 600, 0, 0, 0, 0, 0, 0]])
    states = np.vstack([np.full((1, 10), -5.0), states, np.full((1, 10), NAN)])  # times that no stamp can hold
    recording = replace(three, source={"kind": "test", "rig": {"mirrored": mirrored}})
    faults = [FibreFault(1, 0, (1,), "stuck", 99)]
    export_bag(recording, tmp_path / "three.mcap", localization, faults, (0,), states)
    left_out = ("/pad/recording", "/pad/readings", "/pad/health", "/pad/pressed", "/arm/pose") if mirrored else ()
    lines = []
    with Reader(tmp_path / "three.mcap") as reader:
        for connection, stamp, data in reader.messages():
            message = as_json(STORE.deserialize_cdr(data, connection.msgtype))
            if connection.topic == "/pad/recording":
                message = json.loads(message["data"])
            if connection.topic not in left_out and (connection.topic != "/pad/readings" or stamp < 100.2e9):
                lines.append(f"{stamp / 1e9:.3f} {connection.topic} {connection.msgtype} {compact(message)}")
    golden(f"formats/bag{'_mirrored' * mirrored}.txt", "\n".join(lines))
    assert import_file(tmp_path / "three.mcap") == recording


def compact(value: Any) -> str:
    """JSON in one line, without what is 0 or empty, and arrays of 36 as the values that are not 0."""
    if isinstance(value, dict):
        texts = {name: compact(part) for name, part in value.items()}
        parts = (f"{name}: {text}" for name, text in texts.items() if text not in ("0", "''", "[]", "{}"))
        return f"{{{', '.join(parts)}}}"
    if isinstance(value, list) and len(value) == 36:
        return str({at: number for at, number in enumerate(value) if number})
    if isinstance(value, list):
        return f"[{', '.join(map(compact, value))}]"
    return f"{value:.9g}" if isinstance(value, float) else repr(value)


@patch.multiple(lerobot, FILE_MB=800 / 2**20, CHUNK_FILES=1)
def test_lerobot(three: Recording, localization: Localization, golden: Golden, tmp_path: Path) -> None:
    """All files, each of an episode and in a folder of its own, with the statistics of one feature."""
    known = replace(three, forces_n=np.array([1.5, 2.0, 0.75]))
    export_lerobot(known, tmp_path / "set", localization)
    for path in sorted((tmp_path / "set").rglob("*.parquet")):
        table = pq.read_table(path)
        names = [name for name in table.column_names if not name.startswith("stats/") or "/observation.force" in name]
        rows = [" | ".join(str(row[name]) for name in names) for row in table.to_pylist()]
        kinds = " | ".join(f"{name} {table.schema.field(name).type}" for name in names)
        name = "_".join(path.relative_to(tmp_path).with_suffix("").parts[1:])
        groups = f"row groups: {pq.ParquetFile(path).num_row_groups}"
        golden(f"formats/lerobot/{name}.txt", "\n".join([groups, kinds, *rows]))
    golden("formats/lerobot/info.json", json_text(json.loads((tmp_path / "set/meta/info.json").read_text())))
    statistics = json.loads((tmp_path / "set/meta/stats.json").read_text())
    golden("formats/lerobot/stats.txt", "\n".join(f"{name}: {values}" for name, values in statistics.items()))


def test_descriptions_and_sources_of_files(golden: Golden, tmp_path: Path) -> None:
    """What `import --show` prints of each format, and what an import then remembers of the file."""
    rows = "\n".join(f"{50 * i},{1.5 + 0.1 * (i % 8 > 3)},{i},{i % 8 // 4}" for i in range(40))
    (tmp_path / "units.csv").write_text(f"t,c2,c10 [mV],on\nms,V,,\n{rows}\n", encoding="utf-8")
    (tmp_path / "bare.txt").write_text(rows.replace(",", " "), encoding="utf-8")
    time_s, volts, on = np.arange(40) / 20, np.ones((40, 2)) + np.arange(40)[:, None] / 100, np.arange(40) % 8 // 4
    scipy.io.savemat(tmp_path / "lab.mat", {"data": {"t": time_s, "v": volts}, "on": on * 1.0, "name": "pad"})
    with h5py.File(tmp_path / "lab.h5", "w") as file:
        file["log/t"], file["log/v"], file["on"], file["note"] = time_s, volts, on, "bench 2"
    messages = [("/skin", t, array("Float64MultiArray", v)) for t, v in zip(time_s, volts, strict=True)]
    messages += [("/on", t + 0.001, make("Bool", bool(down))) for t, down in zip(time_s, on, strict=True)]
    bag = write_bag(
        tmp_path / "bag", [*messages, ("/probe", 0.1, pose(0.01, 0.02)), ("/words", 0.1, make("String", ""))]
    )
    mappings = {
        tmp_path / "units.csv": "time=t,fibres=c*,press=on",
        tmp_path / "bare.txt": "time=1:ms,fibres=2-3:mV,press=4",
        tmp_path / "lab.mat": "time=data.t,fibres=data.v[0:2],press=on",
        tmp_path / "lab.h5": "time=/log/t,fibres=/log/v,press=/on",
        bag: "fibres=/skin,press=/on,positions=/probe:cm",
    }
    lines = []
    for path, mapping in mappings.items():
        recording = import_file(path, mapping)
        numbers = float(recording.times_s[1]), recording.readings[1].tolist(), recording.down_command.tolist()
        lines += [f"-- {path.name}", *describe_file(path), f"{numbers}", f"{dict(recording.source)}"]
    golden("formats/show.txt", "\n".join(lines))


@pytest.fixture(scope="module")
def eight(eight: Recording) -> Recording:
    """Eight presses of known depth, one at an unknown position, with missing readings."""
    return replace(eight, depths_mm=np.where(np.isnan(eight.depths_mm), 1.5, eight.depths_mm))


@ON_LINUX
def test_export_lerobot_outlasts_a_power_cut(eight: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, path = Disk(monkeypatch), tmp_path / "new" / "data"
    export_file(eight, path, "lerobot")
    files = [file for file in path.rglob("*") if file.is_file()]
    assert all(disk.read(file) == file.read_bytes() for file in files)
    assert all(disk.has_name(folder) for folder in (path.parent, path, *path.rglob("*")))


@pytest.mark.parametrize(("slower", "fps"), [(1.0, 13), (10.0, 1.34), (0.05, 268)])
def test_export_lerobot_rounds_rates(eight: Recording, tmp_path: Path, slower: float, fps: float) -> None:
    one_fibre = replace(eight, readings=eight.readings[:, :1], times_s=eight.times_s * slower)
    export_lerobot(one_fibre, tmp_path / "set")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["fps"] == pytest.approx(fps, rel=0.02)
    assert isinstance(info["fps"], int) == (slower < 2)
    assert (info["chunks_size"], info["data_files_size_in_mb"]) == (1000, 100)
    assert info["features"]["observation.state"]["shape"] == [1]
    table = pq.ParquetFile(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert (table.num_row_groups, table.metadata.num_rows) == (7, info["total_frames"])


def test_export_lerobot_writes_all_or_nothing(eight: Recording, tmp_path: Path) -> None:
    full = patch.object(lerobot, "write_json", side_effect=OSError(28, "No space left on device"))
    with full, pytest.raises(InputError, match=r"set: cannot be written \(No space left"):
        export_lerobot(eight, tmp_path / "set")
    assert not list(tmp_path.iterdir())
    (tmp_path / "set").mkdir()
    export_lerobot(eight, tmp_path / "set")  # an empty folder is filled
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["total_frames"] == 7 * 40  # of known positions
