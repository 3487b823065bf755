"""Recordings as HDF5: an export made of a finished run directory, for other programs; never written to while recording.

Datasets: `times_s` (R,), `readings_v` (R, C), `presses_mm` (Q, 2), `begun` and `lifted` (Q,); the attribute `source` is
JSON text. The states of an arm stay in the run directory.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.common.errors import InputError
from design.common.files import atomic, require_file, writing
from sense.recordings.processing.limits import MAX_BYTES, MAX_VALUES

from .recording import Recording

FORMAT = "padforge-hdf5/1"
PACKED = 1040
"""Bytes that a byte of a file may stand for, at most: gzip packs no closer than 1032 to 1."""
_ARRAYS = {"times_s": "times_s", "readings_v": "readings"} | {key: key for key in ("presses_mm", "begun", "lifted")}
"""Names of the datasets and of what they hold of a `Recording`."""


def export_hdf5(recording: Recording, path: str | Path) -> None:
    """Write a recording as HDF5, atomically; importing it gives the same numbers.

    Raises:
        InputError: `path` cannot be written.
    """
    import h5py

    path = Path(path)
    with writing(path), atomic(path) as temporary, h5py.File(temporary, "w", track_order=True) as file:
        file.attrs["format"] = FORMAT
        file.attrs["source"] = json.dumps(dict(recording.source))
        for name, attribute in _ARRAYS.items():
            values = getattr(recording, attribute)
            file.create_dataset(name, data=values, compression="gzip", shuffle=True, track_times=False)


def import_hdf5(path: str | Path) -> Recording:
    """Read a recording that `export_hdf5` wrote.

    Raises:
        InputError: the file is missing, torn, of another kind, or its datasets do not fit together.
    """
    import h5py

    path = Path(path)
    require_file(path, MAX_BYTES)
    try:
        with h5py.File(path, "r") as file:
            kind = file.attrs.get("format")
            if kind != FORMAT:
                raise InputError(f"{path}: format is {kind!r}, expected {FORMAT!r}")
            arrays: dict[str, Any] = {attribute: _values(file, name) for name, attribute in _ARRAYS.items()}
            source = json.loads(str(file.attrs["source"]))
    except InputError:
        raise
    except Exception as error:  # h5py raises whatever a torn file leads it to
        raise InputError(f"{path}: not a recording that can be read ({' '.join(str(error).split())})") from error
    try:
        return Recording(**arrays, source=source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _values(file: Any, name: str) -> NDArray[Any]:
    """The values of a dataset, which may claim more than any memory holds, since what was never written takes no room.

    Raises:
        ValueError: there is no such dataset, it is too large, or larger than what it was packed from.
    """
    import h5py

    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{name} is no dataset")
    if dataset.size is None or dataset.size > MAX_VALUES:
        raise ValueError(f"{name} holds {dataset.size} values, allowed are {MAX_VALUES}")
    if dataset.nbytes > PACKED * dataset.id.get_storage_size():
        raise ValueError(
            f"{name} claims {dataset.nbytes} bytes of {dataset.dtype} in {dataset.id.get_storage_size()} of the file"
        )
    return np.asarray(dataset)
