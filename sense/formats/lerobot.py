"""Recordings as LeRobot datasets v3.0: folders of Parquet files that policies are trained from.

An episode is a press with half of the rest before it and half of the rest after it; a frame is a reading. Frames have
the `timestamp` of one rate that the format wants, and in `observation.time` when they were read since the first of
their episode, s.

See `lerobot.datasets` of https://github.com/huggingface/lerobot (0.6), which reads it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import reraise_write_error, temporary_folder, write_json
from padforge.design.common.validation import InputError
from padforge.sense.arrays import Indices
from padforge.sense.formats.annotations import ModelFindings, export_path
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import refuse_existing

if TYPE_CHECKING:
    import pyarrow as pa


VERSION = "v3.0"
TASK = "Press the pad."
FILE_MB, CHUNK_FILES = 100, 1000
"""Most of one data file, and files in a folder, as the format has them by default."""
MOST_OFF = 0.05
"""Rates that are so near a whole number, by part of it, are called that number, which the format wants."""
_MB = 2**20
_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
_Column = NDArray[Any]


def export_lerobot(recording: Recording, path: Path, findings: ModelFindings | None = None) -> None:
    """Write a recording as a LeRobot dataset, a folder that appears whole or not at all.

    Features are `observation.state`, the readings in V, NaN where one is missing; `action`, where the press of the
    episode is commanded, with its depth where that is known of all, and whether the probe is down; `observation.force`
    where it is known of all; and `observation.touch`, what `findings` say once a press is over. Presses of unknown
    place are no episodes.

    Raises:
        InputError: pyarrow is not installed, no place is known, `path` exists and is not an empty folder, or cannot be
            written.
    """
    path = export_path(recording, path, findings)
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise InputError(f"{path}: LeRobot needs pyarrow: pip install 'padforge[lerobot]'") from error
    refuse_existing(path)
    if not recording.known.any():
        raise InputError(f"{path}: no place of a press is known, and a dataset needs what was commanded")
    starts, ends = _episodes(recording)
    columns, names = _columns(recording, starts, ends, findings)
    path = path.resolve()
    with reraise_write_error(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(path.parent) as folder:
            _write(folder / path.name, columns, names, ends - starts, _rate(recording.rate_hz))
            if path.exists():
                path.rmdir()
            (folder / path.name).rename(path)


def _rate(hz: float) -> float:
    whole = max(round(hz), 1)
    return whole if abs(whole / hz - 1) <= MOST_OFF else hz


def _episodes(recording: Recording) -> tuple[Indices, Indices]:
    """(E,) first readings of episodes, and those after their last."""
    middle = (recording.up_command[:-1] + recording.down_command[1:]) // 2
    starts, ends = np.append(0, middle), np.append(middle, len(recording.readings))
    return starts[recording.known], ends[recording.known]


def _columns(
    recording: Recording, starts: Indices, ends: Indices, findings: ModelFindings | None
) -> tuple[dict[str, _Column], dict[str, list[str] | None]]:
    """Columns of (n, k) or (n,) values of n frames, by the features of the format, and the names of the k."""
    lengths = ends - starts
    frames = np.concatenate([np.arange(start, end) for start, end in zip(starts, ends, strict=True)])
    episode = np.repeat(np.arange(len(lengths)), lengths)
    inside = frames - starts[episode]
    named = _named_values(recording, frames, np.flatnonzero(recording.known)[episode], findings)
    columns = {name: np.column_stack(list(parts.values())).astype(np.float32) for name, parts in named.items()}
    names: dict[str, list[str] | None] = {name: list(parts) for name, parts in named.items()}
    columns = {name: values[:, 0] if values.shape[1] == 1 else values for name, values in columns.items()}
    counted = {
        "timestamp": (inside / _rate(recording.rate_hz)).astype(np.float32),
        "frame_index": inside,
        "episode_index": episode,
        "index": np.arange(len(frames)),
        "task_index": np.zeros(len(frames), np.int64),
    }
    return columns | counted, names | dict.fromkeys(counted)


def _named_values(
    recording: Recording, frames: Indices, press: Indices, findings: ModelFindings | None
) -> dict[str, dict[str, _Column]]:
    """(n,) values of n frames, each in an episode of a `press`, by the feature and the name that each has in it."""
    x, y = recording.presses_mm[press].T
    action = {"x_mm": x, "y_mm": y}
    if not np.isnan(recording.depths_mm[press]).any():
        action["depth_mm"] = recording.depths_mm[press]
    down = (frames >= recording.down_command[press]) & (frames < recording.up_command[press])
    first = np.append(0, np.flatnonzero(np.diff(press)) + 1)
    since = recording.times_s[frames[first]]
    features = {
        "observation.state": {f"fibre_{i}_v": recording.readings[frames, i] for i in range(recording.fibres)},
        "observation.time": {"time_s": recording.times_s[frames] - since[np.searchsorted(press[first], press)]},
    }
    if not np.isnan(recording.forces_n[press]).any():
        features["observation.force"] = {"force_n": np.where(down, recording.forces_n[press], 0)}
    if findings is not None:
        over = frames >= recording.up_command[press]
        x, y = findings.positions_mm[press].T
        told = {"x_mm": x, "y_mm": y, "r90_mm": findings.r90_mm[press], "found": np.ones(len(press))}
        features["observation.touch"] = {name: np.where(over, values, 0) for name, values in told.items()}
    return {**features, "action": {**action, "down": down}}


def _write(
    folder: Path, columns: Mapping[str, _Column], names: Mapping[str, list[str] | None], lengths: Indices, fps: float
) -> None:
    """Write data, episodes, tasks, statistics and what there is, into a folder."""
    import pyarrow as pa

    ends = np.cumsum(lengths)
    files = (ends - 1) * sum(values[:1].nbytes for values in columns.values()) // (FILE_MB * _MB)
    table = pa.table({name: _arrow(values) for name, values in columns.items()})
    for number in np.unique(files):
        mine = np.flatnonzero(files == number)
        _write_table(folder / "data" / _numbered(number), table, (ends - lengths)[mine].tolist(), ends[mine].tolist())
    episodes = {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[TASK]] * len(lengths),
        "length": lengths,
        "data/chunk_index": files // CHUNK_FILES,
        "data/file_index": files % CHUNK_FILES,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
    }
    for name, values in columns.items():
        parts = [_statistics(values[end - length : end]) for length, end in zip(lengths, ends, strict=True)]
        episodes |= {f"stats/{name}/{which}": [part[which] for part in parts] for which in parts[0]}
    episodes |= {f"meta/episodes/{which}": np.zeros(len(lengths), np.int64) for which in ("chunk_index", "file_index")}
    _write_table(folder / "meta" / "episodes" / _numbered(0), pa.table(episodes))
    _write_table(folder / "meta" / "tasks.parquet", _tasks())
    documents = {
        "info": _info(columns, names, lengths, fps),
        "stats": {name: _statistics(values) for name, values in columns.items()},
    }
    for name, document in documents.items():
        write_json(folder / "meta" / f"{name}.json", document)


def _info(
    columns: Mapping[str, _Column], names: Mapping[str, list[str] | None], lengths: Indices, fps: float
) -> dict[str, Any]:
    """What the format says of a dataset as a whole."""
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
        "data_path": f"data/{_PATH}",
        "video_path": None,
        "robot_type": "padforge",
        "splits": {"train": f"0:{len(lengths)}"},
    }


def _numbered(number: int) -> str:
    return _PATH.format(chunk_index=number // CHUNK_FILES, file_index=number % CHUNK_FILES)


def _arrow(values: _Column) -> "pa.Array":
    import pyarrow as pa

    flat = pa.array(values.ravel())
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _write_table(path: Path, table: "pa.Table", starts: Sequence[int] = (0,), ends: Sequence[int] = ()) -> None:
    """Write a Parquet file with a group of rows from each start to its end, or all in one."""
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    with parquet.ParquetWriter(path, table.schema, compression="snappy") as writer:
        for start, end in zip(starts, ends or (len(table),), strict=True):
            writer.write_table(table.slice(start, end - start))


def _tasks() -> "pa.Table":
    """The table of the one task, with its text as what pandas calls the index."""
    import pyarrow as pa

    column = {
        "metadata": None,
        "field_name": "task_index",
        "name": "task_index",
        "pandas_type": "int64",
        "numpy_type": "int64",
    }
    index = {"metadata": None, "field_name": "task", "name": "task", "pandas_type": "unicode", "numpy_type": "object"}
    about = {"index_columns": ["task"], "column_indexes": [], "columns": [column, index], "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


def _statistics(values: _Column) -> dict[str, Any]:
    """Statistics of the format for each of k values, missing ones left out; zeros where all are."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    rows = np.where(np.isnan(rows).all(axis=0), 0.0, rows)
    found = {
        "min": np.nanmin(rows, axis=0),
        "max": np.nanmax(rows, axis=0),
        "mean": np.nanmean(rows, axis=0),
        "std": np.nanstd(rows, axis=0),
    }
    quantiles = np.nanquantile(rows, _QUANTILES, axis=0)
    found |= {f"q{round(100 * at):02d}": each for at, each in zip(_QUANTILES, quantiles, strict=True)}
    return {name: each.tolist() for name, each in found.items()} | {"count": [len(rows)]}
