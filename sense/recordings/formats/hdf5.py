"""Recordings as HDF5: an export made of a finished run directory, for other programs; never written to while recording.

Datasets: `times_s` (R,), `readings_v` (R, C), `presses_mm` (Q, 2), `begun` and `lifted` (Q,), and `depths_mm`,
`reached_mm` and `forces_n` (Q,) where any is known; the attribute `source` is JSON text. The states of an arm stay in
the run directory. Files of other programs are told by a mapping (see `mapping`).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from padforge.design.common.files import atomic_file, reraise_write_error
from padforge.design.common.mat_files import open_hdf5
from padforge.design.common.validation import InputError
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.formats.assembly import MEASURES, assembled
from padforge.sense.recordings.formats.mapping import chosen, file_and_mapping, listed, parse_mapping
from padforge.sense.recordings.formats.model_findings import export_path

FORMAT = "padforge-hdf5/1"
_ARRAYS = {"times_s": "times_s", "readings_v": "readings"} | {key: key for key in ("presses_mm", "begun", "lifted")}
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
