"""Commands on disks that are full or closed leave all or nothing."""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import sense

NOBODY = 65_534
COMMANDS = {
    "record": "record --out OUT/rec",
    "import": "import whole.csv --out OUT/rec",
    "calibrate": "calibrate rec --seed 3 --out OUT",
    "export": "export rec OUT/table.csv",
    "locate": "locate --model model rec --out OUT/places.csv",
}


@pytest.fixture(scope="module")
def bench(few_made: Path) -> Iterator[Path]:
    """As the folder of `few`, with a table, that every user may look into."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(few_made, folder, dirs_exist_ok=True)
        sense.export_csv(sense.Recording.open(folder / "rec"), folder / "whole.csv")
        folder.chmod(0o755)
        yield folder


@contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """No file gets longer than `limit` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def closed(folder: Path) -> Iterator[None]:
    """Nobody may write into a folder, not even who runs the tests."""
    folder.chmod(0o555)
    user, group = os.geteuid(), os.getegid()
    if user == 0:
        os.setegid(NOBODY)
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(user)
        os.setegid(group)
        folder.chmod(0o755)


@pytest.mark.parametrize("name", COMMANDS)
def test_all_or_nothing_is_left(padforge_sense, bench: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Where a model was it stays; whatever the limit, nothing is left of what did not fit."""
    monkeypatch.chdir(bench)
    out = bench / name
    if name == "calibrate":
        sense.Localizer.load(bench / "model").save(out)
    out.mkdir(exist_ok=True)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    words = COMMANDS[name].replace("OUT", str(out)).split()
    for place in (full_disk(0), full_disk(1000), full_disk(20_000), closed(out)):
        with place:
            code, _, err = padforge_sense(*words)
        if code == 0:  # it fitted
            assert name == "locate"
            (out / "places.csv").unlink()
        else:
            assert (code, err.count("padforge: "), "Traceback" in err) == (2, 1, False), err
            assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert str(out) in err
    assert padforge_sense(*words)[0] == 0
    if name in ("record", "import"):
        assert len(sense.Recording.open(out / "rec").begun) == 60


def test_two_imports_into_one_folder_leave_one_of_them_whole(bench: Path, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "padforge", "sense", "import", "whole.csv", "--out", str(tmp_path / "rec")]
    running = [subprocess.Popen(line, cwd=bench, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) for _ in range(2)]
    said = [each.communicate()[1].decode() for each in running]
    assert sorted(each.returncode for each in running) == [0, 2], said
    assert [text.count("\n") for text in sorted(said, key=len)] == [0, 1]
    assert len(sense.Recording.open(tmp_path / "rec").begun) == 60
    assert [path.name for path in tmp_path.iterdir()] == ["rec"]
