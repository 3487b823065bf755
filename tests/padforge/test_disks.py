"""Disks that are full: files are whole or not there, without litter."""

import json
import os
import resource
from pathlib import Path

import pytest

from padforge.common.files import write_json
from padforge.design.morphology import Morphology
from tests.helpers.door import called

pytestmark = pytest.mark.skipif(os.name != "posix", reason="limits as POSIX has them")

CHEAP = """
[pad]
grid = 2
[search]
knots = 1
starts = 1
steps = 2
max_failures = 1
[rules]
enforce = false
[rig]
presses = 24
readings_per_press = 8
"""
"""Settings with which every command is done in about a second."""

COMMANDS = {
    "design": ("design", "--out", "pad"),
    "fabricate": ("fabricate", "made/morphology.json", "--formats", "stl,3mf,svg,png", "--out", "pad"),
    "record": ("sense", "record", "--out", "pad/recording"),
}
"""Commands that write into the folder `pad`, which has the results of an earlier search."""


@pytest.mark.parametrize(("name", "limit"), [("design", 2000), ("fabricate", 2000), ("record", 0)])
def test_full_disk_leaves_whole_files_and_no_temporary_ones(tmp_path: Path, name: str, limit: int):
    (tmp_path / "pad.toml").write_text(CHEAP)
    for folder in ("made", "pad"):
        Morphology.random(2, 1, 3).save(tmp_path / folder / "morphology.json")
    write_json(tmp_path / "pad" / "fabrication.json", {"format": "padforge-fabrication/1"})
    before = (tmp_path / "pad" / "morphology.json").read_bytes()
    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, allowed[1]))
    try:
        ended = called(*COMMANDS[name], cwd=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert ended.err.startswith("padforge: "), ended
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".unfinished-")]
    for path in tmp_path.rglob("*.json"):
        json.loads(path.read_text())
    assert limit or (tmp_path / "pad" / "morphology.json").read_bytes() == before
