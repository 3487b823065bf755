"""Single files, written whole or not at all."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from padforge.design.common.errors import InputError

from .blame import writing
from .folders import settle
from .litter import UNFINISHED, unfinished_file

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes `path`'s place, on failure it vanishes.

    The temporary name keeps the suffix, because many writers choose their format by it. It is that of an empty file,
    which has to be written into and not replaced: its lock tells other runs that somebody is at work.
    A reader never sees half a file, and an interrupted write leaves the old one as it was.

    Raises:
        InputError: what the system has against writing `path`, such as a full disk.
    """
    if path.name.startswith(UNFINISHED):  # it is another one's, who puts it in place
        yield path
        return
    with writing(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: cannot be written (it is there and no file)")
        path.parent.mkdir(parents=True, exist_ok=True)
        settle(path.parent)  # or an older file would come over this one later
        with unfinished_file(path.parent, path.suffix) as temporary:
            yield temporary
            temporary.replace(path)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8 with its own line ends, atomically.

    What UTF-8 has not, as in names of files, is written as \\udc80.
    """
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document` to `path` atomically; NaN and infinities are refused, since JSON has none."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def open_in_place(path: Path) -> BinaryIO:
    """Open a file that is there, to be read and changed where it lies, without a buffer; never what a link leads to.

    Raises:
        InputError: it is a link. OSError: it cannot be opened.
    """
    file = path.open("r+b", buffering=0)
    if not os.path.samestat(os.fstat(file.fileno()), path.lstat()):
        file.close()
        raise InputError(f"{path}: is a link, and none is followed where a file is gone on with")
    return file


def sync(path: Path) -> None:
    """Put a file, or the names in a folder, on the disk, so that they outlast a power cut, where the system can."""
    if os.name == "posix":
        handle = os.open(path, os.O_RDONLY)
        try:
            to_disk(handle)
        finally:
            os.close(handle)


def to_disk(handle: int) -> None:
    """As `os.fsync`, and on macOS out of the drive's own cache as well, which fsync leaves it in there."""
    full = getattr(fcntl, "F_FULLFSYNC", None)
    if fcntl is not None and full is not None:
        with suppress(OSError):  # a disk that knows no such order
            fcntl.fcntl(handle, full)
            return
    os.fsync(handle)
