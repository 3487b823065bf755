import tomllib
from importlib import invalidate_caches
from pathlib import Path

import pytest

from padforge.design import Morphology
from padforge.sense.recording.recording import Recording
from tests.docs.pages import BLOCK, ROOT
from tests.helpers.door import called

PAGE = ROOT / "docs" / "howto-boards.md"
SPEC = """
[rig]
board = "noise"
presses = 3
rate_hz = 100
readings_per_press = 10
pad_mm = [0, -400]
contact_mm = 100
box_mm = [-100, 100, -500, -300, 90, 200]
"""


def install(folder: Path) -> None:
    """Lay the example into a folder as pip does: its module, and the entry points that it names."""
    blocks = list(BLOCK.finditer(PAGE.read_text(encoding="utf-8")))
    [module] = [block["body"] for block in blocks if block["language"] == "python"]
    [named] = [block["body"] for block in blocks if "entry-points" in block["body"]]
    (folder / "my_rig.py").write_text(module, encoding="utf-8")
    about = folder / "my_rig-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-rig\nVersion: 1\n")
    lines = []
    for group, points in tomllib.loads(named)["project"]["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (about / "entry_points.txt").write_text("\n".join(lines))


def test_device_example_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    invalidate_caches()
    Morphology.straight(2).save(tmp_path / "morphology.json")
    (tmp_path / "pad.toml").write_text(SPEC)
    command = "sense", "record", "--rig", "jumper", "--spec", "pad.toml", "--out", "run"
    ended = called(*command, cwd=tmp_path)
    assert (ended.code, '"unwatched"' in ended.err) == (2, True)
    (tmp_path / "pad.toml").write_text(SPEC + 'max_force_n = "unwatched"\n')
    ended = called(*command, cwd=tmp_path)
    assert ended.code == 0, ended
    recording = Recording.open(tmp_path / "run")
    assert (recording.fibres, len(recording.presses_mm)) == (4, 3)
    assert recording.source["devices"]["arm"] == {"model": "jumper"}
