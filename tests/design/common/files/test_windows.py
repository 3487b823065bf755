"""Locks where there is no `flock`, by a stand-in for what Windows has in its place."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from design.common.errors import InputError
from design.common.files import claimed, locks


@pytest.fixture(autouse=True)
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes are locked by the file they are of, until that is closed; a file may go with its last descriptor."""
    taken: dict[int, tuple[int, int]] = {}

    def locking(handle: int, mode: int, count: int) -> None:
        about = os.fstat(handle)
        for other, inode in list(taken.items()):
            try:
                alive = (os.fstat(other).st_dev, os.fstat(other).st_ino) == inode
            except OSError:
                alive = False
            if alive and other != handle and inode == (about.st_dev, about.st_ino):
                raise PermissionError(13, "in use")
        taken[handle] = (about.st_dev, about.st_ino)

    monkeypatch.setattr(locks, "fcntl", None)
    monkeypatch.setattr(locks, "LOCKS", False)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))  # pyright: ignore
    monkeypatch.setattr(os, "O_TEMPORARY", 0, raising=False)


@pytest.mark.skipif(sys.platform == "win32", reason="it is no stand-in there")
def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    with claimed(tmp_path), pytest.raises(InputError, match="another run is writing there"), claimed(tmp_path):
        pass
    with claimed(tmp_path):
        pass


def test_a_locked_file_is_read_on_from_where_it_was(tmp_path: Path) -> None:
    (tmp_path / "journal").write_bytes(b"line\n")
    with (tmp_path / "journal").open("r+b", buffering=0) as first, (tmp_path / "journal").open("rb") as second:
        first.seek(3)
        locks.lock(first, "busy")
        assert first.tell() == 3
        with pytest.raises(InputError, match="busy"):
            locks.lock(second, "busy")
        assert second.read() == b"line\n"
