"""MATLAB files of all versions: the variables that are plain numbers, and none that takes more memory than it may."""

import faulthandler
import io
import os
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from design.common.errors import InputError
from design.common.files import read_bytes, require_file

from .hdf5_datasets import MOST_FILE_BYTES, plain_datasets

MOST_BYTES = 2**29
"""Unpacked; the longest published recording is far below."""
MOST_MEMORY = 4 * MOST_BYTES
"""What reading may take: what is unpacked is there twice, and a few bytes can claim any number of cells."""
_PACKED, _PIECE = 15, 2**20
"""Kind of the elements of a MATLAB file that are packed, and how much of them is unpacked at a time, bytes."""
_HDF5, _TEXT = b"\x89HDF\r\n\x1a\n", 512
"""How HDF5 begins, and the length of the text that MATLAB puts before it from version 7.3 on."""


def load_mat(path: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    """Read a MATLAB file and see that it holds the variables `needed`.

    Of version 7.3, which is HDF5, numbers are read, and structures of them as SciPy gives those of earlier versions.

    Raises:
        InputError: the file is missing, torn, no MATLAB file, or lacks a variable.
    """
    try:
        content = _load_hdf5(path) if _is_hdf5(path) else _load_elements(path)
    except (InputError, ModuleNotFoundError):
        raise
    except Exception as error:  # both readers raise whatever a torn stream leads them to
        raise InputError(f"{path}: not a readable MATLAB file, torn or of another kind ({error})") from error
    missing = [name for name in needed if name not in content]
    if missing:
        found = ", ".join(sorted(name for name in content if not name.startswith("__"))) or "nothing"
        raise InputError(f"{path}: has no variable {', '.join(missing)} (found {found})")
    return content


def _is_hdf5(path: Path) -> bool:
    require_file(path, MOST_FILE_BYTES)
    with path.open("rb") as file:
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
    for name, fields in structures.items():
        content[name] = np.empty((1, 1), dtype=[(field, object) for field in fields])
        content[name][0, 0] = tuple(fields.values())
    return content


def _load_elements(path: Path) -> dict[str, Any]:
    import scipy.io  # noqa: F401  here, not first in the child that tries: this process is to have it loaded

    stored = read_bytes(path)
    _refuse_swollen(stored)
    _refuse_crashing(stored)
    return _loaded(stored)


def _loaded(stored: bytes) -> dict[str, Any]:
    from scipy.io import loadmat

    return loadmat(io.BytesIO(stored))


def _refuse_swollen(stored: bytes) -> None:
    """Raise ValueError where the packed variables of a file unpack to more than MOST_BYTES together."""
    order, at, size = "<" if stored[126:128] == b"IM" else ">", 128, 0
    while at + 8 <= len(stored):
        kind, length = struct.unpack_from(f"{order}II", stored, at)
        packed, unpacker = stored[at + 8 : at + 8 + length], zlib.decompressobj()
        while kind == _PACKED and packed and not unpacker.eof:
            size += len(unpacker.decompress(packed, _PIECE))
            packed = unpacker.unconsumed_tail
            if size > MOST_BYTES:
                raise ValueError(f"it unpacks to more than {MOST_BYTES} bytes")
        at += 8 + length


def _refuse_crashing(stored: bytes) -> None:
    """Raise ValueError where SciPy's compiled reader takes too much memory, or the process down: a child tries it."""
    if not hasattr(os, "fork"):
        return
    child = os.fork()
    if child == 0:
        failed = 0
        try:
            faulthandler.disable()
            warnings.simplefilter("ignore")
            _limit_memory()
            _loaded(stored)
        except MemoryError:
            failed = 1
        except BaseException:  # it is for the parent to tell
            pass
        finally:
            os._exit(failed)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        raise ValueError("the reader breaks down over it")
    if os.WEXITSTATUS(status):
        raise ValueError(f"it takes more than {MOST_MEMORY} bytes to read")


def _limit_memory() -> None:
    """Let this process take MOST_MEMORY more than it has, where the system says how much that is."""
    import resource

    pages = Path("/proc/self/statm")
    if pages.exists():
        most = int(pages.read_text().split()[0]) * resource.getpagesize() + MOST_MEMORY
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        if soft == resource.RLIM_INFINITY or soft > most:
            resource.setrlimit(resource.RLIMIT_AS, (most, hard))
