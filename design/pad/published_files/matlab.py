"""MATLAB files of all versions: the variables that are plain numbers, and none that takes more memory than it may."""

from pathlib import Path
from typing import Any

from padforge.design.common.errors import InputError
from padforge.design.common.files import read_bytes, require_file

from .hdf5_datasets import MOST_FILE_BYTES, plain_datasets
from .matlab_elements import read_elements

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
    with require_file(path, MOST_FILE_BYTES).open("rb") as file:
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
