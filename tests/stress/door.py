"""The front door for stress tests: a folder full of files to choose from, a command run in it, and the verdict."""

import io
import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

import padforge
from design.common.errors import InputError
from fabricate.mesh_files import read_mesh
from tests.stress.clock import LIMIT_S, ends_in_time

CHEAP = """
[pad]
grid = 2
[search]
knots = 1
starts = 1
steps = 2
lost = 1
population = 4
generations = 1
[rules]
enforce = false
[rig]
presses = 24
readings_per_press = 8
[localizer]
members = 1
hidden = 4
layers = 1
epochs = 1
lost = 1
"""
"""Settings with which every command is done in about a second."""


@dataclass(frozen=True)
class Ended:
    """What a command ended with: exit code, and what it wrote to stdout and stderr."""

    code: int
    out: str
    err: str


def call(*arguments: str, limit_s: float = LIMIT_S) -> Ended:
    """Run the command line in this process, in the current folder; only SystemExit may leave it."""
    kinds = ("strict", "backslashreplace")  # of stdout and stderr
    streams = [io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors=errors) for errors in kinds]
    with (
        patch.object(sys, "argv", ["padforge", *arguments]),
        patch.object(sys, "stdout", streams[0]),
        patch.object(sys, "stderr", streams[1]),
        ends_in_time(limit_s),
    ):
        with pytest.raises(SystemExit) as end:
            padforge.main()
        code = end.value.code
    for stream in streams:
        stream.flush()
    out, err = (stream.buffer.getvalue().decode() for stream in streams)  # pyright: ignore[reportAttributeAccessIssue]
    return Ended(0 if code is None else int(code), out, err)  # pyright: ignore[reportArgumentType]


def contents(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What lies in a folder, without following links: kind and mode, size and time of the last change, by path."""
    found = {}
    for path in sorted(folder.rglob("*")):
        about = path.lstat()
        directory = path.is_dir() and not path.is_symlink()
        found[str(path)] = (about.st_mode, *((0, 0) if directory else (about.st_size, about.st_mtime_ns)))
    return found


def judge(ended: Ended, changed: bool, allowed: Sequence[int] = (0, 1, 2, 130)) -> None:
    """See that a command ended as it may: bad input in exit 2, one line and nothing changed; and no temporary file."""
    assert ended.code in allowed, ended
    assert "Traceback" not in ended.err, ended
    if ended.code == 2:
        lines = ended.err.splitlines()
        assert lines, ended
        assert lines[-1].startswith(("padforge: ", "Usage: ", "  ")), ended
        assert sum(line.startswith("padforge: ") for line in lines) <= 1, ended
        assert not changed, ended


def require_whole_file(path: Path) -> None:
    """See that a file can be read to its end by what reads its kind."""
    match path.suffix:
        case ".json":
            json.loads(path.read_text())
        case ".stl" | ".3mf":
            read_mesh(path)
        case ".png":
            assert path.read_bytes().endswith(b"IEND\xaeB`\x82"), path
        case ".svg":
            assert path.read_text().rstrip().endswith("</svg>"), path
        case ".dxf":
            assert path.read_text().rstrip().endswith("EOF"), path
        case ".npz":
            np.load(path).close()
        case ".html":
            assert path.read_text().rstrip().endswith("</html>"), path


def require_one_line(error: InputError, about: str = "") -> None:
    """See that a refusal is one line, no endless one, that names what it is `about`."""
    assert "\n" not in str(error)
    assert len(str(error)) < 5000, len(str(error))
    assert about in str(error)


class Workshop:
    """A folder of good and bad files for commands to run in, put back as it was after each.

    Args:
        folder: an empty one.
    """

    def __init__(self, folder: Path) -> None:
        self.master, self.folder = folder / "master", folder / "here"
        self.master.mkdir()
        before = Path.cwd()
        os.chdir(self.master)
        try:
            fill()
        finally:
            os.chdir(before)
        self._renew()

    def run(self, *arguments: str, limit_s: float = LIMIT_S) -> Ended:
        """Run a command in the folder and judge it."""
        before = Path.cwd()
        os.chdir(self.folder)
        try:
            ended = call(*arguments, limit_s=limit_s)
        finally:
            os.chdir(before)
        now = contents(self.folder)
        changed = now != self._untouched
        litter = [path for path in now if path not in self._untouched and Path(path).name.startswith(".")]
        self.added = {path for path in now if path not in self._untouched}
        try:
            judge(ended, changed)
            assert not litter, (ended, litter)
        finally:
            if changed:
                self._renew()
        return ended

    def _renew(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.master, self.folder, symlinks=True, copy_function=shutil.copy)
        for name in SPECIAL:
            os.mkfifo(self.folder / name)
        self._untouched = contents(self.folder)


SPECIAL = ("pipe", "pipe.json", "pipe.stl", "pipe.mat", "pipe.csv", "pipe.toml", "pipe.3mf", "pipe.h5")
"""Pipes that nobody writes to: who opens one waits for ever."""


def fill() -> None:
    """Put files of every kind, good and bad, into the current folder; the pipes of SPECIAL are not among them."""
    Path("pad.toml").write_text(CHEAP)
    Path("other.toml").write_text(CHEAP.replace("grid = 2", "grid = 1"))
    Path("bad.toml").write_text("[pad]\ngrid = 'x'\n")
    for command in (
        ("design", "--out", "pad"),
        ("design", "show", "pad/morphology.json", "--out", "plan.svg"),
        ("fabricate", "pad/morphology.json", "--formats", "stl,3mf,dxf"),
        ("sense", "record", "--morphology", "pad/morphology.json", "--out", "pad/recording"),
        ("sense", "calibrate", "pad/recording", "--out", "pad"),
        ("sense", "export", "pad/recording", "presses.csv"),
        ("sense", "export", "pad/recording", "presses.h5"),
        ("report", "pad"),
    ):
        ended = call(*command, limit_s=120)
        assert ended.code == 0, ended
    Path("pad/tracks.dxf").rename("plan.dxf")
    Path("empty").mkdir()
    Path("folder.json").mkdir()
    Path("folder.toml").mkdir()
    Path("folder.stl").mkdir()
    Path("folder.mat").mkdir()
    for name in ("nothing.json", "nothing.stl", "nothing.mat", "nothing.toml", "nothing.csv", "nothing.h5", "file"):
        Path(name).touch()
    for suffix in ("json", "stl", "3mf", "mat", "toml", "csv", "h5"):
        Path(f"junk.{suffix}").write_bytes(bytes(range(1, 256)) * 9)
        Path(f"zero.{suffix}").symlink_to("/dev/zero")
        Path(f"dangling.{suffix}").symlink_to("nowhere")
        Path(f"loop.{suffix}").symlink_to(f"loop.{suffix}")
    Path("nested.json").write_text("[" * 100_000)
    Path("nested.toml").write_text("a = " + "[" * 100_000)
    Path("list.json").write_text("[]")


LONG = "x" * 300
"""Longer than a name may be."""
HOSTILE = (
    *("", " ", "-", "--", "-1", "0", "1", "2", "3", "9" * 20, "-" + "9" * 20, "1e400", "nan", "inf"),
    *("-inf", "NaN", "0x10", "1_000", "1.5", "٣", "½", "true", "none", "None", "null", "é", "日本"),
    *(
        "\udc80\udcff",
        "\x01",
        "a\nb",
        "a\tb",
        "\x1b[31m",
        "%s%n",
        "{0}",
        "$HOME",
        "~",
        "*",
        "../x",
        "0,1",
        "0,,1",
        ",",
        "0,0",
    ),
    *("1" * 5000, "x" * 70_000),
)
"""Values that are wrong nearly everywhere."""

PATHS = (
    *(
        ".",
        "..",
        "",
        "pad",
        "empty",
        "file",
        "file/below",
        "new",
        "new/deep/er",
        "nowhere/",
        "pad/",
        "pad/recording",
    ),
    *("pad/morphology.json", "pad/mould.stl", "pad/mould.3mf", "pad/design.json", "pad/recording/start.json"),
    *("presses.csv", "presses.h5", "pad.toml", "other.toml", "bad.toml", "nested.json", "nested.toml", "list.json"),
    *(f"{kind}.{suffix}" for kind in ("junk", "zero", "dangling", "loop") for suffix in ("json", "stl", "mat", "toml")),
    *(f"{kind}.{suffix}" for kind in ("junk", "zero", "dangling") for suffix in ("csv", "h5", "3mf")),
    *(f"{kind}.{suffix}" for kind in ("folder", "nothing") for suffix in ("json", "stl", "mat")),
    *SPECIAL,
    *("/dev/null", "/dev/full", "/dev/zero", "/dev/stdin/x", "/proc/self/mem", "/proc/nowhere/x", "/sys/x", "new.svg"),
    *(
        LONG,
        f"{LONG}.json",
        f"new/{LONG}/x",
        "/".join(["y" * 100] * 60),
        "日本",
        "\udc80\udcff",
        "a\nb",
        "-",
        "--",
        " ",
        "~",
    ),
    *(
        "new.json",
        "new.csv",
        "new.h5",
        "new.png",
        "new.stl",
        "new.mat",
        "\x1b[31m.json",
        "pad/../pad",
        "con",
        "x" * 250 + ".svg",
    ),
)
"""Paths of all kinds, some of which are right for each command."""
