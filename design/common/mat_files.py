"""MATLAB files of all versions and HDF5 files, checked before they are read so that no file can exhaust the memory.

SciPy and h5py decode the numbers. What is checked here is what they take on trust: sizes that a file claims, values in
other files, and elements such as cell arrays, which take far more memory than file.
"""

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import MAX_VALUES, InputError, short_repr

MAX_FILE_BYTES = 2**33
MAX_OBJECTS = 10_000  # groups and datasets of a file, or fields of a structure
MAX_DEPTH = 64  # groups within groups: the HDF5 library visits them by recursion
MAX_UNPACKED_BYTES = 2**29  # of the variables, unpacked and as float64; the longest published recording is far smaller
FREE_BYTES, MAX_COMPRESSION = 2**26, 64  # size that is always allowed, and compression ratio that a larger one may have

_MATRIX, _COMPRESSED = 14, 15
_NUMERIC_ELEMENTS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}
_STRUCTURE, _TEXT, _OPAQUE, _NUMERIC_CLASSES, _COMPLEX = 2, 4, 17, range(6, 16), 0x800
_CLASSES = {1: "a cell array", 2: "a structure", 3: "an object", 4: "text", 5: "a sparse matrix", 17: "an object"}


class Hdf5Reader:
    """The datasets of an open HDF5 file, of which at most MAX_VALUES values together are read.

    Its `names` are the paths of the datasets that are reached without a link and have all values in the file.
    """

    def __init__(self, file: Any) -> None:
        """List the datasets; refuse more than MAX_OBJECTS groups and datasets, or MAX_DEPTH nested groups."""
        import h5py

        self._file, self._remaining, self._datasets, objects = file, MAX_VALUES, dict[str, Any](), set[str]()

        def visit(name: str, node: Any) -> None:
            objects.add(name)
            if len(objects) > MAX_OBJECTS:
                raise InputError(f"it holds more than {MAX_OBJECTS} groups and datasets")
            if name.count("/") >= MAX_DEPTH:
                raise InputError(f"it has groups within groups, more than {MAX_DEPTH} of them")
            if isinstance(node, h5py.Dataset) and not (node.is_virtual or node.external):
                self._datasets[name] = node

        file.visititems(visit)
        self.names = list(self._datasets)

    def read_text(self, name: str) -> str | None:
        """Return a text attribute of the file; None if there is none of that name."""
        import h5py

        if name not in self._file.attrs:
            return None
        attribute = self._file.attrs.get_id(name)
        if attribute.shape != () or h5py.check_string_dtype(attribute.dtype) is None:
            raise InputError(f"attribute {name} is no text")
        value = self._file.attrs[name]
        return value.decode() if isinstance(value, bytes) else str(value)

    def is_numeric(self, name: str) -> bool:
        """Whether a dataset holds real numbers or truth values."""
        return self._datasets[name].dtype.kind in "fiub"

    def read(self, name: str) -> NDArray[Any]:
        """Read the values of a dataset; raise InputError if they are no real numbers or more than is allowed."""
        if (dataset := self._datasets.get(name)) is None:
            raise InputError(f"{name} is no dataset, expected one with all of its values in this file")
        if dataset.size is None or dataset.size > self._remaining:
            raise InputError(f"{name} holds {dataset.size} values, allowed are {MAX_VALUES} in all that is read")
        if not self.is_numeric(name):
            raise InputError(f"{name} holds {dataset.dtype} values, expected an array of real numbers")
        stored = dataset.id.get_storage_size()
        claimed = max(dataset.size, prod(dataset.chunks or (0,))) * dataset.dtype.itemsize
        if claimed > max(FREE_BYTES, MAX_COMPRESSION * stored):
            raise InputError(f"{name} claims {claimed} bytes of {dataset.dtype} in {stored} of the file")
        self._remaining -= dataset.size
        return np.asarray(dataset)


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5Reader]:
    """Open an HDF5 file for reading; report errors of the body, too, as an InputError that names the file."""
    import h5py

    valid = check_file(path, MAX_FILE_BYTES)
    try:
        with h5py.File(valid, "r") as file:
            yield Hdf5Reader(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # h5py raises many kinds on torn files
        raise InputError(f"{path}: no HDF5 file that can be read ({' '.join(str(error).split())})") from error


def load_mat(path: Path, required: tuple[str, ...]) -> dict[str, Any]:
    """Read the variables of a MATLAB file.

    Args:
        path: the file, of any version.
        required: names of variables that it must have.

    Returns:
        By name: an array of a full real matrix, in its stored type; a dictionary of the fields of a structure; of
        anything else what it is, as text ("a cell array").
    """
    try:
        with check_file(path, MAX_FILE_BYTES).open("rb") as file:
            is_hdf5 = b"\x89HDF\r\n\x1a\n" in file.read(520)  # from 7.3 on, where 512 bytes of text precede it
        content = _load_hdf5(path) if is_hdf5 else _load_matrices(read_bytes(path))
    except InputError:
        raise
    except Exception as error:  # SciPy raises many kinds on torn files
        raise InputError(f"{path}: not a readable MATLAB file, torn or of another kind ({error})") from error
    if missing := [name for name in required if name not in content]:
        present = ", ".join(sorted(content)) or "nothing"
        raise InputError(f"{path}: has no variable {', '.join(missing)} (found {present})")
    return content


def _load_hdf5(path: Path) -> dict[str, Any]:
    """Read MATLAB 7.3: arrays are transposed, structures are groups, and #refs# holds what cell arrays refer to."""
    content = dict[str, Any]()
    with open_hdf5(path) as file:
        for name in filter(file.is_numeric, file.names):
            structure, _, field = name.rpartition("/")
            if "/" not in structure and not structure.startswith("#"):
                (content.setdefault(structure, {}) if structure else content)[field] = file.read(name).T
    return content


def _load_matrices(stored: bytes) -> dict[str, Any]:
    """Read MATLAB 4 to 7.2: check every variable, and let SciPy decode those that are safe to read."""
    import scipy.io

    content, safe = _check_version_4(stored) if 0 in stored[:4] else _check_version_5(memoryview(stored))
    if names := [name for name, description in content.items() if not description]:
        with warnings.catch_warnings(action="ignore"):  # variables of one name
            values = scipy.io.loadmat(io.BytesIO(safe), variable_names=names)
        content |= {name: _to_plain(values[name]) for name in names if name in values}
    return content


def _to_plain(value: NDArray[Any]) -> Any:
    if value.dtype.names:
        return {field: _to_plain(value[0, 0][field]) for field in value.dtype.names}
    if value.dtype.kind in "fiub":
        return value.astype(value.dtype.newbyteorder("="))
    return {"c": "complex", "U": "text"}.get(value.dtype.kind, "a structure")


def _check_version_4(stored: bytes) -> tuple[dict[str, Any], bytes]:
    """Describe the variables of version 4 by name, as `_check_version_5`."""
    descriptions, position = dict[str, Any](), 0
    order = "<" if 0 <= struct.unpack_from("<i", stored)[0] < 5000 else ">"
    while position < len(stored):
        code, rows, columns, imaginary, n_letters = struct.unpack_from(f"{order}5i", stored, position)
        name = _decode(stored[position + 20 : position + 20 + n_letters])
        descriptions[name] = ("", "text", "a sparse matrix")[code % 10]
        size = rows * columns * (8, 4, 4, 2, 2, 1)[code // 10 % 10] * (2 if imaginary else 1)
        position += 20 + n_letters + size
        if min(rows, columns, n_letters) < 0 or position > len(stored):
            raise ValueError(f"{name} claims more values than there are")
    return descriptions, stored


def _check_version_5(stored: memoryview) -> tuple[dict[str, Any], bytes]:
    """Describe the variables of version 5 to 7.2 by name, those safe to read as ""; return also a file of these."""
    order, safe, descriptions, n_unpacked, n_values = "<>"[stored[126:128] == b"MI"], [stored[:128]], {}, 0, 0
    max_bytes = min(MAX_UNPACKED_BYTES, max(FREE_BYTES, MAX_COMPRESSION * len(stored)))
    for kind, payload, element in _elements(stored[128:], order):
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            content = memoryview(unpacker.decompress(payload, max(max_bytes - n_unpacked, 1)))
            n_unpacked += len(content)
            if not unpacker.eof:
                raise ValueError(f"it ends early, or unpacks to more than {max_bytes} bytes")
            kind, payload, element = next(_elements(content, order))
        if kind != _MATRIX:
            raise ValueError(f"it has an element of kind {kind}, expected a variable")
        name, description, size = _check_matrix(payload, order)
        n_values += size + 1000  # what a variable takes in memory besides its values
        if 8 * n_values > max_bytes:
            raise ValueError(f"it holds more than {max_bytes // 8} values")
        if name:  # functions keep their own variables without a name
            descriptions[name] = description
            safe += [] if description else [element]
    return descriptions, b"".join(safe)


def _check_matrix(payload: memoryview, order: str, is_field: bool = False) -> tuple[str, str, int]:
    """Return the name of a variable, what it is ("" if safe to read), and how many numbers it holds."""
    if is_field and not payload:
        return "", "", 0
    parts = list(islice(_elements(payload, order), MAX_OBJECTS))
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    kind = flags & 0xFF
    name = _decode(parts[1 if kind == _OPAQUE else 2][1])
    shape = [0] if kind == _OPAQUE else np.frombuffer(parts[1][1], f"{order}i4").tolist()
    if len(shape) > 32 or min(shape, default=-1) < 0:
        raise ValueError(f"{name} has shape {short_repr(shape)}")
    if flags & _COMPLEX:
        return name, "complex", 0
    size = prod(shape)
    if kind in _NUMERIC_CLASSES or (kind == _TEXT and is_field):
        element, data, _ = parts[3]
        if (kind != _TEXT and element not in _NUMERIC_ELEMENTS) or size > len(data):
            raise ValueError(f"{name} claims {size} values in {len(data)} bytes of kind {element}")
        return (name, "text", 0) if kind == _TEXT else (name, "", size)
    is_flat = kind == _STRUCTURE and size == 1 and not is_field and len(parts) < MAX_OBJECTS
    if is_flat and all(part[0] == _MATRIX for part in parts[5:]):
        fields = [_check_matrix(field, order, is_field=True) for _, field, _ in parts[5:]]
        if {what for _, what, _ in fields} <= {"", "text"}:
            return name, "", sum(n for _, _, n in fields)
    return name, _CLASSES.get(kind, "a function or an object"), 0


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview, memoryview]]:
    """Yield the elements that lie one behind the other: their kind, their data, and both with the header."""
    position = 0
    while position + 8 <= len(content):
        kind, length = struct.unpack_from(f"{order}II", content, position)
        start = position + 8
        end = start + length + (-length % 8 if kind != _COMPRESSED else 0)
        if kind >> 16:  # a short one, whose data are in the last four bytes of the header
            kind, length, start, end = kind & 0xFFFF, kind >> 16, position + 4, position + 8
        if start + length > min(end, len(content)):
            raise ValueError("it ends early")
        yield kind, content[start : start + length], content[position:end]
        position = end


def _decode(name: bytes | memoryview) -> str:
    return bytes(name).split(b"\0")[0].decode("latin1")
