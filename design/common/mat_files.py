"""MATLAB files of all versions: the variables that are plain numbers, and none that takes more memory than it may."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import MAX_VALUES, InputError

MOST_FILE_BYTES = 2**33
"""Size of the largest file that is looked at."""
MOST_OBJECTS = 10_000
"""Most groups and datasets of a file."""
MOST_DEPTH = 64
"""Groups within groups: each is looked up by its whole path."""
FREE_BYTES, PACKED = 2**26, 64
"""What a dataset may always take, bytes; beyond, it takes at most so many bytes for each that it has of the file."""


class Datasets:
    """The datasets of an open file, by their paths without the first slash.

    All that is read takes at most MOST_VALUES values together.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self._left = MAX_VALUES
        self._names: list[str] | None = None

    @property
    def names(self) -> list[str]:
        """All datasets that no link leads to, in the order of their names.

        Raises:
            InputError: there are more than MOST_OBJECTS things in the file, or groups in more than MOST_DEPTH others.
        """
        import h5py

        if self._names is None:
            found, seen = [], 0

            def visit(name: str, each: Any) -> bool | None:
                nonlocal seen
                seen += 1
                if name.count("/") >= MOST_DEPTH:
                    raise InputError(f"it has groups within groups, more than {MOST_DEPTH} of them")
                if isinstance(each, h5py.Dataset):
                    found.append(name)
                return True if seen > MOST_OBJECTS else None

            if self._file.visititems(visit):
                raise InputError(f"it holds more than {MOST_OBJECTS} groups and datasets")
            self._names = found
        return self._names

    @property
    def numbers(self) -> list[str]:
        """Those of `names` that hold numbers."""
        return [name for name in self.names if self._file[name].dtype.kind in "fiub"]

    def text(self, name: str) -> str | None:
        """An attribute of the file that is one text; None where there is none."""
        import h5py

        if name not in self._file.attrs:
            return None
        about = h5py.h5a.open(self._file.id, name.encode())
        if about.shape != () or h5py.check_string_dtype(about.dtype) is None:
            raise InputError(f"attribute {name} is no text")
        value = self._file.attrs[name]
        return value.decode() if isinstance(value, bytes) else str(value)

    def read(self, name: str) -> NDArray[Any]:
        """The values of a dataset, real numbers or truth values.

        Raises:
            InputError: there is no such dataset, it is not plain, no numbers, or claims more than is allowed.
        """
        dataset = self._plain(name)
        if dataset.size is None or dataset.size > self._left:
            raise InputError(f"{name} holds {dataset.size} values, allowed are {MAX_VALUES} in all that is read")
        if dataset.dtype.kind not in "fiub":
            raise InputError(f"{name} holds {dataset.dtype} values, expected an array of real numbers")
        stored = dataset.id.get_storage_size()
        piece = int(np.prod(dataset.chunks, dtype=np.float64)) if dataset.chunks else 0
        claimed = max(dataset.size, piece) * dataset.dtype.itemsize
        if claimed > max(FREE_BYTES, PACKED * stored):
            raise InputError(f"{name} claims {claimed} bytes of {dataset.dtype} in {stored} of the file")
        self._left -= dataset.size
        return np.asarray(dataset)

    def _plain(self, name: str) -> Any:
        """The dataset of that name, if all of it lies in this file."""
        import h5py

        node: Any = self._file
        for part in name.split("/"):
            link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
            if link is None:
                raise InputError(f"there is no dataset {name}")
            if not isinstance(link, h5py.HardLink):
                raise InputError(f"{name} is a link to elsewhere, expected a dataset of this file")
            node = node[part]
        if not isinstance(node, h5py.Dataset):
            raise InputError(f"{name} is no dataset")
        if node.is_virtual or node.external:
            raise InputError(f"{name} has its values in other files, expected a dataset of this file")
        return node


@contextmanager
def plain_datasets(path: Path) -> Iterator[Datasets]:
    """Open an HDF5 file for reading.

    Raises:
        InputError: nothing there, no file, one of more than MOST_FILE_BYTES, torn or of another kind, or what went
            wrong meanwhile; the message names the file.
    """
    import h5py

    path = check_file(path, MOST_FILE_BYTES)
    try:
        with h5py.File(path, "r") as file:
            yield Datasets(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # h5py raises whatever a torn file leads it to
        raise InputError(f"{path}: no HDF5 file that can be read ({' '.join(str(error).split())})") from error


MOST_BYTES = 2**29
"""What the variables of a file may take, unpacked and as floating point numbers; the longest published recording is far
below."""
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Kinds of elements that are numbers."""
_MATRIX, _PACKED = 14, 15
_STRUCTURE, _OPAQUE = 2, 17
_CLASSES = {1: "a cell array", _STRUCTURE: "a structure", 3: "an object", 4: "text", 5: "a sparse matrix"}
"""What variables may be that are no full matrices of numbers, which are classes 6 to 15."""
_COMPLEX = 0x800
_MOST_SIDES = 32
"""Of a matrix: the product of very many takes time that grows with their square."""
_STORED_4, _KINDS_4 = ("f8", "f4", "i4", "i2", "u2", "u1"), ("", "text", "a sparse matrix")

Value = NDArray[Any] | dict[str, Any] | str


def read_elements(stored: bytes) -> dict[str, Value]:
    """The variables of a MATLAB file by name, in its order.

    Returns:
        Of a full real matrix the numbers, as they are stored; of a structure the same by the names of its fields; of
        anything else what it is, in words.

    Raises:
        ValueError, struct.error, zlib.error: the file is torn, of another kind, or claims more than it holds or may.
    """
    content = _Content(stored)
    found: dict[str, Value] = {}
    variables = content.of_version_4() if 0 in stored[:4] else content.variables()
    for count, (name, value) in enumerate(variables):
        if count == MOST_OBJECTS:
            raise ValueError(f"it holds more than {MOST_OBJECTS} variables")
        if name:  # what has none, functions keep their own variables in
            found[name] = value
    return found


class _Content:
    """The bytes of a file, and how many of those that it may take are left."""

    def __init__(self, stored: bytes) -> None:
        self._stored = memoryview(stored)
        self._most = min(MOST_BYTES, max(FREE_BYTES, PACKED * len(stored)))
        self._unpacked = self._values = 0

    def of_version_4(self) -> Iterator[tuple[str, Value]]:
        """Name and value of every variable of a file without a header."""
        stored, at = self._stored, 0
        order = "<" if 0 <= struct.unpack_from("<i", stored)[0] < 5000 else ">"
        while at < len(stored):
            code, rows, columns, imaginary, letters = struct.unpack_from(f"{order}5i", stored, at)
            name = _name(stored[at + 20 : at + 20 + letters])
            at += 20 + letters
            kind, number = code % 10, code // 10 % 10
            if min(rows, columns, letters) < 0 or not 0 <= code < 5000 or kind > 2 or number > 5:
                raise ValueError("it has no header of MATLAB")
            values = np.dtype(order + _STORED_4[number])
            size = rows * columns * values.itemsize
            data = stored[at : at + size]
            at += size * (2 if imaginary else 1)
            if at > len(stored):
                raise ValueError(f"{name} claims more values than there are")
            told = _KINDS_4[kind] or ("complex" if imaginary else "")
            yield name, told or self._numbers(data, values, (rows, columns), name)

    def variables(self) -> Iterator[tuple[str, Value]]:
        """Name and value of every variable of a file with a header."""
        orders = {b"IM": "<", b"MI": ">"}
        order = orders.get(bytes(self._stored[126:128]))
        if order is None:
            raise ValueError("it has no header of MATLAB")
        elements = _Elements(self._stored[128:], order)
        while elements.left >= 8:
            kind, data = elements.next()
            if kind == _PACKED:
                kind, data = _Elements(self._unpack(data), order).next()
            if kind != _MATRIX:
                raise ValueError(f"it has an element of kind {kind}, expected a variable")
            yield self._matrix(data, order)

    def _unpack(self, packed: memoryview) -> memoryview:
        unpacker, allowed = zlib.decompressobj(), self._most - self._unpacked
        content = unpacker.decompress(packed, allowed + 1)
        if len(content) > allowed:
            raise ValueError(f"it unpacks to more than {self._most} bytes")
        if not unpacker.eof:
            raise ValueError("it ends early")
        self._unpacked += len(content)
        return memoryview(content)

    def _matrix(self, content: memoryview, order: str, within: bool = False) -> tuple[str, Value]:
        """Name and value of a variable, or of a field `within` one."""
        if not content:  # a field that nothing was put into
            return "", np.empty((0, 0))
        parts = _Elements(content, order)
        (flags,) = struct.unpack_from(f"{order}I", parts.next()[1])
        kind = flags & 0xFF
        if kind == _OPAQUE:
            return _name(parts.next()[1]), "an object"
        sides = parts.numbers()
        name = _name(parts.next()[1])
        if len(sides) > _MOST_SIDES:
            raise ValueError(f"{name} has {len(sides)} dimensions, allowed are {_MOST_SIDES}")
        shape = tuple(int(length) for length in sides)
        if min(shape, default=-1) < 0:
            raise ValueError(f"{name} has shape {shape}")
        if kind == _STRUCTURE and prod(shape) == 1 and not within:
            return name, self._structure(parts, order)
        if not 6 <= kind <= 15:
            return name, _CLASSES.get(kind, "a function or an object")
        if flags & _COMPLEX:
            return name, "complex"
        stored, data = parts.next()
        if stored not in _STORED:
            raise ValueError(f"{name} has an element of kind {stored}, expected numbers")
        return name, self._numbers(data, np.dtype(order + _STORED[stored]), shape, name)

    def _structure(self, parts: "_Elements", order: str) -> dict[str, Any]:
        """What the fields of a structure hold, one of their own in words."""
        length = int(parts.numbers()[0])
        names = parts.next()[1]
        if length < 1 or len(names) > length * MOST_OBJECTS:
            raise ValueError(f"it has a structure of more than {MOST_OBJECTS} fields")
        starts = range(0, len(names), length)
        return {_name(names[at : at + length]): self._matrix(parts.next()[1], order, within=True)[1] for at in starts}

    def _numbers(self, data: memoryview, kind: "np.dtype[Any]", shape: tuple[int, ...], name: str) -> NDArray[Any]:
        """Values of a shape that is as large as what is there, by columns, in an array of its own."""
        claimed = prod(shape)
        if claimed * kind.itemsize != len(data):
            raise ValueError(f"{name} claims {claimed} values in {len(data)} bytes of {kind.name}")
        self._values += claimed
        if 8 * self._values > self._most:
            raise ValueError(f"it holds more than {self._most // 8} values")
        return np.frombuffer(data, kind).reshape(shape, order="F").astype(kind.newbyteorder("="))


class _Elements:
    """Elements that lie one behind the other: each says its kind and how many bytes it has."""

    def __init__(self, content: memoryview, order: str) -> None:
        self._content, self._order, self._at = content, order, 0

    @property
    def left(self) -> int:
        """Bytes that are not read yet."""
        return len(self._content) - self._at

    def next(self) -> tuple[int, memoryview]:
        """Kind and bytes of the next element."""
        kind, length = struct.unpack_from(f"{self._order}II", self._content, self._at)
        begin = self._at + 8
        if kind >> 16:  # a short one, whose bytes stand where else their number does
            kind, length, begin = kind & 0xFFFF, kind >> 16, begin - 4
            if length > 4:
                raise ValueError("it has a short element that is long")
            self._at = begin + 4
        else:
            self._at = begin + length + (-length % 8 if kind != _PACKED else 0)
        if begin + length > len(self._content):
            raise ValueError("it ends early")
        return kind, self._content[begin : begin + length]

    def numbers(self) -> NDArray[Any]:
        """The numbers of the next element."""
        kind, data = self.next()
        if kind not in _STORED:
            raise ValueError(f"it has an element of kind {kind}, expected numbers")
        return np.frombuffer(data, self._order + _STORED[kind])


def _name(content: memoryview) -> str:
    return bytes(content).split(b"\0")[0].decode(errors="replace")


_HDF5, _TEXT = b"\x89HDF\r\n\x1a\n", 512
"""How HDF5 begins, and the length of the text that MATLAB puts before it from version 7.3 on."""


def load_mat(path: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    """Read a MATLAB file and see that it holds the variables `needed`.

    Returns:
        Numbers by name, those of a structure by the names of its fields, and of what is neither what it is, in words.

    Raises:
        InputError: the file is missing, torn, no MATLAB file, lacks a variable, or claims more than it holds or may.
    """
    try:
        content = _load_hdf5(path) if _is_hdf5(path) else read_elements(read_bytes(path))
    except InputError:
        raise
    except Exception as error:  # whatever a torn stream leads to
        raise InputError(f"{path}: not a readable MATLAB file, torn or of another kind ({error})") from error
    missing = [name for name in needed if name not in content]
    if missing:
        found = ", ".join(sorted(name for name in content if not name.startswith("__"))) or "nothing"
        raise InputError(f"{path}: has no variable {', '.join(missing)} (found {found})")
    return content


def _is_hdf5(path: Path) -> bool:
    with check_file(path, MOST_FILE_BYTES).open("rb") as file:
        start = file.read(_TEXT + len(_HDF5))
    return _HDF5 in (start[: len(_HDF5)], start[_TEXT:])


def _load_hdf5(path: Path) -> dict[str, Any]:
    """Numbers as MATLAB has them, whose columns are the rows of HDF5."""
    content: dict[str, Any] = {}
    structures: dict[str, dict[str, Any]] = {}
    with plain_datasets(path) as file:
        for name in file.numbers:
            owner, _, inner = name.rpartition("/")
            if not owner:
                content[name] = file.read(name).T
            elif "/" not in owner and not owner.startswith("#"):  # what MATLAB refers to lies in #refs#
                structures.setdefault(owner, {})[inner] = file.read(name).T
    return content | structures
