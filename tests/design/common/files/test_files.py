"""Atomic writing, self-describing JSON, and folders for results: one run at a time, nothing left of one that failed."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from design.common.errors import InputError
from design.common.files import (
    atomic,
    claimed,
    read_bytes,
    read_json,
    refuse_unwritable,
    sha256,
    staged,
    unchanged,
    write_json,
)
from design.common.files.folders import EXCHANGE

CLAIM = "import sys\nfrom pathlib import Path\nfrom design.common.files import claimed\n"
ANOTHER = CLAIM + "try:\n  with claimed(Path(sys.argv[1])): print('in')\nexcept ValueError as error: print(error)"


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "result.json"
    write_json(path, {"format": "x/1"})

    def fail_halfway():
        with atomic(path) as temporary:
            temporary.write_text("half a fi")
            raise RuntimeError("halfway")

    with pytest.raises(RuntimeError, match="halfway"):
        fail_halfway()
    assert read_json(path, "x/1") == {"format": "x/1"}
    assert list(tmp_path.iterdir()) == [path]


def test_nan_is_refused_before_anything_is_replaced(tmp_path):
    path = tmp_path / "result.json"
    write_json(path, {"format": "x/1"})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"value": float("nan")})
    assert read_json(path, "x/1") == {"format": "x/1"}


def test_new_files_have_ordinary_permissions(tmp_path):
    mask = os.umask(0o022)
    try:
        write_json(tmp_path / "a.json", {})
    finally:
        os.umask(mask)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o644


def test_a_folder_has_a_digest_that_follows_its_content(tmp_path):
    (tmp_path / "a").write_text("1")
    before = sha256(tmp_path)
    (tmp_path / "a").write_text("2")
    assert sha256(tmp_path) != before
    (tmp_path / "a").write_text("1")
    assert sha256(tmp_path) == before
    (tmp_path / "a").rename(tmp_path / "b")
    assert sha256(tmp_path) != before
    if sys.platform == "linux":
        (tmp_path / os.fsdecode(b"\xff")).touch()
        assert len(sha256(tmp_path)) == 64


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as POSIX has them")
def test_a_pipe_is_neither_waited_for_nor_put_aside(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match=r"pipe\.json: cannot be read \(a pipe or device"):
        read_json(pipe, "x/1")
    with pytest.raises(InputError, match=r"pipe\.json: cannot be written"):
        write_json(pipe, {})
    with pytest.raises(InputError, match=r"pipe\.json: cannot be read \(a pipe or device"):
        sha256(pipe)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    path = tmp_path / "large.json"
    path.write_text("123456")
    assert read_bytes(path, 6) == b"123456"
    with pytest.raises(InputError, match=r"it has 6 bytes, allowed are 5"):
        read_bytes(path, 5)


def test_what_the_system_has_against_writing_names_the_file(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/new\.json: cannot be written"):
        write_json(tmp_path / "file" / "new.json", {})


def test_a_file_within_another_one_is_put_in_place_once(tmp_path):
    with atomic(tmp_path / "a.txt") as outer, atomic(outer) as inner:
        inner.write_text("whole")
        assert list(tmp_path.iterdir()) == [outer]
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


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


def replaced(folder, *names, without=(), text="new"):
    with staged(folder, without) as stage:
        for name in names:
            (stage / name).write_text(text)


def test_files_go_as_others_come(tmp_path):
    for name in ("one", "two", "mine"):
        (tmp_path / name).write_text("old")
    replaced(tmp_path, "one", without=["two", "three"])
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"one": "new", "mine": "old"}


@pytest.mark.parametrize("linked", [True, False])
@pytest.mark.parametrize("stop", [KeyboardInterrupt, PermissionError])
def test_what_was_there_is_put_back_where_not_all_can_be_moved(tmp_path, monkeypatch, stop, linked):
    for name in ("b", "d", "mine"):
        (tmp_path / name).write_text("old")
    replace = Path.replace

    def stopped(self, target):
        if self.name == "d" and self.read_text() == "new":
            raise stop
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", stopped)
    if not linked:  # as on disks that know no such
        monkeypatch.setattr(Path, "hardlink_to", lambda path, target: Path(target).rmdir())
    with pytest.raises(KeyboardInterrupt if stop is KeyboardInterrupt else InputError):
        replaced(tmp_path, "a", "b", "c", "d", without=["mine"])
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(("b", "d", "mine"), "old")


def test_what_another_run_does_meanwhile_is_no_fault_and_is_put_back(tmp_path, monkeypatch):
    """It takes a file away that is to be kept, and comes to its end as this run looks whether it has."""
    link, rename, replace = Path.hardlink_to, Path.rename, Path.replace
    busy = iter([OSError(errno.ENOTEMPTY, "Directory not empty")])

    def taken_away(self, target):
        if target.name == "gone":
            target.unlink()
        link(self, target)

    def late(self, target):
        if target.name == EXCHANGE and (error := next(busy, None)):
            replaced(tmp_path, "b", "e", text="another's")
            raise error
        return rename(self, target)

    def full(self, target):
        if self.name == "b" and self.read_text() == "new":
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(self, target)

    for name in ("b", "gone"):
        (tmp_path / name).write_text("old")
    for name, stand_in in (("hardlink_to", taken_away), ("rename", late), ("replace", full)):
        monkeypatch.setattr(Path, name, stand_in)
    with pytest.raises(InputError, match="No space left"):
        replaced(tmp_path, "a", "b", without=["gone"])
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"b": "another's", "e": "another's"}


@pytest.mark.skipif(os.name != "posix", reason="nobody else can tell that a run is no more")
def test_what_a_killed_run_has_left_goes_with_the_next_and_nothing_else(tmp_path):
    code = "import os, sys\nfrom pathlib import Path\nfrom design.common.files import staged\n"
    code += "with staged(Path(sys.argv[1])) as stage: (stage / 'half').touch(); os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code, tmp_path], check=False).returncode == 9
    (tmp_path / ".unfinished-mine").mkdir()
    assert len(list(tmp_path.iterdir())) == 2
    with staged(tmp_path) as stage:
        (stage / "slow").touch()
        replaced(tmp_path, "one")
    assert {path.name for path in tmp_path.iterdir()} == {".unfinished-mine", "one", "slow"}


def test_files_are_known_by_their_digests_in_one_folder_only(tmp_path):
    for path in (tmp_path / "a", tmp_path / "b", tmp_path / "in" / "c"):
        write_json(path, {})
    digest = sha256(tmp_path / "a")
    (tmp_path / "b").write_text("changed")
    names = ["a", "b", "c", "../a", "/", "", "..", "in", "in/c", str(tmp_path / "a"), "a\0", "a" * 1000, "\ud800"]
    assert unchanged(tmp_path, dict.fromkeys(names, digest)) == {"a"}
    assert unchanged(tmp_path, {"a": None, "c": [1]}) == set()
