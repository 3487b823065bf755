"""Recordings from and to HDF5, and from MATLAB files such as those of the published study.

An exported HDF5 file has the datasets `times_s` (R,), `readings_v` (R, C), `presses_mm` (Q, 2), `down_command` and
`up_command` (Q,), and `depths_mm`, `reached_mm` and `forces_n` (Q,) if any press has them; the attribute `source` is
JSON. The states of an arm are not exported. Other files are read by a mapping (`columns`).
"""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from padforge.common.files import atomic_file, reraise_write_error
from padforge.common.mat_files import flatten_variables, load_mat, open_hdf5
from padforge.common.validation import InputError, join_names, naming_file
from padforge.sense.arrays import Array
from padforge.sense.formats.assembly import MEASURES, Arrays, ForeignArrays, assemble_recording
from padforge.sense.formats.columns import (
    check_export,
    check_import,
    match_columns,
    order_notes,
    parse_columns,
    read_entries,
)
from padforge.sense.recording.recording import NOTE, Recording

FORMAT = "padforge-hdf5/2"
_DATASETS = {name: name for name in ("times_s", "presses_mm", "down_command", "up_command")}
_DATASETS["readings_v"] = "readings"
"""Datasets, and their attributes of a `Recording`."""
CYCLE, DOWN_AT = 40, 20  # readings of a published press, and the one at which the probe is sent down


def export_hdf5(recording: Recording, path: str | Path) -> None:
    """Write a recording as HDF5, atomically; importing it gives the same numbers.

    Args:
        recording: recording to write.
        path: path of the file, which is replaced.

    Raises:
        InputError: the file cannot be written.
    """
    import h5py

    path = check_export(recording, path)
    with (
        reraise_write_error(path),
        atomic_file(path) as temporary,
        h5py.File(temporary, "w", track_order=True, locking=False) as file,
    ):
        file.attrs["format"] = FORMAT
        file.attrs["source"] = json.dumps(dict(recording.source))
        arrays = {name: getattr(recording, attribute) for name, attribute in _DATASETS.items()}
        measures = {name: getattr(recording, name) for name in MEASURES.values()}
        arrays |= {name: values for name, values in measures.items() if not np.isnan(values).all()}
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip", shuffle=True, track_times=False)


def import_hdf5(path: str | Path, columns: str = "", presses: Arrays = ()) -> Recording:
    """Read a recording from an HDF5 file.

    Args:
        path: path of the file.
        columns: mapping of its datasets, such as `time=/t,fibres=/data/volts`; by default those of `export_hdf5`.
        presses: presses from a separate table, see `read_presses`.
    """
    path, columns = check_import(path, columns)
    if columns:
        with open_hdf5(path) as file:
            mapped = _map_arrays(path, "hdf5", columns, "/", file.names, file.read)
        return assemble_recording(mapped, presses)
    with open_hdf5(path) as file:
        check_no_presses(presses)
        if (file_format := file.read_text("format")) != FORMAT:
            raise InputError(
                f"format is {file_format!r}, expected {FORMAT!r}; columns (--columns) say what other datasets hold, "
                f"there are {join_names(file.names)}"
            )
        content: dict[str, Any] = {attribute: file.read(name) for name, attribute in _DATASETS.items()}
        content |= {name: file.read(name) for name in MEASURES.values() if name in file.names}
        source = file.read_text("source")
    try:
        return Recording(**content, source=json.loads(source or ""))
    except ValueError as error:  # also an InputError
        raise InputError(f"{path}: {error}") from error


def import_mat(path: str | Path, columns: str = "", presses: Arrays = ()) -> Recording:
    """Read a recording from a MATLAB file, by default as published.

    Published files have `voltage` (R, C), V, `pos` (2, Q), mm, and `tim` (1, R), s, with 40 readings a press. `pos` may
    be (Q, 2); positions are unknown without it, or where it is NaN. If the last press is cut off, it is omitted, but
    its readings are kept, since the previous press needs them. Readings may follow the last press.

    Args:
        path: path of the file.
        columns: mapping of its variables, such as `time=data.t,fibres=data.volts` or `time=x[0],fibres=x[1:9]`.
        presses: presses from a separate table, see `read_presses`.
    """
    path, columns = check_import(path, columns)
    content = flatten_variables(load_mat(path, ()))
    with naming_file(path):
        for name, value in content.items():
            is_named = not columns or re.search(rf"= */?{re.escape(name)}\b", columns)
            if is_named and isinstance(value, str) and "only MATLAB" in value:
                raise InputError(f"{name} is {value}")
        if not columns:
            return _import_published(path, content, presses)
        mapped = _map_arrays(path, "mat", columns, ".", list(content), lambda name: _matrix(content, name))
    return assemble_recording(mapped, presses)


def _map_arrays(
    path: Path, kind: str, columns: str, separator: str, names: Sequence[str], read: Callable[[str], Array]
) -> ForeignArrays:
    """Return the arrays that a mapping names; its names may be paths that begin with a slash."""
    entries = [
        entry._replace(name=entry.name.removeprefix("/").replace("/", separator)) for entry in parse_columns(columns)
    ]
    matched = match_columns(entries, names)
    arrays = read_entries(matched, lambda i: read(names[i]))
    return ForeignArrays(path, arrays, {"kind": kind, "file": path.name, "columns": columns}, order_notes(matched))


def check_no_presses(presses: Arrays) -> None:
    """Raise InputError if there is a separate table of presses for a complete recording."""
    if presses:
        raise InputError("holds presses itself, expected no --presses, or --columns that name its readings")


def describe_arrays(path: Path) -> list[str]:
    """Return a line for each dataset or variable of an HDF5 or MATLAB file."""
    if path.suffix.lower() != ".mat":
        with open_hdf5(path) as file:
            return [
                f"/{name}: {file.describe(name)}{_first_values(file.read(name)) if file.is_numeric(name) else ''}"
                for name in file.names
            ]
    content = flatten_variables(load_mat(path, ()))
    texts = {
        name: f"{value.shape} {value.dtype}{_first_values(value)}" if isinstance(value, np.ndarray) else value
        for name, value in content.items()
    }
    return [f"{name}: {text}" for name, text in texts.items()]


def _first_values(values: Array) -> str:
    return ", begins " + ", ".join(f"{value:.6g}" for value in values.ravel()[:3].tolist())


def _import_published(path: Path, content: dict[str, Any], presses: Arrays) -> Recording:
    if missing := [name for name in ("voltage", "tim") if name not in content]:
        problem = f"has no variable {', '.join(missing)} (found {join_names(sorted(content))})"
        raise InputError(f"{problem}; --columns says what others hold, as time=data.t,fibres=data.v or fibres=x[1:5]")
    check_no_presses(presses)
    voltage, times = _matrix(content, "voltage"), _matrix(content, "tim").ravel()
    n_cycles = len(voltage) // CYCLE if voltage.ndim == 2 else 0
    if n_cycles == 0:
        raise InputError(f"voltage has shape {voltage.shape}, expected at least {CYCLE} rows")
    positions = _matrix(content, "pos") if "pos" in content else np.full((2, n_cycles), np.nan)
    if positions.ndim != 2 or 2 not in positions.shape or 0 in positions.shape:
        raise InputError(f"pos has shape {positions.shape}, expected (2, presses)")
    positions = positions.T if positions.shape[0] == 2 else positions
    n_presses = len(positions)
    if n_presses > n_cycles + 1:
        raise InputError(
            f"voltage has shape {voltage.shape}, expected {CYCLE} rows for each of the {n_presses} presses of pos, "
            f"{CYCLE * n_presses} in all; only the last may be cut off"
        )
    source, n_more = {"kind": "published", "file": path.name}, len(voltage) - CYCLE * n_presses
    if n_more > 0:
        source[NOTE] = f"the last {n_more} readings belong to no press"
    elif n_more < 0:
        source[NOTE] = f"the last of {n_presses} presses is left out, with {CYCLE + n_more} of {CYCLE} readings"
    positions = positions[:n_cycles]
    starts = CYCLE * np.arange(len(positions))
    return Recording(voltage, times, positions, starts + DOWN_AT, starts + CYCLE, source)


def _matrix(content: dict[str, Any], name: str) -> Array:
    values = content[name]
    if not isinstance(values, np.ndarray):
        raise InputError(f"{name} is {values}, expected a full matrix of real numbers")
    return values.astype(np.float64)
