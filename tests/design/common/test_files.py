"""Atomic writes of files and sets of files, locks, JSON documents, and dependents of a file."""

import errno
import json
import os
import stat
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from padforge.design.common import files
from padforge.design.common.files import EXCHANGE
from padforge.design.common.validation import InputError
from tests.helpers.power_cut import ON_LINUX, Disk

LOCK = "import sys\nfrom pathlib import Path\nfrom padforge.design.common.files import locked_folder\n"
ANOTHER = LOCK + "try:\n  with locked_folder(Path(sys.argv[1])): print('in')\nexcept ValueError as error: print(error)"


def test_atomic_file_keeps_the_old_file_when_writing_fails(tmp_path):
    path = tmp_path / "result.json"
    files.write_json(path, {"format": "x/1"})

    def fail_halfway():
        with files.atomic_file(path) as temporary:
            temporary.write_text("half a fi")
            raise RuntimeError("halfway")

    with pytest.raises(RuntimeError, match="halfway"):
        fail_halfway()
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(path, {"value": float("nan")})
    assert files.read_json(path, "x/1") == {"format": "x/1"}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as POSIX has them")
def test_pipes_are_neither_read_nor_replaced(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    for use, problem in (
        (lambda: files.read_json(pipe, "x/1"), r"read \(a pipe or device"),
        (lambda: files.sha256(pipe), r"read \(a pipe or device"),
        (lambda: files.write_json(pipe, {}), "written"),
    ):
        with pytest.raises(InputError, match=rf"pipe\.json: cannot be {problem}"):
            use()
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_errors_of_reading_and_writing_name_the_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("123456")
    assert files.read_bytes(path, 6) == b"123456"
    with pytest.raises(InputError, match=r"it has 6 bytes, allowed are 5"):
        files.read_bytes(path, 5)
    with pytest.raises(InputError, match=r"file/new\.json: cannot be written"):
        files.write_json(path / "new.json", {})
    for taken in (files.check_writable, lambda path: files.locked_folder(path).__enter__()):
        with pytest.raises(InputError, match="is a file, expected a folder"):
            taken(path / "deeper")


def test_nested_atomic_file_is_renamed_once_with_ordinary_permissions(tmp_path):
    with files.atomic_file(tmp_path / "a.txt") as outer, files.atomic_file(outer) as inner:
        inner.write_text("whole")
        assert list(tmp_path.iterdir()) == [outer]
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    mask = os.umask(0o022)
    try:
        files.write_json(tmp_path / "a.json", {})
    finally:
        os.umask(mask)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o644


def another(folder):
    return subprocess.run([sys.executable, "-c", ANOTHER, folder], capture_output=True, text=True, check=True).stdout


def test_locked_folder_admits_one_run_and_is_removed_again_if_created_and_empty(tmp_path):
    with pytest.raises(KeyError), files.locked_folder(tmp_path / "a" / "b"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    with files.locked_folder(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "result").touch()
    assert (tmp_path / "a" / "b" / "result").exists()
    (tmp_path / "kept").mkdir()
    with files.locked_folder(tmp_path / "kept"):
        pass
    assert (tmp_path / "kept").exists()
    folder = tmp_path / "out" / "pad"
    with files.locked_folder(folder):
        assert "another run is writing there" in another(folder)
        with pytest.raises(InputError, match="another run is writing there"), files.locked_folder(folder):
            pass
    code = LOCK + "import os\nwith locked_folder(Path(sys.argv[1])): os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code, folder], check=False).returncode == 9
    with files.locked_folder(folder), files.locked_folder(tmp_path / "out" / "other"):
        pass


def replaced(folder, *names, without=(), text="new"):
    with files.atomic_files(folder, without) as stage:
        for name in names:
            (stage / name).write_text(text)
            if name == "fails":
                raise KeyError


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_atomic_files_moves_and_removes_all_or_none(tmp_path):
    with pytest.raises(KeyError):
        replaced(tmp_path / "out", "one", "fails")
    assert contents(tmp_path / "out") == {}
    replaced(tmp_path / "out", "one", "two", "mine", text="old")
    replaced(tmp_path / "out", "one", without=["two", "three"])
    assert contents(tmp_path / "out") == {"one": "new", "mine": "old"}
    (tmp_path / "out" / "two").mkdir()
    with pytest.raises(InputError, match="two: is a folder, expected a file or nothing"):
        replaced(tmp_path / "out", "mine", "two")
    assert (tmp_path / "out" / "mine").read_text() == "old"


@pytest.mark.parametrize("stop", [KeyboardInterrupt, PermissionError])
def test_interrupted_move_reads_as_the_new_set_and_the_next_run_completes_it(tmp_path, monkeypatch, stop):
    for name in ("b", "d", "mine", "removed"):
        (tmp_path / name).write_text("old")
    replace = Path.replace
    stops = iter([stop])

    def stopped(self, target):
        if self.name == "d" and (error := next(stops, None)):
            raise error
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", stopped)
    with pytest.raises(KeyboardInterrupt if stop is KeyboardInterrupt else InputError):
        replaced(tmp_path, "a", "b", "c", "d", without=["removed"])
    assert {files.read_bytes(tmp_path / name) for name in "abcd"} == {b"new"}
    assert (tmp_path / EXCHANGE).exists() == (stop is PermissionError)  # an interrupt waits for the end of the move
    with files.locked_folder(tmp_path):
        assert contents(tmp_path) == dict.fromkeys("abcd", "new") | {"mine": "old"}


def test_documents_that_hold_digests_move_last(tmp_path, monkeypatch):
    """Whoever reads one finds the files that it names."""
    moved, replace = [], Path.replace

    def noted(self, target):
        moved.append(self.name)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", noted)
    replaced(tmp_path, "a.json", "z.stl", "c.json", "b.png")
    assert moved == ["b.png", "z.stl", "a.json", "c.json"]


LINUX = pytest.mark.skipif(
    sys.platform != "linux", reason="files are named by their descriptors, synchronised by fsync"
)


@ON_LINUX
def test_atomic_file_outlasts_a_power_cut(tmp_path, monkeypatch):
    disk, path = Disk(monkeypatch), tmp_path / "a" / "b" / "file.txt"
    for text in ("old", "new"):
        files.write_text(path, text)
        assert disk.read(path) == text.encode()
    assert disk.has_name(tmp_path / "a")
    assert disk.has_name(tmp_path / "a" / "b")
    assert disk.torn == []


@ON_LINUX
def test_atomic_files_are_all_old_or_all_new_after_a_power_cut_at_any_rename(tmp_path, monkeypatch):
    disk, folder = Disk(monkeypatch), tmp_path / "pad"
    names, renamed = ("a.json", "b.csv"), []

    def check(source: Path) -> None:
        renamed.append(source.name)
        if source.parent.name == EXCHANGE:  # a file moves: the exchange that says so lasts, with all of them
            assert disk.has_name(folder / EXCHANGE)
        if source.name == EXCHANGE:  # it ends: all of them have arrived
            assert [disk.read(folder / name) for name in names] == [text, text]
        elif source.parent == folder:  # it begins
            assert [disk.read(source / name) for name in names] == [text, text]

    disk.on_rename = check
    for text in (b"old", b"new"):
        with files.atomic_files(folder) as stage:
            for name in names:
                (stage / name).write_bytes(text)
        assert [disk.read(folder / name) for name in names] == [text, text]
    assert len(renamed) == 2 * 4
    assert disk.has_name(folder)
    assert disk.torn == []


@ON_LINUX
@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_folder_is_written_on_disks_that_synchronise_no_folders(tmp_path, monkeypatch, number):
    fsync = os.fsync

    def fail(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", fail)
    with nullcontext() if number == errno.EINVAL else pytest.raises(InputError, match="cannot be written"):
        files.write_text(tmp_path / "file.txt", "new")
    assert (tmp_path / "file.txt").read_text(encoding="utf-8") == "new"


def test_commit_waits_for_the_exchange_of_another_run(tmp_path, monkeypatch):
    rename = Path.rename
    busy = iter([OSError(errno.ENOTEMPTY, "Directory not empty")])

    def late(self, target):
        if target.name == EXCHANGE and (error := next(busy, None)):
            replaced(tmp_path, "b", "e", text="another's")
            raise error
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", late)
    replaced(tmp_path, "a", "b")
    assert contents(tmp_path) == {"a": "new", "b": "new", "e": "another's"}


@pytest.mark.skipif(getattr(os, "geteuid", int)() != 0, reason="root alone may give files away")
def test_atomic_files_moves_nothing_over_a_protected_file_of_another_user(tmp_path, monkeypatch):
    folder = tmp_path / "shared"
    folder.mkdir()
    (folder / "b").write_text("another's")
    os.chown(folder, 12346, 12346)
    os.chown(folder / "b", 12345, 12345)
    folder.chmod(0o1777)
    monkeypatch.setattr(os, "geteuid", lambda: 12347)
    with pytest.raises(InputError, match="b: cannot be written, it belongs to another user"):
        replaced(folder, "a", "b")
    assert (folder / "b").read_text() == "another's"
    assert not (folder / "a").exists()


def test_find_unchanged_compares_digests_in_one_folder_and_sha256_covers_folders(tmp_path):
    for path in (tmp_path / "a", tmp_path / "b", tmp_path / "in" / "c"):
        files.write_json(path, {})
    digest = files.sha256(tmp_path / "a")
    (tmp_path / "b").write_text("changed")
    names = ["a", "b", "c", "../a", "", "in", "in/c", str(tmp_path / "a"), "a\0", "a" * 1000, "\ud800"]
    assert files.find_unchanged(tmp_path, dict.fromkeys(names, digest)) == {"a"}
    assert files.find_unchanged(tmp_path, {"a": None, "c": [1]}) == set()
    before = files.sha256(tmp_path)
    (tmp_path / "a").write_text("2")
    assert files.sha256(tmp_path) != before
    files.write_json(tmp_path / "a", {})
    assert files.sha256(tmp_path) == before
    (tmp_path / "a").rename(tmp_path / os.fsdecode(b"\xff") if sys.platform == "linux" else tmp_path / "d")
    assert files.sha256(tmp_path) != before


@pytest.fixture
def windows(monkeypatch):
    """Bytes are locked by the file they are of, until that is closed; a file may go with its last descriptor."""
    taken: dict[int, tuple[int, int]] = {}

    def locking(handle, mode, count):
        about = os.fstat(handle)
        for other, inode in list(taken.items()):
            try:
                alive = (os.fstat(other).st_dev, os.fstat(other).st_ino) == inode
            except OSError:
                alive = False
            if alive and other != handle and inode == (about.st_dev, about.st_ino):
                raise PermissionError(13, "in use")
        taken[handle] = (about.st_dev, about.st_ino)

    monkeypatch.setattr(files, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))  # pyright: ignore


@pytest.mark.skipif(sys.platform == "win32", reason="it is no stand-in there")
def test_locks_on_windows_exclude_writers_but_not_readers(windows, tmp_path):
    for _ in range(2):
        with (
            files.locked_folder(tmp_path),
            pytest.raises(InputError, match="another run is writing there"),
            files.locked_folder(tmp_path),
        ):
            pass
    (tmp_path / "journal").write_bytes(b"line\n")
    with (tmp_path / "journal").open("r+b", buffering=0) as first, (tmp_path / "journal").open("rb") as second:
        first.seek(3)
        files.lock(first, "busy")
        assert first.tell() == 3
        with pytest.raises(InputError, match="busy"):
            files.lock(second, "busy")
        assert second.read() == b"line\n"


PAD = "morphology.json"


def document(path: Path, inputs: object = None, **more: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    provenance = {"command": path.name, "inputs": inputs}
    files.write_json(path, {"format": "padforge-some/1", "provenance": provenance, **more})
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A pad with its mould, its recording, and what was learnt from that."""
    pad = document(tmp_path / PAD, format="padforge-morphology/1")
    digest = {PAD: files.sha256(pad)}
    document(tmp_path / "design.json", morphology_sha256=digest[PAD])
    document(tmp_path / "fabrication.json", digest)
    document(tmp_path / "recording" / "start.json", digest)
    document(tmp_path / "localizer.json", {"recording": "of its readings"})
    model: dict[str, Any] = json.loads((tmp_path / "localizer.json").read_text())["provenance"]
    document(tmp_path / "fibre_loss.json", {"recording": "of its readings", "localizer": model})
    document(tmp_path / "edited.json", digest, format="padforge-morphology/1")
    document(tmp_path / "contacts.json", {PAD: "of another pad"})
    return tmp_path


def test_find_dependents_follows_chains(folder: Path) -> None:
    made = ["design.json", "fabrication.json", "fibre_loss.json", "localizer.json", "recording"]
    assert files.find_dependents(folder / PAD) == made
    assert files.find_dependents(folder / PAD, remade=["design.json", "recording"]) == made[1:4]
    assert files.find_dependents(folder / "localizer.json") == ["fibre_loss.json"]
    assert files.find_dependents(folder / "edited.json") == files.find_dependents(folder / "contacts.json") == []


@pytest.mark.parametrize("content", ["", "[]", '{"provenance": 3}', '{"provenance": {"inputs": [1]}}', "[" * 10**5])
def test_find_dependents_ignores_other_files(folder: Path, content: str) -> None:
    before = files.find_dependents(folder / PAD)
    (folder / "other.json").write_text(content)
    (folder / "folder.json").mkdir()
    (folder / ".unfinished-set-0").mkdir()
    document(folder / ".unfinished-set-0" / "start.json", {PAD: files.sha256(folder / PAD)})
    assert files.find_dependents(folder / PAD) == before
