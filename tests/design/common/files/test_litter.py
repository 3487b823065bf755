"""What killed runs leave goes with the next one: by names of exactly their form, where nobody is at work, no links."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from design.common.files import atomic, claimed, clear_litter, scratch, staged, unfinished_file, write_json

pytestmark = pytest.mark.skipif(os.name != "posix", reason="nobody else can tell that a run is no more")

NUMBER = "0123456789abcdef"
FILES = (f".unfinished-{NUMBER}", f".unfinished-{NUMBER}.json", f".unfinished-{NUMBER}.with space")
FOLDERS = (f".unfinished-set-{NUMBER}",)
NEAR = (
    ".unfinished-",
    ".unfinished-set-",
    ".unfinished-notes.txt",
    f".unfinished-{NUMBER[:-1]}.json",
    f".unfinished-{NUMBER}0.json",
    f".unfinished-{NUMBER.upper()}.json",
    f".unfinished-{NUMBER}.tar.gz",
    f".unfinished-{NUMBER}\n",
    f"x.unfinished-{NUMBER}",
    f"unfinished-{NUMBER}",
    f".unfinished-set-{NUMBER}.json",
    f".unfinished-Set-{NUMBER}",
    f".rec-{NUMBER}",
    f".recording-{NUMBER}",
)
"""Names like those of litter that are none."""


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def write_one(folder: Path) -> None:
    write_json(folder / "new.json", {})


def write_some(folder: Path) -> None:
    with staged(folder) as stage:
        (stage / "new.json").touch()


def claim(folder: Path) -> None:
    with claimed(folder):
        (folder / "new.json").touch()


@pytest.mark.parametrize("work", [write_one, write_some, claim])
def test_litter_goes_and_what_is_named_nearly_so_stays(tmp_path: Path, work) -> None:
    for name in FILES:
        (tmp_path / name).write_text("half")
    for name in FOLDERS:
        (tmp_path / name / "deeper").mkdir(parents=True)
        (tmp_path / name / "deeper" / "half").touch()
    for i, name in enumerate(NEAR):
        for kind in ("file", "folder"):
            place = tmp_path / name if (kind == "file") == bool(i % 2) else tmp_path / f"{name} "
            place.touch() if kind == "file" else place.mkdir()
    near = names(tmp_path) - {*FILES, *FOLDERS}
    work(tmp_path)
    assert names(tmp_path) == near | {"new.json"}


def test_files_and_folders_are_not_taken_for_each_other_and_links_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work").touch()
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / FILES[0]).mkdir()
    (folder / FOLDERS[0]).touch()
    (folder / f".unfinished-{NUMBER[::-1]}").symlink_to(tmp_path / "mine" / "work")
    (folder / f".unfinished-set-{NUMBER[::-1]}").symlink_to(tmp_path / "mine")
    os.mkfifo(folder / f".unfinished-{NUMBER[::-1]}.pipe")
    before = names(folder)
    clear_litter(folder)
    assert names(folder) == before
    (folder / f".unfinished-set-{NUMBER[1:]}0").mkdir()
    (folder / f".unfinished-set-{NUMBER[1:]}0" / "link").symlink_to(tmp_path / "mine")
    clear_litter(folder)
    assert names(folder) == before
    assert names(tmp_path / "mine") == {"work"}


def test_what_somebody_is_at_work_with_stays(tmp_path: Path) -> None:
    with scratch(tmp_path), unfinished_file(tmp_path, ".json"), atomic(tmp_path / "a.txt"):
        at_work = names(tmp_path)
        assert len(at_work) == 3
        clear_litter(tmp_path)
        code = (
            "import sys, pathlib\nfrom design.common.files import clear_litter\nclear_litter(pathlib.Path(sys.argv[1]))"
        )
        subprocess.run([sys.executable, "-c", code, tmp_path], check=True)
        assert names(tmp_path) == at_work
    assert names(tmp_path) == {"a.txt"}


def test_what_is_another_ones_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / FILES[0]).touch()
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    clear_litter(tmp_path)
    assert names(tmp_path) == {FILES[0]}


def test_on_a_disk_without_locks_work_is_done_and_nothing_cleared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_here(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    (tmp_path / FILES[0]).touch()
    monkeypatch.setattr("fcntl.flock", none_here)
    claim(tmp_path)
    assert names(tmp_path) == {FILES[0], "new.json"}
