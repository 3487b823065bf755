"""Disks that are full, closed or shared, and ends in the middle: files are whole or not there, without litter."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from padforge.common.files import find_unchanged, write_json
from padforge.design.morphology import Morphology
from padforge.fabricate.mesh import read_mesh
from tests.helpers.door import called, contents

pytestmark = pytest.mark.skipif(os.name != "posix", reason="limits and signals as POSIX has them")

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
[localizer]
members = 1
hidden = 4
layers = 1
epochs = 1
max_failures = 1
"""
"""Settings with which every command is done in about a second."""

COMMANDS = {
    "design": ("design", "--out", "pad"),
    "fabricate": ("fabricate", "made/morphology.json", "--formats", "stl,3mf,svg,png", "--out", "pad"),
    "record": ("sense", "record", "--out", "pad/recording"),
}
"""Commands that write into the folder `pad`, cheap ones."""


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A folder with settings, a pad in `made`, and the results of an earlier search in `pad`."""
    (tmp_path / "pad.toml").write_text(CHEAP)
    for name in ("made", "pad"):
        Morphology.random(2, 1, 3).save(tmp_path / name / "morphology.json")
    write_json(tmp_path / "pad" / "fabrication.json", {"format": "padforge-fabrication/1"})
    return tmp_path


EACH = """
import sys
from padforge.cli import main
for words in sys.argv[1:]:
    sys.argv = ["padforge", *words.split()]
    try:
        main()
    except SystemExit as end:
        print(end.code)
"""
"""Several commands in one process, with their exit codes."""


def start(folder: Path) -> subprocess.Popen[str]:
    """Begin to make a mould."""
    command = [sys.executable, "-m", "padforge", *COMMANDS["fabricate"], "--formats", "stl,3mf,svg"]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def require_whole(folder: Path) -> None:
    """Every file in a folder can be read to its end by what reads its kind; temporary ones are none."""
    for path in folder.rglob("*"):
        if not path.is_file() or any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        match path.suffix:
            case ".json":
                json.loads(path.read_text())
            case ".stl" | ".3mf":
                read_mesh(path)
            case ".png":
                assert path.read_bytes().endswith(b"IEND\xaeB`\x82"), path
            case ".svg":
                assert path.read_text().rstrip().endswith("</svg>"), path
            case ".npz":
                np.load(path).close()


def litter(folder: Path) -> list[str]:
    """Names of unfinished things in a folder, which may go while it is looked through."""
    return [name for _, inner, files in os.walk(folder) for name in (*inner, *files) if name.startswith(".unfinished-")]


@pytest.mark.parametrize(("name", "limit"), [("design", 2000), ("fabricate", 2000), ("record", 0)])
def test_full_disk_leaves_old_files_and_no_temporary_files(room: Path, name: str, limit: int):
    before = (room / "pad" / "morphology.json").read_bytes()
    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, allowed[1]))
    try:
        ended = called(*COMMANDS[name], cwd=room)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert ended.err.startswith("padforge: "), ended
    assert litter(room) == []
    require_whole(room)
    if limit == 0:
        assert (room / "pad" / "morphology.json").read_bytes() == before


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() == 0 and not shutil.which("setpriv"), reason="root may write everywhere")
def test_read_only_folder_is_refused_in_one_line(room: Path):
    (room / "pad").chmod(0o555)
    before = contents(room)
    # Root may write everywhere, unless it starts without that right.
    without = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    words = [" ".join(COMMANDS[name]) for name in ("fabricate", "record")]
    ended = subprocess.run(
        [*without, sys.executable, "-c", EACH, *words], cwd=room, capture_output=True, text=True, timeout=120
    )
    assert (ended.stdout, ended.stderr.count("\n")) == ("2\n2\n", 2), ended
    assert all(line.startswith("padforge: ") for line in ended.stderr.splitlines()), ended
    assert contents(room) == before


@pytest.mark.slow
def test_kill_while_writing_leaves_one_mould(room: Path):
    child = start(room)
    deadline = time.monotonic() + 60
    while not litter(room / "pad") and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.0005)
    child.kill()
    _, err = child.communicate(timeout=60)
    assert child.returncode in (-signal.SIGKILL, 0), err
    require_whole(room)
    if not (room / "pad" / "fabrication.json").exists():
        child = start(room)
        assert child.wait(timeout=60) == 0, child.communicate()
    digests = json.loads((room / "pad" / "fabrication.json").read_text()).get("sha256", {})
    there = {path.name for path in (room / "pad").glob("[!.]*") if path.is_file()}
    assert there - {"morphology.json", "fabrication.json"} == digests.keys() == find_unchanged(room / "pad", digests)


@pytest.mark.slow
def test_concurrent_runs_leave_one_result(room: Path):
    children = [start(room) for _ in range(2)]
    for child in children:
        _, err = child.communicate(timeout=120)
        assert child.returncode in (0, 1, 2), err
        assert "Traceback" not in err, err
        assert child.returncode != 2 or (err.startswith("padforge: ") and err.count("\n") == 1), err
    assert 0 in [child.returncode for child in children]
    assert litter(room) == []
    require_whole(room)
    Morphology.load(room / "pad" / "morphology.json")
