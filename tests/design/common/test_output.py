"""Folders for results: one run at a time, and nothing left of a run that made nothing."""

import subprocess
import sys

import pytest

from design.common.errors import InputError
from design.common.files import claimed, refuse_unwritable, staged

CLAIM = "import sys\nfrom pathlib import Path\nfrom design.common.files import claimed\n"
ANOTHER = CLAIM + "try:\n  with claimed(Path(sys.argv[1])): print('in')\nexcept ValueError as error: print(error)"


def another(folder):
    return subprocess.run([sys.executable, "-c", ANOTHER, folder], capture_output=True, text=True, check=True).stdout


def test_one_run_at_a_time_writes_to_a_folder(tmp_path):
    folder = tmp_path / "out" / "pad"
    with claimed(folder):
        assert "another run is writing there" in another(folder)
        with pytest.raises(InputError, match="another run is writing there"), claimed(folder):
            pass
        assert another(tmp_path / "out" / "other") == "in\n"
    assert another(folder) == "in\n"


def test_a_claim_ends_with_its_process(tmp_path):
    code = CLAIM + "import os\nwith claimed(Path(sys.argv[1])): os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code, tmp_path], check=False).returncode == 9
    assert another(tmp_path) == "in\n"


def test_a_folder_made_for_nothing_goes_again(tmp_path):
    with pytest.raises(KeyError), claimed(tmp_path / "a" / "b"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    with claimed(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "result").touch()
    assert (tmp_path / "a" / "b" / "result").exists()
    (tmp_path / "kept").mkdir()
    with claimed(tmp_path / "kept"):
        pass
    assert (tmp_path / "kept").exists()


def test_what_is_in_the_way_is_named(tmp_path):
    (tmp_path / "file").touch()
    for taken in (refuse_unwritable, lambda path: claimed(path).__enter__()):
        with pytest.raises(InputError, match="is a file, expected a folder"):
            taken(tmp_path / "file" / "deeper")


def test_staged_files_appear_together_or_not_at_all(tmp_path):
    def work(fails):
        with staged(tmp_path / "out") as folder:
            (folder / "one").write_text("1")
            if fails:
                raise KeyError
            (folder / "two").write_text("2")

    with pytest.raises(KeyError):
        work(fails=True)
    assert list((tmp_path / "out").iterdir()) == []
    work(fails=False)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["one", "two"]


def test_a_folder_in_the_way_of_a_staged_file_moves_none(tmp_path):
    (tmp_path / "two").mkdir()
    (tmp_path / "one").write_text("old")

    def work():
        with staged(tmp_path) as folder:
            for name in ("one", "two"):
                (folder / name).write_text("new")

    with pytest.raises(InputError, match="two: is a folder, expected a file or nothing"):
        work()
    assert (tmp_path / "one").read_text() == "old"
    (tmp_path / "two").rmdir()
    work()
    assert [(tmp_path / name).read_text() for name in ("one", "two")] == ["new", "new"]
