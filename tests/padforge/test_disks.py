import json
import os
from pathlib import Path

import pytest

from padforge.common.files import write_json
from padforge.design.morphology import Morphology
from tests.helpers.door import called
from tests.helpers.full_disk import full_disk
from tests.padforge.conftest import SMALLEST

pytestmark = pytest.mark.skipif(os.name != "posix", reason="limits as POSIX has them")


@pytest.mark.parametrize(
    ("command", "limit"),
    [
        ("design --out pad", 2000),
        ("fabricate made/morphology.json --formats stl,3mf,svg,png --out pad", 2000),
        ("sense record --out pad/recording", 0),
    ],
)
def test_full_disk_leaves_whole_files_and_no_temporary_ones(tmp_path: Path, command: str, limit: int):
    """Also of an earlier search in the folder that is written into."""
    (tmp_path / "pad.toml").write_text(f"{SMALLEST}[rig]\npresses = 24\nreadings_per_press = 8\n")
    for folder in ("made", "pad"):
        Morphology.random(2, 1, 3).save(tmp_path / folder / "morphology.json")
    write_json(tmp_path / "pad" / "fabrication.json", {"format": "padforge-fabrication/1"})
    before = (tmp_path / "pad" / "morphology.json").read_bytes()
    with full_disk(limit):
        ended = called(*command.split(), cwd=tmp_path)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert ended.err.startswith("padforge: "), ended
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".unfinished-")]
    for path in tmp_path.rglob("*.json"):
        json.loads(path.read_text())
    assert limit or (tmp_path / "pad" / "morphology.json").read_bytes() == before
