"""Locks on files and folders, which end with whoever holds them, however that is killed."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from padforge.design.common.errors import InputError

from .blame import writing

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCKS = fcntl is not None
"""Whether this system can tell of a file or folder, while others may rename it, that its run is no more."""
_LOCK_FILE, _FAR = ".unfinished-lock", 2**40
"""On Windows: what keeps others off the folder it is in, and the byte of a file that is locked, beyond all content."""


class BusyError(InputError):
    """Somebody else is at work with it."""


def lock(file: IO[Any] | int | None, busy: str) -> None:
    """Keep others off until `file`, or what this descriptor is of, is closed; on a disk without locks nobody is.

    Raises:
        BusyError: saying `busy`, where somebody has locked it.
    """
    if file is None:
        return
    try:
        if fcntl is None:
            _lock_far(file if isinstance(file, int) else file.fileno())
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if fcntl is None or isinstance(error, BlockingIOError):
            raise BusyError(busy) from error


def _lock_far(handle: int) -> None:
    """Lock a byte of a file on Windows, where nobody can read what is locked."""
    import msvcrt

    at = os.lseek(handle, 0, os.SEEK_CUR)
    os.lseek(handle, _FAR, os.SEEK_SET)
    try:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]  there alone
    finally:
        os.lseek(handle, at, os.SEEK_SET)


@contextmanager
def held_folder(folder: Path, busy: str) -> Iterator[None]:
    """`held`, of a folder that stays where it is: on Windows by a file in it, which goes with whoever made it."""
    if LOCKS:
        with held(folder, busy):
            yield
        return
    try:
        handle = os.open(folder / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_TEMPORARY)  # pyright: ignore[reportAttributeAccessIssue]
    except PermissionError as error:  # it is there, and on its way out
        raise BusyError(busy) from error
    try:
        lock(handle, busy)
        yield
    finally:
        os.close(handle)


@contextmanager
def held(path: Path, busy: str) -> Iterator[None]:
    """Keep others off a file or folder to the end or the death of this run, as `lock` does.

    Raises:
        BusyError: saying `busy`, where somebody has it, or it has gone meanwhile.
        InputError: it cannot be opened.
    """
    if not LOCKS:
        yield
        return
    with writing(path):
        try:
            handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError as error:
            raise BusyError(busy) from error
    try:
        lock(handle, busy)
        if not is_at(handle, path):
            raise BusyError(busy)
        yield
    finally:
        os.close(handle)


def try_lock(handle: int) -> bool | None:
    """Lock what a descriptor is of: whether that was free, or None where disk or system have no such locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_at(handle: int, path: Path) -> bool:
    """Whether an open file or folder still lies at a path."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def is_folder(path: Path) -> bool:
    """Whether a folder lies there, and not a link to one."""
    try:
        return stat.S_ISDIR(path.lstat().st_mode)
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return False
