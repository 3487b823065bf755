"""Recordings as HDF5: an export made of a finished run directory, for other programs; never written to while recording.
Datasets: `times_s` (R,), `readings_v` (R, C), `presses_mm` (Q, 2), `down_command` and `up_command` (Q,), and `depths_mm`,
`reached_mm` and `forces_n` (Q,) where any is known; the attribute `source` is JSON text. The states of an arm stay in
the run directory. Files of other programs are told by a mapping (see `mapping`).

Recordings of the published study, and others that lie in MATLAB files.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from padforge.design.common.files import atomic_file, reraise_write_error
from padforge.design.common.mat_files import load_mat, open_hdf5
from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array
from padforge.sense.formats.annotations import export_path
from padforge.sense.formats.columns import MEASURES, assembled, chosen, file_and_mapping, listed, parse_mapping
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-hdf5/2"
_ARRAYS = {"times_s": "times_s", "readings_v": "readings"} | {
    key: key for key in ("presses_mm", "down_command", "up_command")
}
"""Names of the datasets and of what they hold of a `Recording`."""
_KNOWN = tuple(MEASURES.values())
"""Datasets that are there where any of their values is known."""


def export_hdf5(recording: Recording, path: str | Path) -> None:
    """Write a recording as HDF5, atomically; importing it gives the same numbers.

    Raises:
        InputError: `path` cannot be written.
    """
    import h5py

    path = export_path(recording, path)
    with (
        reraise_write_error(path),
        atomic_file(path) as temporary,
        h5py.File(temporary, "w", track_order=True, locking=False) as file,
    ):
        file.attrs["format"] = FORMAT
        file.attrs["source"] = json.dumps(dict(recording.source))
        arrays = {name: getattr(recording, attribute) for name, attribute in _ARRAYS.items()}
        known = {name: getattr(recording, name) for name in _KNOWN}
        arrays |= {name: values for name, values in known.items() if not np.isnan(values).all()}
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip", shuffle=True, track_times=False)


def import_hdf5(path: str | Path, mapping: str = "") -> Recording:
    """Read a recording that `export_hdf5` wrote, or a file that a mapping tells, as `time=/t,fibres=/data/volts`.

    Raises:
        InputError: the file is missing, torn, of another kind, takes values from other files, or its datasets do not
            fit together.
    """
    path, mapping = file_and_mapping(path, mapping)
    if mapping:
        return _mapped(path, mapping)
    with open_hdf5(path) as file:
        kind = file.read_text("format")
        if kind != FORMAT:
            raise InputError(
                f"format is {kind!r}, expected {FORMAT!r}; a mapping tells what other datasets hold, "
                f"there are {listed(file.names)}"
            )
        arrays: dict[str, Any] = {attribute: file.read(name) for name, attribute in _ARRAYS.items()}
        arrays |= {name: file.read(name) for name in _KNOWN if name in file.names}
        source = file.read_text("source")
    try:
        return Recording(**arrays, source=json.loads(source or ""))
    except (InputError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: {error}") from error


def _mapped(path: Path, mapping: str) -> Recording:
    parts = [part._replace(name=part.name.removeprefix("/")) for part in parse_mapping(mapping)]
    with open_hdf5(path) as file:
        found = [(part, file.read(file.names[at])) for part, places in chosen(parts, file.names) for at in places]
    return assembled(path, found, {"kind": "hdf5", "file": path.name, "mapping": mapping})


READINGS_PER_PRESS = 40
"""Length of the published cycle of a press, readings."""
DOWN_AT = 20
"""Reading of the published cycle at which the probe is sent down; it is sent up at the end of the cycle."""
NOTE = "note"
"""What the source of a recording says that was left out of it."""


def import_mat(path: str | Path, mapping: str = "") -> Recording:
    """Read a recording from a MATLAB file: as published, or as a mapping of its variables tells (see `mapping`).

    Published are `voltage` (R, C) volts, `pos` (2, Q) mm, `tim` (1, R) s, 40 readings a press. `pos` may lie the other
    way, (Q, 2); without it, or where it is NaN, the places of the presses are unknown. The last press may be cut off:
    its readings are kept, as those of the press before need them, but it is no press. More readings may follow.

    Raises:
        InputError: the file is torn, of another kind, or its variables do not fit together.
    """
    path, mapping = file_and_mapping(path, mapping)
    return _mapped_mat(path, mapping) if mapping else _published(path)


def _published(path: Path) -> Recording:
    content = load_mat(path, ("voltage", "tim"))
    voltage, tim = (_numbers(content[name], f"{path}: {name}") for name in ("voltage", "tim"))
    if voltage.ndim != 2 or len(voltage) < READINGS_PER_PRESS:
        raise InputError(f"{path}: voltage has shape {voltage.shape}, expected at least {READINGS_PER_PRESS} rows")
    whole = len(voltage) // READINGS_PER_PRESS
    if "pos" in content:
        pos = _numbers(content["pos"], f"{path}: pos")
        if pos.ndim != 2 or 2 not in pos.shape or 0 in pos.shape:
            raise InputError(f"{path}: pos has shape {pos.shape}, expected (2, presses)")
        places = pos.T if pos.shape[0] == 2 else pos
    else:
        places = np.full((whole, 2), np.nan)
    if len(places) > whole + 1:
        raise InputError(
            f"{path}: voltage has shape {voltage.shape}, expected {READINGS_PER_PRESS} rows for each of the "
            f"{len(places)} presses of pos, {READINGS_PER_PRESS * len(places)} in all; only the last may be cut off"
        )
    source = {"kind": "published", "file": path.name} | _note(len(places), len(voltage))
    places = places[:whole]
    down_command = READINGS_PER_PRESS * np.arange(len(places)) + DOWN_AT
    try:
        return Recording(
            voltage, tim.ravel(), places, down_command, down_command - DOWN_AT + READINGS_PER_PRESS, source
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _note(presses: int, readings: int) -> dict[str, str]:
    """What the source says where presses and readings do not end together."""
    rest = readings - READINGS_PER_PRESS * presses
    if rest > 0:
        return {NOTE: f"the last {rest} readings belong to no press"}
    if rest < 0:
        there = READINGS_PER_PRESS + rest
        return {NOTE: f"the last of {presses} presses is left out, with {there} of {READINGS_PER_PRESS} readings"}
    return {}


def _mapped_mat(path: Path, mapping: str) -> Recording:
    parts = parse_mapping(mapping)
    content = load_mat(path, ())
    names = [name for name in content if not name.startswith("__")]
    try:
        found = [(part, names[at]) for part, places in chosen(parts, names) for at in places]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    arrays = [(part, _numbers(content[name], f"{path}: {name}")) for part, name in found]
    return assembled(path, arrays, {"kind": "mat", "file": path.name, "mapping": mapping})


def _numbers(values: object, what: str) -> Array:
    if not isinstance(values, np.ndarray):
        told = values if isinstance(values, str) else "a structure"
        raise InputError(f"{what} is {told}, expected a full matrix of real numbers")
    return values.astype(np.float64)
