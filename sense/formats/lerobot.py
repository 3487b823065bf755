"""Recordings as LeRobot datasets v3.0: folders of Parquet files, on which policies are trained.

An episode is a press with half of the pause before it and half of the pause after it; a frame is a reading. `timestamp`
has the uniform rate that the format requires, and `observation.time` the measured times since the first frame of the
episode. `lerobot.datasets` of https://github.com/huggingface/lerobot (0.6) reads them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.common.files import make_folder, reraise_write_error, sync, temporary_folder, write_json
from padforge.common.validation import InputError
from padforge.sense.arrays import Indices
from padforge.sense.formats.columns import check_export
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import check_new_folder

if TYPE_CHECKING:
    import pyarrow as pa

    from padforge.sense.localizer.model import Localization

VERSION = "v3.0"
TASK = "Press the pad."
FILE_MB, CHUNK_FILES = 100, 1000  # size of a data file, and number of files in a folder: the format's defaults
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
_Column = NDArray[Any]


def export_lerobot(recording: Recording, path: Path, localization: "Localization | None" = None) -> None:
    """Write a recording as a LeRobot dataset, a folder that appears complete or not at all.

    Features are `observation.state`, the readings in V, NaN where missing; `action`, the commanded position, with the
    depth if all presses have one, and whether the probe is down; `observation.force` if all presses have one; and
    `observation.touch`, the prediction of a model after the end of a press. Presses of unknown position are omitted.

    Args:
        recording: recording to write.
        path: path of a folder that is new or empty.
        localization: predicted positions.
    """
    path = check_export(recording, path, localization)
    try:
        import pandas  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise InputError(f"{path}: LeRobot needs {error.name}: pip install 'padforge[formats]'") from error
    check_new_folder(path)
    if not recording.has_position.any():
        raise InputError(f"{path}: no position of a press is known, and a dataset needs what was commanded")
    middle = (recording.up_command[:-1] + recording.down_command[1:]) // 2
    starts = np.append(0, middle)[recording.has_position]
    ends = np.append(middle, len(recording.readings))[recording.has_position]
    columns, names = _build_columns(recording, starts, ends, localization)
    path = path.resolve()
    with reraise_write_error(path):
        make_folder(path.parent)
        with temporary_folder(path.parent) as folder:
            dataset = folder / path.name
            _write(dataset, columns, names, ends - starts, _frame_rate(recording))
            for content in (*dataset.rglob("*"), dataset):
                sync(content)
            if path.exists():
                path.rmdir()
            dataset.rename(path)
            sync(path.parent)


def _frame_rate(recording: Recording) -> float:
    integer = max(round(recording.rate_hz), 1)  # required by the format
    return integer if abs(integer / recording.rate_hz - 1) <= 0.05 else recording.rate_hz


def _build_columns(
    recording: Recording, starts: Indices, ends: Indices, localization: "Localization | None"
) -> tuple[dict[str, _Column], dict[str, list[str] | None]]:
    """Return the values of n frames, (n, k) or (n,), and the names of the k columns, by feature."""
    lengths = ends - starts
    frames = np.concatenate([np.arange(start, end) for start, end in zip(starts, ends, strict=True)])
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    frame_indices = frames - starts[episodes]
    presses = np.flatnonzero(recording.has_position)[episodes]
    down = (frames >= recording.down_command[presses]) & (frames < recording.up_command[presses])
    features: dict[str, dict[str, _Column]] = {
        "observation.state": {f"fibre_{i}_v": recording.readings[frames, i] for i in range(recording.fibres)},
        "observation.time": {"time_s": recording.times_s[frames] - recording.times_s[starts[episodes]]},
    }
    if not np.isnan(recording.forces_n[presses]).any():
        features["observation.force"] = {"force_n": np.where(down, recording.forces_n[presses], 0)}
    if localization is not None:
        x, y = localization.positions_mm[presses].T
        touch = {"x_mm": x, "y_mm": y, "r90_mm": localization.r90_mm[presses], "valid": np.ones(len(presses))}
        is_over = frames >= recording.up_command[presses]
        features["observation.touch"] = {name: np.where(is_over, values, 0) for name, values in touch.items()}
    x, y = recording.presses_mm[presses].T
    depth = recording.depths_mm[presses]
    features["action"] = {"x_mm": x, "y_mm": y, **({} if np.isnan(depth).any() else {"depth_mm": depth}), "down": down}
    columns = {name: np.column_stack(list(parts.values())).astype(np.float32) for name, parts in features.items()}
    columns = {name: values[:, 0] if values.shape[1] == 1 else values for name, values in columns.items()}
    indices = {
        "timestamp": (frame_indices / _frame_rate(recording)).astype(np.float32),
        "frame_index": frame_indices,
        "episode_index": episodes,
        "index": np.arange(len(frames)),
        "task_index": np.zeros(len(frames), np.int64),
    }
    return columns | indices, {name: list(parts) for name, parts in features.items()} | dict.fromkeys(indices)


def _write(
    folder: Path, columns: Mapping[str, _Column], names: Mapping[str, list[str] | None], lengths: Indices, fps: float
) -> None:
    import pandas
    import pyarrow as pa

    ends = np.cumsum(lengths)
    starts = ends - lengths
    frame_bytes = sum(values[:1].nbytes for values in columns.values())
    files = (ends - 1) * frame_bytes // int(FILE_MB * 2**20)
    flat = {name: pa.array(values.ravel()) for name, values in columns.items()}
    lists = {n: pa.FixedSizeListArray.from_arrays(flat[n], v.shape[1]) for n, v in columns.items() if v.ndim > 1}
    table = pa.table(flat | lists)
    for number in np.unique(files):
        in_file = np.flatnonzero(files == number)
        _write_table(folder / "data" / _file_name(number), table, starts[in_file].tolist(), ends[in_file].tolist())
    episodes = {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[TASK]] * len(lengths),
        "length": lengths,
        "data/chunk_index": files // CHUNK_FILES,
        "data/file_index": files % CHUNK_FILES,
        "dataset_from_index": starts,
        "dataset_to_index": ends,
    }
    for name, values in columns.items():
        parts = [_statistics(values[start:end]) for start, end in zip(starts, ends, strict=True)]
        episodes |= {f"stats/{name}/{statistic}": [part[statistic] for part in parts] for statistic in parts[0]}
    episodes |= {f"meta/episodes/{name}": np.zeros(len(lengths), np.int64) for name in ("chunk_index", "file_index")}
    _write_table(folder / "meta" / "episodes" / _file_name(0), pa.table(episodes))
    tasks = pandas.DataFrame({"task_index": [0]}, index=pandas.Index([TASK], dtype=object, name="task"))
    tasks.to_parquet(folder / "meta" / "tasks.parquet")
    write_json(folder / "meta" / "info.json", _info(columns, names, lengths, fps))
    write_json(folder / "meta" / "stats.json", {name: _statistics(values) for name, values in columns.items()})


def _info(
    columns: Mapping[str, _Column], names: Mapping[str, list[str] | None], lengths: Indices, fps: float
) -> dict[str, Any]:
    features = {
        name: {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": names[name]}
        for name, values in columns.items()
    }
    return {
        "codebase_version": VERSION,
        "fps": fps,
        "features": features,
        "total_episodes": len(lengths),
        "total_frames": int(lengths.sum()),
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "robot_type": "padforge",
        "splits": {"train": f"0:{len(lengths)}"},
    }


def _file_name(number: int) -> str:
    return _FILE.format(chunk_index=number // CHUNK_FILES, file_index=number % CHUNK_FILES)


def _write_table(path: Path, table: "pa.Table", starts: Sequence[int] = (0,), ends: Sequence[int] = ()) -> None:
    """Write a Parquet file with a row group from each start to its end, or one of all rows."""
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    with parquet.ParquetWriter(path, table.schema, compression="snappy") as writer:
        for start, end in zip(starts, ends or (len(table),), strict=True):
            writer.write_table(table.slice(start, end - start))


def _statistics(values: _Column) -> dict[str, Any]:
    """Return the statistics of each of k values over the frames that have it; zeros if none has."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    rows = np.where(np.isnan(rows).all(axis=0), 0.0, rows)
    quantile = np.nanquantile if np.isnan(rows).any() else np.quantile  # the same in a tenth of the time
    quantiles = quantile(rows, _QUANTILES, axis=0)
    statistics = {
        "min": np.nanmin(rows, axis=0),
        "max": np.nanmax(rows, axis=0),
        "mean": np.nanmean(rows, axis=0),
        "std": np.nanstd(rows, axis=0),
        **{f"q{round(100 * q):02d}": values for q, values in zip(_QUANTILES, quantiles, strict=True)},
    }
    return {name: each.tolist() for name, each in statistics.items()} | {"count": [len(rows)]}
