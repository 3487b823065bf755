"""What goes wrong with files, in one line that names the file."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from padforge.design.common.errors import InputError


@contextmanager
def as_written(path: Path) -> Iterator[None]:
    """Blame a document that is not as padforge writes it on its file."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as padforge writes it ({error!r})") from error


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
