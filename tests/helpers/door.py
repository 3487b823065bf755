"""The program as people call it: in this process, which spares its imports, or in one of its own."""

import io
import subprocess
import sys
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pytest

from padforge.cli import main


@dataclass(frozen=True)
class Ended:
    """What a command ended with: exit code, and what it wrote to stdout and stderr."""

    code: int
    out: str
    err: str


def call(*arguments: str) -> Ended:
    """Run the command line in this process, in the current folder; only SystemExit may leave it."""
    kinds = ("strict", "backslashreplace")  # of stdout and stderr
    streams = [io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors=errors) for errors in kinds]
    with (
        patch.object(sys, "argv", ["padforge", *arguments]),
        patch.object(sys, "stdout", streams[0]),
        patch.object(sys, "stderr", streams[1]),
        pytest.raises(SystemExit) as end,
    ):
        main()
    for stream in streams:
        stream.flush()
    out, err = (stream.buffer.getvalue().decode() for stream in streams)  # pyright: ignore[reportAttributeAccessIssue]
    code = end.value.code
    return Ended(0 if code is None else int(code), out, err)


def called(*arguments: str, cwd: Path) -> Ended:
    """The same in the folder `cwd`."""
    with chdir(cwd):
        return call(*arguments)


def refused(*arguments: str, cwd: Path) -> str:
    """What a command says that is refused: one line and exit 2, and nothing in the folder has changed."""
    before = contents(cwd)
    ended = called(*arguments, cwd=cwd)
    assert (ended.code, ended.err.count("\n"), ended.out) == (2, 1, ""), ended
    assert ended.err.startswith("padforge: "), ended
    assert contents(cwd) == before
    return ended.err


def started(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """What a command comes to in a process that begins with nothing."""
    command = [sys.executable, "-m", "padforge", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def contents(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What lies in a folder, without following links: kind and mode, size and time of the last change, by path."""
    found = {}
    for path in sorted(folder.rglob("*")):
        about = path.lstat()
        directory = path.is_dir() and not path.is_symlink()
        found[str(path)] = (about.st_mode, *((0, 0) if directory else (about.st_size, about.st_mtime_ns)))
    return found
