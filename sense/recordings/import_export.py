"""Recordings from files and to files, by the ends of their names."""

from collections.abc import Callable
from pathlib import Path

from design.common.errors import InputError
from design.pad.published_files.matlab import load_mat

from .formats.csv_recording import export_csv, import_csv
from .formats.hdf5 import export_hdf5, import_hdf5
from .formats.published_mat import import_mat
from .recording import Recording

_READERS: dict[str, Callable[[Path, str], Recording]] = {
    ".mat": import_mat,
    **dict.fromkeys((".csv", ".tsv", ".txt"), import_csv),
    **dict.fromkeys((".h5", ".hdf5"), import_hdf5),
}
_WRITERS: dict[str, Callable[[Recording, Path], None]] = {".csv": export_csv, ".h5": export_hdf5}
FILES = tuple(_READERS)
"""Ends of the names of files that hold a recording."""


def open_recording(path: str | Path) -> Recording:
    """A recording, wherever it lies: a run directory, finished or not, or a file that `import_file` knows.

    Raises:
        InputError: as `Recording.open` and `import_file`.
    """
    path = Path(path)
    return import_file(path) if path.suffix.lower() in FILES and not path.is_dir() else Recording.open(path)


def is_recording(path: Path) -> bool:
    """Whether a path is that of a recording: a folder, or a file that holds readings."""
    if path.suffix.lower() == ".mat" and path.is_file():
        return "voltage" in load_mat(path, ())
    return path.is_dir() or path.suffix.lower() in FILES


def import_file(path: Path, mapping: str = "") -> Recording:
    """Read a recording from a MATLAB, CSV or HDF5 file, by the end of its name; a `mapping` tells what it holds.

    Raises:
        InputError: a name with another end, or as the reader of that format.
    """
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {', '.join(_READERS)}")
    return _READERS[path.suffix.lower()](path, mapping)


def export_file(recording: Recording, path: Path) -> None:
    """Write a recording as .csv or .h5, by the end of the name.

    Raises:
        InputError: a name with another end, or `path` cannot be written.
    """
    if path.suffix.lower() not in _WRITERS:
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {', '.join(_WRITERS)}")
    _WRITERS[path.suffix.lower()](recording, path)
