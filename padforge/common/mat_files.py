"""Reading of MATLAB files of all versions, and of HDF5 files: full matrices of real numbers, without external data."""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.common.files import check_file
from padforge.common.validation import InputError

MAX_BYTES = 2**33  # size limit of a file
# classes of MATLAB 7.3 whose datasets are not matrices of numbers
_OBJECTS = ("cell", "char", "table", "timetable", "string", "datetime", "duration", "categorical")


class Hdf5Reader:
    """The datasets of an open HDF5 file, without links and external data; columns of tables are datasets."""

    def __init__(self, file: Any) -> None:
        import h5py

        self._file, self._datasets = file, dict[str, Any]()

        def visit(name: str, node: Any) -> None:
            if isinstance(node, h5py.Dataset) and not (node.is_virtual or node.external):
                self._datasets[name] = node
                for column in node.dtype.names or ():  # a table of named columns
                    self._datasets[f"{name}/{column}"] = node.fields(column)

        file.visititems(visit)  # follows no links
        self.names = list(self._datasets)

    def read_text(self, name: str) -> str | None:
        """Return a text attribute of the file; None if it is missing."""
        value = self._file.attrs.get(name)
        if not isinstance(value, str | bytes | None):
            raise InputError(f"attribute {name} is not a text")
        return value.decode() if isinstance(value, bytes) else value

    def is_numeric(self, name: str) -> bool:
        return self._datasets[name].dtype.base.kind in "fiub"

    def describe(self, name: str) -> str:
        """Return the shape and the type of a dataset, for people."""
        import h5py

        dataset = self._datasets[name]
        is_text = h5py.check_string_dtype(dataset.dtype) is not None
        dtype = "table" if dataset.dtype.names else "text" if is_text else dataset.dtype
        return f"{getattr(dataset, 'shape', ('n',))} {dtype}"

    def matlab_class(self, name: str) -> str:
        """Return the class of a dataset by MATLAB 7.3; "" if it states none."""
        attribute = getattr(self._datasets[name], "attrs", {}).get("MATLAB_class", b"")
        return attribute.decode("ascii", "replace") if isinstance(attribute, bytes) else str(attribute)

    def read(self, name: str) -> NDArray[Any]:
        """Read the values of a dataset; raise InputError if they are not real numbers."""
        if (dataset := self._datasets.get(name)) is None:
            raise InputError(f"{name} is not readable, expected a dataset with all of its values in this file")
        if getattr(dataset, "size", 0) is None or not self.is_numeric(name):
            raise InputError(f"{name} holds {dataset.dtype} values, expected an array of real numbers")
        return np.asarray(dataset[()])


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5Reader]:
    """Open an HDF5 file for reading; all errors, also those of the body, become an InputError that names the file."""
    import h5py

    check_file(path, MAX_BYTES)
    try:
        with h5py.File(path, "r") as file:
            yield Hdf5Reader(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # h5py raises many types for damaged files
        raise InputError(f"{path}: not a readable HDF5 file ({' '.join(str(error).split())})") from error


def load_mat(path: Path, required: tuple[str, ...]) -> dict[str, Any]:
    """Read the variables of a MATLAB file of any version, by name; raise InputError if a `required` one is missing.

    A full real matrix is an array of its stored type, a structure a dictionary of its fields, and anything else a
    description, such as "a cell array".
    """
    try:
        with check_file(path, MAX_BYTES).open("rb") as file:
            is_hdf5 = b"\x89HDF\r\n\x1a\n" in file.read(520)  # MATLAB 7.3 writes 512 bytes of text before it
        content = _load_hdf5(path) if is_hdf5 else _load_matrices(path)
    except InputError:
        raise
    except Exception as error:  # SciPy raises many types for damaged files
        raise InputError(f"{path}: not a readable MATLAB file ({error})") from error
    if missing := [name for name in required if name not in content]:
        present = ", ".join(sorted(content)) or "nothing"
        raise InputError(f"{path}: has no variable {', '.join(missing)} (found {present})")
    return content


def flatten_variables(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the variables of `load_mat` in one dictionary, with names such as `data.t` for fields of structures."""
    flat = dict[str, Any]()
    for name, value in content.items():
        flat |= flatten_variables(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def _load_hdf5(path: Path) -> dict[str, Any]:
    """Read MATLAB 7.3, which is HDF5: arrays are transposed, structures are groups, #refs# has elements of cells."""
    content = dict[str, Any]()
    with open_hdf5(path) as file:
        for name in file.names:
            *structures, field = name.split("/")
            if name.startswith("#"):
                continue
            node = content
            for structure in structures:
                node = node.setdefault(structure, {})
            kind = file.matlab_class(name)
            is_matrix = file.is_numeric(name) and kind not in _OBJECTS
            description = _name_object("a cell array" if kind == "cell" else kind, field)
            node[field] = file.read(name).T if is_matrix else description
    return content


def _name_object(kind: str, name: str) -> str:
    """Describe a variable that is not a matrix, and how to export it from MATLAB."""
    if kind in ("table", "timetable"):
        return f"a {kind}, which only MATLAB reads: write{kind}({name}, '{name}.csv') there"
    return kind if kind.startswith("a ") else f"of class {kind or 'unknown'}"


def _load_matrices(path: Path) -> dict[str, Any]:
    """Read MATLAB 4 to 7.2."""
    import scipy.io

    with warnings.catch_warnings(action="ignore"):  # about duplicate names
        variables = scipy.io.loadmat(path, appendmat=False)
    content = dict[str, Any]()
    for name, value in variables.items():
        if isinstance(value, scipy.io.matlab.MatlabOpaque):  # SciPy's name for it is "None"
            name = value["s0"][0].decode("ascii", "replace")
        if not name.startswith("__"):
            content[name] = _to_plain(value, name)
    return content


def _to_plain(value: Any, name: str) -> Any:
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    if not isinstance(value, np.ndarray):
        return "a sparse matrix"
    if isinstance(value, MatlabOpaque):
        return _name_object(value["s2"][0].decode("ascii", "replace"), name)
    if isinstance(value, MatlabFunction | MatlabObject):
        return "a function or an object"
    if value.dtype.names:
        elements = [{field: _to_plain(element[field], field) for field in value.dtype.names} for element in value.flat]
        return elements[0] if len(elements) == 1 else {f"[{i}]": element for i, element in enumerate(elements)}
    if value.dtype.kind in "fiub":
        return value.astype(value.dtype.newbyteorder("="))
    return {"c": "complex", "U": "text", "O": "a cell array"}.get(value.dtype.kind, "a structure")
