"""The example of devices of one's own is installed as the page says, and records."""

import sys
import tomllib
from importlib import invalidate_caches
from pathlib import Path

import pytest

from padforge.cli import main
from padforge.design import Morphology
from padforge.sense.recording.recording import Recording
from tests.docs.pages import BLOCK, ROOT

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


def test_device_example_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    install(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    invalidate_caches()
    monkeypatch.chdir(tmp_path)
    Morphology.straight(2).save("morphology.json")
    command = ["padforge", "sense", "record", "--rig", "jumper", "--spec", "pad.toml", "--out", "run"]

    def record(spec: str) -> tuple[int, str]:
        Path("pad.toml").write_text(spec)
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, capsys.readouterr().err  # type: ignore[return-value]

    code, said = record(SPEC)
    assert (code, '"unwatched"' in said) == (2, True)
    code, said = record(SPEC + 'max_force_n = "unwatched"\n')
    assert code == 0, said
    recording = Recording.open("run")
    assert (recording.fibres, len(recording.presses_mm)) == (4, 3)
    assert recording.source["devices"]["arm"] == {"model": "jumper"}
