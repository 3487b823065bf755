"""Recordings from files and to files, by the ends of their names."""

from collections.abc import Callable
from pathlib import Path

from padforge.design.common.mat_files import load_mat
from padforge.design.common.validation import InputError
from padforge.design.common.validation import check_path as as_path
from padforge.sense.arrays import Array
from padforge.sense.formats.annotations import ModelFindings
from padforge.sense.formats.csv_recording import export_csv, import_csv
from padforge.sense.formats.hdf5_mat import export_hdf5, import_hdf5, import_mat
from padforge.sense.formats.lerobot import export_lerobot
from padforge.sense.formats.ros_bag import METADATA, SUFFIXES
from padforge.sense.formats.ros_recording import export_bag, import_bag
from padforge.sense.recording.block_file import read_blocks
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import START, STATE_COLUMNS, STATES

_READERS: dict[str, Callable[[Path, str], Recording]] = {
    ".mat": import_mat,
    **dict.fromkeys((".csv", ".tsv", ".txt"), import_csv),
    **dict.fromkeys((".h5", ".hdf5"), import_hdf5),
    **dict.fromkeys(SUFFIXES, import_bag),
}
_WRITERS: dict[str, Callable[[Recording, Path], None]] = {".csv": export_csv, ".h5": export_hdf5}
_MCAP, _LEROBOT = ".mcap", "lerobot"
FILES = tuple(_READERS)
"""Ends of the names of files that hold a recording."""
FORMATS = (_LEROBOT,)
"""Formats that are folders, so that no end of a name tells them."""


def open_recording(path: str | Path) -> Recording:
    """A recording, wherever it lies: a run directory, finished or not, or what `import_file` knows.

    Raises:
        InputError: as `Recording.open` and `import_file`.
    """
    path = as_path("path", path)
    return import_file(path) if _is_bag(path) or _is_file(path) else Recording.open(path)


def _is_bag(path: Path) -> bool:
    """Whether a path is a rosbag2 folder."""
    return path.is_dir() and (path / METADATA).is_file() and not (path / START).exists()


def _is_file(path: Path) -> bool:
    return path.suffix.lower() in FILES and not path.is_dir()


def is_recording(path: Path) -> bool:
    """Whether a path is that of a recording: a folder, or a file that holds readings."""
    if path.suffix.lower() == ".mat" and path.is_file():
        return "voltage" in load_mat(path, ())
    return path.is_dir() or path.suffix.lower() in FILES


def import_file(path: Path, mapping: str = "") -> Recording:
    """Read a recording from a MATLAB, CSV, HDF5, MCAP or SQLite file, by the end of its name, or a rosbag2 folder.

    Args:
        mapping: tells what a file of another program holds.

    Raises:
        InputError: a name with another end, a folder that is no bag, or as the reader of that format.
    """
    if _is_bag(path):
        return import_bag(path, mapping)
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {', '.join(_READERS)}, or a rosbag2 folder")
    return _READERS[path.suffix.lower()](path, mapping)


def arm_states(path: Path) -> Array | None:
    """(n, 10) states of the arm in a run directory, by `STATE_COLUMNS`; None where there are none.

    Raises:
        InputError: their file is damaged elsewhere than at its end.
    """
    file = path / STATES
    return read_blocks(file, len(STATE_COLUMNS) - 1)[0] if file.is_file() else None


def export_file(
    recording: Recording,
    path: Path,
    kind: str = "",
    findings: ModelFindings | None = None,
    states: Array | None = None,
) -> None:
    """Write a recording as .csv, .h5 or .mcap, by the end of the name, or as a folder of a `kind` of `FORMATS`.

    Args:
        findings: what a model says of the recording; only .mcap and LeRobot can hold it.
        states: of the arm, by `STATE_COLUMNS`; they become a part of an .mcap.

    Raises:
        InputError: a name with another end, findings for what cannot hold them, or `check_path` cannot be written.
    """
    end = path.suffix.lower()
    if kind == _LEROBOT:
        export_lerobot(recording, path, findings)
    elif end == _MCAP:
        export_bag(recording, path, findings, states)
    elif end not in _WRITERS:
        folders = ", ".join(f"--format {name}" for name in FORMATS)
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {', '.join((*_WRITERS, _MCAP))}, or {folders}")
    elif findings is not None:
        raise InputError(f"{path}: what a model says can be written as {_MCAP} or {_LEROBOT} only")
    else:
        _WRITERS[end](recording, path)
