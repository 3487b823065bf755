"""A folder of good and bad files that inputs work in, put back after each, and how whole files differ from torn."""

import json
import os
import shutil
from collections.abc import Iterable
from contextlib import chdir
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

from padforge.fabricate.mesh import read_mesh
from tests.helpers.door import Ended, call, contents
from tests.sense.formats.foreign import array, pose, write_bag
from tools.kills import killed

CHEAP = """
[pad]
grid = 2
[search]
knots = 1
starts = 1
steps = 2
max_failures = 1
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
max_failures = 1
"""
"""Settings with which every command is done in about a second."""

SPECIAL = ("pipe", "pipe.json", "pipe.stl", "pipe.mat", "pipe.csv", "pipe.toml", "pipe.3mf", "pipe.h5")
"""Pipes that nobody writes to: who opens one waits for ever."""
LAB = "time=time_s,fibres=fibre*,x=x_mm,y=y_mm"
"""How a table of another program is named, `lab.csv`."""
LAB_H5 = "time=/t,fibres=/volts,positions=/xy,down_command=/on,up_command=/off"
BAG = "fibres=/skin,positions=/probe"


def published(fibres: int) -> dict[str, Any]:
    """Variables as the published files have them: a morphology, settings, presses and their signals."""
    rng = np.random.default_rng(0)
    settings = {"object_size": 0.6, "str_shp": 30.0, "fineness": 200.0}
    knots = np.sort(rng.uniform(0.1, fibres / 2 + 0.9, (3, 4 * fibres // 2)), axis=0)
    return {"para": knots, "K": settings, "loc_all": rng.uniform(1, 2, (9, 2)), "sens_raw_all": rng.random((9, fibres))}


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
        ended = call(*command)
        assert ended.code == 0, ended
    Path("pad/tracks.dxf").rename("plan.dxf")
    Path("empty").mkdir()
    for suffix in ("json", "toml", "stl", "mat"):
        Path(f"folder.{suffix}").mkdir()
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


class Workplace:
    """The folder.

    Args:
        where: an empty folder, in which files are made once.
    """

    def __init__(self, where: Path) -> None:
        self.master, self.folder = where / "master", where / "place" / "here"
        self.temporary = Path(f"{self.folder}.tmp")
        self.master.mkdir()
        self.folder.parent.mkdir()
        with chdir(self.master):
            fill()
            _fill_more()
        shutil.copytree(self.master, self.folder, symlinks=True)
        for name in SPECIAL:
            os.mkfifo(self.folder / name)
        self.temporary.mkdir()
        self._untouched = contents(self.folder)

    def files(self) -> list[str]:
        """Names of the files that can be spoiled, relative to the folder."""
        found = (path for path in self.master.rglob("*") if path.is_file() and not path.is_symlink())
        return sorted(str(path.relative_to(self.master)) for path in found)

    def now(self) -> dict[str, tuple[int, int, int]]:
        """What is there, see `door.contents`."""
        return contents(self.folder)

    def changed(self, since: dict[str, tuple[int, int, int]]) -> list[Path]:
        """What is there now and was not `since`, or is another file; or is no more."""
        now = self.now()
        return [Path(path) for path in sorted(now.keys() | since.keys()) if now.get(path) != since.get(path)]

    def renew(self) -> None:
        """Put back what has changed."""
        for path in self.changed(self._untouched):
            if _is_folder(path):
                path.chmod(0o700)
        for path in reversed(self.changed(self._untouched)):
            if _is_folder(path):
                shutil.rmtree(path)
            elif os.path.lexists(path):
                path.unlink()
        for path in self.changed(self._untouched):
            original = self.master / path.relative_to(self.folder)
            if _is_folder(original):
                path.mkdir()
            elif os.path.lexists(original):
                shutil.copy2(original, path, follow_symlinks=False)
            else:
                os.mkfifo(path)
        for path in self.folder.parent.iterdir():  # what was told to go one folder up, too
            if path != self.folder:
                shutil.rmtree(path) if _is_folder(path) else path.unlink()
        self.temporary.mkdir()
        self._untouched = contents(self.folder)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _made(*words: str) -> Ended:
    ended = call(*words)
    assert ended.code in (0, 1), ended
    return ended


def _fill_more() -> None:
    """Put files of all the kinds that commands read into the current folder, where `fill` has been at work."""
    Path("pad.toml").write_text(CHEAP.replace("[rig]", '[rig]\nhost = "127.0.0.1"'))  # where no arm answers, at once
    _made("run", "--out", "whole", "--formats", "stl,svg")
    planned = ("--morphology", "pad/morphology.json")
    Path("long.toml").write_text(CHEAP.replace("= 24", "= 420").replace("readings_per_press = 8", ""))
    _made("sense", "record", *planned, "--spec", "long.toml", "--out", "long")
    _made("sense", "identify", "long", *planned, "--out", "pad")
    _made("sense", "fibre-loss", "pad/recording", "--model", "pad", "--max-failures", "1", "--out", "pad")
    _made("sense", "calibrate", "long", "--out", "pad", "--force")
    _made("sense", "learning-curve", "long", "--out", "pad")
    _made("sense", "recalibrate", "--model", "pad", "pad/recording", "--out", "again")
    _made("sense", "export", "pad/recording", "presses.mcap")
    scipy.io.savemat("pad.mat", published(4))
    with h5py.File("new.mat", "w", userblock_size=512) as file:
        for name, values in published(4).items():
            if not isinstance(values, dict):
                file[name] = values.T
    header, *rows = Path("presses.csv").read_text().splitlines()
    columns = [name if name[-2:] in ("_s", "mm") else f"fibre{at}" for at, name in enumerate(header.split(","))]
    Path("lab.csv").write_text("\n".join([",".join(columns), *rows]) + "\n")
    rng = np.random.default_rng(0)
    with h5py.File("lab.h5", "w") as file:
        file["t"], file["volts"] = np.arange(200) / 13.3, rng.random((200, 4))
        file["xy"], file["on"], file["off"] = rng.random((4, 2)), [10, 60, 110, 160], [30, 80, 130, 180]
    said = [("/skin", 0.1 * at, array("Float64MultiArray", rng.random(3))) for at in range(60)]
    said += [("/probe", 0.1 * at + 0.05, pose(0.01 * at, 0.02)) for at in range(60)]
    for plugin in ("mcap", "sqlite3"):
        write_bag(Path(f"bag_{plugin}"), said, plugin)
    Path("plan.csv").write_text("x_mm,y_mm,depth_mm\n" + "".join(f"{x},{x / 2},2.5\n" for x in range(-4, 5)))
    _leave_unfinished(["design", "--out", "resumed"], Path("resumed"), "start_0000.npz")


def _leave_unfinished(words: Iterable[str], folder: Path, state: str) -> None:
    """Kill a command that writes into `folder` when it has kept the state of that name."""
    for number in count():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        assert killed(lambda: call(*words), number, folder), f"{words} keep no {state}"
        if list(folder.rglob(state)):
            return
