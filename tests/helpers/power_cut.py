"""What a disk keeps when the power is cut: what was synchronised, and in the worst case nothing else."""

import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere not by os.fsync alone")


class Disk:
    """Notes what `os.fsync` makes lasting: the content of a file, or the names in a folder.

    A file is to be lasting before it is renamed: else its name could outlast a power cut without its content.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._contents: dict[int, bytes] = {}  # by inode
        self._names: dict[int, dict[str, int]] = {}  # inodes by name, by the inode of the folder
        self.torn: list[str] = []  # files that were renamed before
        self.on_rename: Callable[[Path], None] = lambda source: None
        monkeypatch.setattr(os, "fsync", self._noting(os.fsync))
        for name in ("rename", "replace"):
            monkeypatch.setattr(os, name, self._watching(getattr(os, name)))

    def _noting(self, fsync: Callable[[int], None]) -> Callable[[int], None]:
        def note(handle: int) -> None:
            fsync(handle)
            status = os.fstat(handle)
            if stat.S_ISDIR(status.st_mode):
                self._names[status.st_ino] = {entry.name: entry.inode() for entry in os.scandir(handle)}
            else:
                self._contents[status.st_ino] = Path(f"/proc/self/fd/{handle}").read_bytes()

        return note

    def _watching(self, rename: Callable[[Path, Path], None]) -> Callable[[Path, Path], None]:
        def watch(source: Path, target: Path) -> None:
            if source.is_file() and self._contents.get(source.stat().st_ino) != source.read_bytes():
                self.torn.append(source.name)
            self.on_rename(source)
            rename(source, target)

        return watch

    def has_name(self, path: Path) -> bool:
        """Whether the name lasts, in a folder that is there now."""
        return self._names.get(path.parent.stat().st_ino, {}).get(path.name) == path.stat().st_ino

    def read(self, path: Path) -> bytes | None:
        """Return what lasts of a file; None of one whose name or content does not."""
        names = self._names.get(path.parent.stat().st_ino, {})
        return self._contents.get(names.get(path.name, -1))
