"""Hostile files: one of those that commands read is spoiled, or has an odd name, and a command reads it."""

import os
import shlex
import shutil
import socket
from collections.abc import Callable
from contextlib import chdir
from fnmatch import fnmatch
from pathlib import Path

from .containers import archive, database, hdf5, matlab, weights
from .texts import Rng, another_file, cut, document, floats, lines, numbers, pick, some_bytes
from .workplace import BAG, LAB, LAB_H5

_MODEL = (
    "sense locate --model pad pad/recording --out new.csv",
    "sense evaluate --model pad pad/recording --max-failures 1",
    "sense health --model pad pad/recording",
    "sense live --model pad --replay pad/recording --speed 1e6 --port 0",
    "sense recalibrate --model pad pad/recording --out new",
    "sense export pad/recording new.mcap --model pad",
    "sense deploy --model pad new.onnx",
    "report pad",
)
_RECORDING = (
    "sense locate --model pad {} --out new.csv",
    "sense evaluate --model pad {} --max-failures 0",
    "sense health --model pad {}",
    "sense calibrate {} --out new",
    "sense export {} new.h5",
    "sense live --model pad --replay {} --speed 1e6 --port 0",
)
_PAD = (
    *("design check {}", "design show {} --out new.svg", "design score {}", "design --start-from {} --out new"),
    *("fabricate {} --formats stl,svg --out new", "fabricate {} --formats gcode,urscript --out new"),
    *("fabricate check {}", "sense record --morphology {} --presses 4 --out new", "report pad"),
    *("design edit {} --port 0", "sense identify long --morphology {} --out new"),
    "design compare {} --out new",
)
_RUN_DIRECTORY = tuple(words.format("pad/recording") for words in _RECORDING)
READERS: dict[str, tuple[str, ...]] = {
    "pad.toml": (  # which may be left empty, and stand for the defaults: these take minutes
        *("design check pad/morphology.json", "fabricate check pad/morphology.json", "sense doctor"),
        *("design show pad/morphology.json --out new.svg", "design import plan.svg --out new"),
        *("sense record --presses 4 --out new", "sense calibrate pad/recording --time-budget 0.1 --out new"),
        *("design --time-budget 0.1 --out new", "run --time-budget 0.1 --formats svg --out new"),
        "fabricate pad/morphology.json --formats svg,gcode --out new",
    ),
    "pad/morphology.json": _PAD,
    "pad.mat": (*_PAD, "sense import {} --out new"),
    "new.mat": (*_PAD, "sense import {} --out new"),
    "pad/twin.json": (
        "sense record --twin {} --presses 4 --out new",
        "design score pad/morphology.json --twin {}",
        "design --twin {} --out new",
        "report pad",
    ),
    "pad/fabrication.json": ("report pad", "sense record --rig ur5 --morphology pad/morphology.json --out new"),
    "pad/localizer.*": _MODEL,
    "pad/health*": _MODEL,
    "pad/recording/*": (*_RUN_DIRECTORY, "report pad"),
    "presses.*": (*_RECORDING, "sense import {} --out new"),
    "long/*": ("sense identify long --morphology pad/morphology.json --out new",),
    "lab.csv": (f"sense import {{}} --columns {LAB} --out new", "sense import {} --columns fibres=fibre* --out new"),
    "lab.h5": (f"sense import {{}} --columns {LAB_H5} --out new",),
    "bag_*/*.mcap": (f"sense import {{}} --columns {BAG} --out new",),
    "bag_*/*.db3": (f"sense import {{}} --columns {BAG} --out new",),
    "bag_mcap/metadata.yaml": (f"sense import bag_mcap --columns {BAG} --out new",),
    "bag_sqlite3/metadata.yaml": (f"sense import bag_sqlite3 --columns {BAG} --out new",),
    "plan.svg": ("design import {} --out new",),
    "plan.dxf": ("design import {} --out new",),
    "plan.csv": ("sense record --plan {} --out new",),
    "pad/mould.*": ("fabricate check {}", "report pad"),
    "resumed/search/*": ("design --resume --out resumed",),
    "whole/run.json": ("run --resume --formats stl,svg --out whole",),
    "whole/*.json": ("run --resume --formats stl,svg --out whole", "report whole"),
    "pad/*.json": ("report pad",),
    "pad/design.json": ("bench contact --against {} --out file", "report pad"),
}
"""Commands that read a file, or whatever a pattern names; {} stands for its name."""
FOLDERS = {"pad/recording": _RUN_DIRECTORY, "bag_mcap": (f"sense import bag_mcap --columns {BAG} --out new",)}
NAMES = (
    *("-{}", "a b{}", "é{}", "日本{}", "\udc80{}", "a\nb{}", "\x1b[31m{}", "'\"{}", "%s{}", "{{0}}{}", "$HOME{}"),
    *("x" * 200 + "{}", "<b>{}", "&{}", "--help{}", "con{}", "{}.", "{} "),
)
"""Odd names; {} stands for the right one, or its suffix."""


Spoil = Callable[[Rng, Path], str]
"""Spoils a file, which is there, and says how."""
NODES = ("pipe", "loop", "nowhere", "zero", "null", "full", "folder", "gone", "closed", "socket")


def as_node(rng: Rng, path: Path) -> str:
    """What is no file, or one that may not be read, in the place of a file; or of a folder."""
    kind = pick(rng, NODES)
    if kind == "closed":
        path.chmod(0)
        return kind
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
        (path / "x").touch()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as opened, chdir(path.parent):  # its address may not be long
            opened.bind(path.name)
    elif kind != "gone":
        path.symlink_to({"loop": path.name, "nowhere": "nowhere"}.get(kind, f"/dev/{kind}"))
    return kind


_TEXT = (numbers, numbers, lines, some_bytes, cut, another_file)
_BINARY = (some_bytes, some_bytes, floats, cut, another_file)
_BY_SUFFIX: dict[str, tuple[Spoil, ...]] = {
    **dict.fromkeys((".json", ".ndjson"), (document,) * 4 + _TEXT),
    **dict.fromkeys((".toml", ".csv", ".svg", ".dxf", ".yaml", ".md"), _TEXT),
    **dict.fromkeys((".h5",), (hdf5,) * 6 + _BINARY),
    **dict.fromkeys((".mat",), (matlab,) * 6 + _BINARY),
    **dict.fromkeys((".npz", ".3mf"), (archive,) * 4 + _BINARY),
    **dict.fromkeys((".safetensors",), (weights,) * 6 + _BINARY),
    **dict.fromkeys((".db3",), (database,) * 4 + _BINARY),
}


def spoil(rng: Rng, path: Path) -> str:
    """Spoil a file in a way that its kind suggests, once in seven times by what is no file; how."""
    if rng.random() < 1 / 7:
        return as_node(rng, path)
    return pick(rng, _BY_SUFFIX.get(path.suffix, _BINARY))(rng, path)


def drawn(rng: Rng, folder: Path, files: list[str]) -> tuple[list[str], str]:
    """Spoil one of the `files` in `folder`: a command line that reads it, and what was done."""
    if rng.random() < 0.03:
        name = pick(rng, sorted(FOLDERS))
        return shlex.split(pick(rng, FOLDERS[name])), f"{name}: {as_node(rng, folder / name)}"
    pattern = pick(rng, sorted(READERS))
    name = pick(rng, [each for each in files if fnmatch(each, pattern)])
    words, path = pick(rng, READERS[pattern]), folder / name
    if "{}" in words and rng.random() < 0.06:
        odd = path.with_name(pick(rng, NAMES).format(path.suffix))
        odd.parent.mkdir(parents=True, exist_ok=True)
        path.rename(odd)
        told = f"{name}: its name is {odd.name!a}"
        name = str(odd.relative_to(folder))
    else:
        told = f"{name}: {spoil(rng, path)}"
        if rng.random() < 0.2 and path.is_file() and not path.is_symlink():
            told += f", {some_bytes(rng, path)}" if _readable(path) else ""
    return [word.replace("{}", name) for word in shlex.split(words)], told


def _readable(path: Path) -> bool:
    return bool(path.stat().st_mode & 0o400)
