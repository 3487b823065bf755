"""A kill between any two file operations leaves the old set of files, the new one, or one without its document."""

import os
from pathlib import Path

import pytest

from padforge.common import files
from padforge.common.validation import InputError
from tests.helpers.kills import after_kills

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills as POSIX has them")

NAMES = ("a.csv", "b.png", "mine.txt", "set.json")


def make_set(folder: Path) -> None:
    """A folder with files of an earlier run, and one of a person."""
    folder.mkdir()
    for name in NAMES:
        (folder / name).write_text("old")


def replace_set(folder: Path) -> None:
    with files.locked_folder(folder), files.atomic_files(folder, without=["a.csv"]) as stage:
        for name in ("b.png", "c.csv", "set.json"):
            (stage / name).write_text("new")


def read_set(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.glob("[!.]*")}


def test_atomic_files_after_a_kill_at_any_operation(tmp_path: Path) -> None:
    old = dict.fromkeys(NAMES, "old")
    new = {"b.png": "new", "c.csv": "new", "set.json": "new", "mine.txt": "old"}
    results = []
    for folder in after_kills(replace_set, make_set, tmp_path):
        after = read_set(folder)
        results.append("old" if after == old else "new" if after == new else "refused")
        assert after["mine.txt"] == "old"
        if results[-1] == "refused":
            with pytest.raises(InputError, match=r"set\.json: cannot be read"):
                files.read_json(folder / "set.json", "set/1")
        replace_set(folder)  # nothing that a kill leaves is in the way of the next run
        assert read_set(folder) == new
    assert sorted(set(results), key=results.index) == ["old", "refused", "new"]
    assert results == sorted(results, key=["old", "refused", "new"].index)


def test_atomic_file_after_a_kill_at_any_operation(tmp_path: Path) -> None:
    folders = after_kills(lambda folder: files.write_text(folder / "set.json", "new"), make_set, tmp_path)
    results = [(folder / "set.json").read_text() for folder in folders]
    assert results == sorted(results, reverse=True)
    assert {*results} == {"old", "new"}
