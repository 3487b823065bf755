"""A kill between any two file operations leaves the old set of files, the new one, or one without its document.

A search that keeps its states goes on from them; torn ones are refused.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from padforge.common import files
from padforge.common.parallel import Checkpoints
from padforge.common.validation import InputError
from tests.helpers.kills import after_kills

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills as POSIX has them")

NAMES = ("a.csv", "b.png", "mine.txt", "set.json")


def make_set(folder: Path) -> None:
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


def work(folder: Path) -> None:
    """A search that keeps its states, goes on from them, and comes to its end."""
    kept = Checkpoints(folder, {"search": {"seed": 1}})
    states = kept.begin(resume=True)
    for start in range(2):
        kept.save(start, {"state": np.full(3, start)} | states.get(start, {}))
    assert set(Checkpoints(folder, {"search": {"seed": 1}}).begin(resume=True)) == {0, 1}
    kept.clear()


@pytest.mark.slow
def test_checkpoints_resume_after_a_kill_at_any_operation(tmp_path: Path) -> None:
    left = set()
    for folder in after_kills(lambda folder: work(folder / "search"), Path.mkdir, tmp_path):
        left |= {path.name.partition("-")[0] for path in (folder / "search").glob("*")}
        work(folder / "search")
        assert not list(folder.iterdir())
    assert left >= {".unfinished", "search.json", "start_0000.npz"}


def test_torn_states_are_refused_in_one_line(tmp_path: Path) -> None:
    Checkpoints(tmp_path, {}).save(0, {"state": np.zeros(100)})
    path = tmp_path / "start_0000.npz"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"start_0000\.npz: cannot be read"):
        Checkpoints(tmp_path, {}).begin(resume=True)
