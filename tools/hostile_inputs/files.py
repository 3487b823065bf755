"""A folder full of files of every kind, good and bad, and how whole files are told from torn ones."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from padforge.fabricate.mesh import read_mesh
from tests.helpers.door import call

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
