"""HDF5 files of anyone, read with care: plain numbers that lie in the file itself, and no more of them than stated.

HDF5 can take values from other files, by links, virtual datasets and external storage, and can claim far more of them
than it holds. Neither is followed: such a dataset is refused before anything is read or memory asked for.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from padforge.design.common.errors import MOST_VALUES, InputError
from padforge.design.common.files import require_file

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
        self._left = MOST_VALUES
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
            raise InputError(f"{name} holds {dataset.size} values, allowed are {MOST_VALUES} in all that is read")
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

    path = require_file(path, MOST_FILE_BYTES)
    try:
        with h5py.File(path, "r") as file:
            yield Datasets(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # h5py raises whatever a torn file leads it to
        raise InputError(f"{path}: no HDF5 file that can be read ({' '.join(str(error).split())})") from error
