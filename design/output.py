"""Where results go: what cannot be written is one clear line, files appear together, and one writes at a time."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from .errors import InputError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

UNFINISHED = ".unfinished-"
"""Names of files and folders begin with this until they are whole."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the system has against writing `path` into one line.

    Raises:
        InputError: naming `path` and the reason.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def refuse_unwritable(folder: Path) -> None:
    """Raise InputError if files cannot be put into `folder`, or it is not there and cannot be made."""
    with writing(folder):
        there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
        if not there.is_dir():
            raise InputError(f"{folder}: cannot be written, {there} is a file, expected a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"{folder}: cannot be written, {there} does not allow it; choose another folder")


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield an empty folder in `folder`; on success its files move to `folder`, on failure they vanish.

    Raises:
        InputError: `folder` cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=UNFINISHED) as name:
            yield Path(name)
            files = sorted(Path(name).iterdir())
            in_the_way = [file.name for file in files if (folder / file.name).is_dir()]
            if in_the_way:
                raise InputError(f"{folder / in_the_way[0]}: is a folder, expected a file or nothing")
            for file in files:
                file.replace(folder / file.name)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other runs off `folder` while results are made for it; one that was not there goes again if left empty.

    Raises:
        InputError: another run is at it, or it cannot be written.
    """
    refuse_unwritable(folder)
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        claim = os.open(folder, os.O_RDONLY) if fcntl else None
    try:
        if claim is not None:
            lock(claim, f"{folder}: another run is writing there; wait for its end, or choose another folder")
        yield
    finally:
        if claim is not None:
            os.close(claim)
        with suppress(OSError):  # where something is in it
            for each in missing:
                each.rmdir()


def lock(file: IO[Any] | int, busy: str) -> None:
    """Keep others off until `file`, or what this descriptor is of, is closed, where the system has such locks.

    Raises:
        InputError: saying `busy`, where somebody has locked it.
    """
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise InputError(busy) from error
