"""Import and export of recordings, by the extension of the file."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from padforge.common.mat_files import load_mat
from padforge.common.validation import InputError, check_path
from padforge.sense.arrays import Array
from padforge.sense.formats.csv_recording import describe_table, export_csv, import_csv, read_presses
from padforge.sense.formats.hdf5_mat import describe_arrays, export_hdf5, import_hdf5, import_mat
from padforge.sense.formats.lerobot import export_lerobot
from padforge.sense.formats.ros_recording import METADATA, SUFFIXES, describe_bag, export_bag, import_bag
from padforge.sense.recording.block_file import read_blocks
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import START, STATE_COLUMNS, STATES

if TYPE_CHECKING:
    from padforge.sense.health.fault_detector import FibreFault
    from padforge.sense.localizer.model import Localization

_TABLES = (".csv", ".tsv", ".txt", ".log", ".dat")
_ADVICE = dict.fromkeys((".xlsx", ".xls", ".ods"), "save the sheet as CSV UTF-8") | {
    ".npz": "padforge.sense.Recording.from_arrays takes arrays",
    ".npy": "padforge.sense.Recording.from_arrays takes arrays",
}
_READERS: dict[str, Callable[..., Recording]] = {
    ".mat": import_mat,
    **dict.fromkeys(_TABLES, import_csv),
    **dict.fromkeys((".h5", ".hdf5"), import_hdf5),
    **dict.fromkeys(SUFFIXES, import_bag),
}
_WRITERS: dict[str, Callable[[Recording, Path], None]] = {".csv": export_csv, ".h5": export_hdf5}


def open_recording(path: str | Path) -> Recording:
    """Open a recording.

    Args:
        path: path of a run directory, finished or not, or of a file that `import_file` reads without a mapping.

    Raises:
        InputError: it is neither, or damaged.
    """
    path = check_path("path", path)
    is_file = path.suffix.lower() in _READERS and not path.is_dir()
    return import_file(path) if is_file or _is_bag_folder(path) else Recording.open(path)


def _is_bag_folder(path: Path) -> bool:
    return path.is_dir() and (path / METADATA).is_file() and not (path / START).exists()


def is_recording(path: Path) -> bool:
    """Return whether a path is a folder, or a file that may contain a recording; a .mat must have its `voltage`."""
    if path.suffix.lower() == ".mat" and path.is_file():
        return "voltage" in load_mat(path, ())
    return path.is_dir() or path.suffix.lower() in _READERS


def import_file(
    path: Path, columns: str = "", encoding: str = "", presses: Path | None = None, press_columns: str = ""
) -> Recording:
    """Read a recording from a table, an HDF5 or MATLAB file, or a bag, by its extension, or from a rosbag2 folder.

    `columns` is the mapping of a foreign file, `presses` a table of presses with the mapping `press_columns` for a file
    of readings only, and `encoding` that of tables, which is detected by default.
    """
    read = find_reader(path)
    if encoding and read is not import_csv:
        raise InputError(f"{path}: --encoding is of tables, allowed with {', '.join(_TABLES)}")
    options = {"encoding": encoding} if encoding else {}
    return read(path, columns, **options, presses=read_presses(presses, press_columns, encoding) if presses else ())


def find_reader(path: Path) -> Callable[..., Recording]:
    """Return the function that imports a path, by its extension; InputError if there is none."""
    if _is_bag_folder(path):
        return import_bag
    extension = path.suffix.lower()
    if extension not in _READERS:
        hint = f"; {_ADVICE[extension]}" if extension in _ADVICE else ""
        raise InputError(
            f"{path}: ends in {path.suffix!r}, allowed are {', '.join(_READERS)}, or a rosbag2 folder{hint}"
        )
    return _READERS[extension]


def describe_file(path: Path, encoding: str = "") -> list[str]:
    """Return a line for each column, dataset, variable or topic of a file: name, shape, unit and first values."""
    read = find_reader(path)
    if read is import_csv:
        return describe_table(path, encoding)
    return describe_bag(path) if read is import_bag else describe_arrays(path)


def arm_states(path: Path) -> Array | None:
    """Return the states (n, 10) of the arm in a run directory, by `STATE_COLUMNS`; None if it has none."""
    file = path / STATES
    return np.column_stack(read_blocks(file, len(STATE_COLUMNS) - 1)) if file.is_file() else None


def export_file(
    recording: Recording,
    path: Path,
    kind: str = "",
    localization: "Localization | None" = None,
    faults: "Sequence[FibreFault] | None" = None,
    dead: Sequence[int] = (),
    states: Array | None = None,
) -> None:
    """Write a recording as .csv, .h5 or .mcap, by the extension, or as a LeRobot dataset if the kind is "lerobot".

    Only .mcap and LeRobot hold predicted positions; only .mcap holds faults and dead fibres (see `export_bag`), and the
    states that `arm_states` returns.
    """
    extension = path.suffix.lower()
    if kind == "lerobot":
        export_lerobot(recording, path, localization)
    elif extension == ".mcap":
        export_bag(recording, path, localization, faults, dead, states)
    elif extension not in _WRITERS:
        allowed = f"{', '.join(_WRITERS)}, .mcap, or --format lerobot"
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {allowed}")
    elif localization is not None:
        raise InputError(f"{path}: predictions of a model can be written as .mcap or lerobot only")
    else:
        _WRITERS[extension](recording, path)
