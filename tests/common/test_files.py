import errno
import json
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from padforge.common import files
from padforge.common.validation import InputError
from tests.helpers.folders import files_in
from tests.helpers.power_cut import ON_LINUX, Disk

LOCK = "import sys, os\nfrom pathlib import Path\nfrom padforge.common.files import locked_folder\n"


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


def test_errors_of_reading_and_writing_name_the_file(tmp_path, monkeypatch):
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
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match="does not allow it; choose another folder"):
        files.check_writable(tmp_path / "new")


def test_nested_atomic_file_is_renamed_once_with_ordinary_permissions(tmp_path):
    with files.atomic_file(tmp_path / "a.txt") as outer, files.atomic_file(outer) as inner:
        inner.write_text("whole")
        assert outer == inner
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    mask = os.umask(0o022)
    try:
        files.write_json(tmp_path / "a.json", {})
    finally:
        os.umask(mask)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o644


def locked_by_another(folder, does):
    code = f"{LOCK}with locked_folder(Path(sys.argv[1])): {does}"
    return subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, check=False)


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
        assert "another run is writing there" in locked_by_another(folder, "pass").stderr
        with pytest.raises(InputError, match="another run is writing there"), files.locked_folder(folder):
            pass
    assert locked_by_another(folder, "os._exit(9)").returncode == 9
    assert {path.name for path in folder.iterdir()} == {".lock"}
    with files.locked_folder(folder), files.locked_folder(tmp_path / "out" / "other"):
        pass
    assert list(folder.iterdir()) == []


def replaced(folder, *names, without=(), text="new"):
    with files.atomic_files(folder, without) as stage:
        for name in names:
            (stage / name).parent.mkdir(exist_ok=True)
            (stage / name).write_text(text)
            if name == "fails":
                raise KeyError


def texts(folder):
    return {name: content.decode() for name, content in files_in(folder).items()}


def test_atomic_files_moves_and_removes_all_or_none(tmp_path):
    with pytest.raises(KeyError):
        replaced(tmp_path / "out", "one", "fails")
    assert texts(tmp_path / "out") == {}
    replaced(tmp_path / "out", "one", "two", "mine", "in/four", "in/five", text="old")
    replaced(tmp_path / "out", "one", "in/four", ".unfinished-of-a-library/file", without=["two", "three", "in/five"])
    assert texts(tmp_path / "out") == {"one": "new", "mine": "old", "in/four": "new"}
    (tmp_path / "out" / "two").mkdir()
    with pytest.raises(InputError, match="two: is a folder, expected a file or nothing"):
        replaced(tmp_path / "out", "mine", "two")
    with pytest.raises(InputError, match="mine: cannot be written"):  # a file where a folder should be
        replaced(tmp_path / "out", "one", "mine/six")
    assert texts(tmp_path / "out") == {"one": "new", "mine": "old", "in/four": "new"}


@ON_LINUX
def test_what_is_written_outlasts_a_power_cut(tmp_path, monkeypatch):
    disk, folder = Disk(monkeypatch), tmp_path / "a" / "b"
    for text in ("old", "new"):
        files.write_text(folder / "file.txt", text)
        replaced(folder / "set", "a.json", "b.csv", "in/c.png", text=text)
        for name in ("file.txt", "set/a.json", "set/b.csv", "set/in/c.png"):
            assert disk.read(folder / name) == text.encode()
    assert all(disk.has_name(path) for path in (folder.parent, folder, folder / "set", folder / "set" / "in"))
    assert disk.torn == []


@ON_LINUX
def test_folder_is_written_on_disks_that_synchronise_no_folders(tmp_path, monkeypatch):
    fsync = os.fsync

    def fail(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", fail)
    files.write_text(tmp_path / "file.txt", "new")
    assert (tmp_path / "file.txt").read_text(encoding="utf-8") == "new"


def test_find_unchanged_compares_digests_of_local_files_and_sha256_covers_folders(tmp_path):
    for path in (tmp_path / "a", tmp_path / "b", tmp_path / "in" / "c", tmp_path / "figures" / "d"):
        files.write_json(path, {})
    digest = files.sha256(tmp_path / "a")
    (tmp_path / "b").write_text("changed")
    names = ["a", "b", "c", "../a", "..", "", "in", "in/c", "figures/d", "figures/../a", str(tmp_path / "a")]
    assert files.find_unchanged(tmp_path, dict.fromkeys(names, digest)) == {"a", "figures/d"}
    assert files.find_unchanged(tmp_path, {"a": None, "c": [1]}) == set()
    before = files.sha256(tmp_path)
    (tmp_path / "a").write_text("2")
    assert files.sha256(tmp_path) != before
    files.write_json(tmp_path / "a", {})
    (tmp_path / files.LOCK).touch()
    assert files.sha256(tmp_path) == before
    (tmp_path / "a").rename(tmp_path / os.fsdecode(b"\xff") if sys.platform == "linux" else tmp_path / "d")
    assert files.sha256(tmp_path) != before


def test_leftovers_of_killed_runs_go_after_a_day_and_links_are_not_followed(tmp_path):
    (tmp_path / "mine").mkdir()
    (folder := tmp_path / "out").mkdir()
    for name in (".unfinished-old", ".unfinished-new", "unfinished-mine"):
        (folder / name / "deeper").mkdir(parents=True)
    (folder / ".unfinished-link").symlink_to(tmp_path / "mine")
    for name in (".unfinished-old", "unfinished-mine"):
        os.utime(folder / name, (0, 0))
    os.utime(tmp_path / "mine", (0, 0))
    with files.locked_folder(folder):
        names = {path.name for path in folder.iterdir()}
    assert names == {".lock", ".unfinished-new", ".unfinished-link", "unfinished-mine"}
    assert (tmp_path / "mine").is_dir()


PAD = "morphology.json"


def document(path: Path, inputs: object = None, **more: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    provenance = {"command": path.name, "inputs": inputs}
    files.write_json(path, {"format": "padforge-some/1", "provenance": provenance, **more})
    return path


def test_find_dependents_follows_chains_and_ignores_other_files(tmp_path: Path) -> None:
    """Of a pad with its mould, its recording, and what was learnt from that."""
    pad = document(tmp_path / PAD, format="padforge-morphology/1")
    digest = {PAD: files.sha256(pad)}
    document(tmp_path / "design.json", morphology_sha256=digest[PAD])
    document(tmp_path / "fabrication.json", digest)
    document(tmp_path / "recording" / "start.json", digest)
    for name in ("localizer.json", "health/commanded.json"):
        document(tmp_path / name, {"recording": "of its readings"})
    model: dict[str, Any] = json.loads((tmp_path / "localizer.json").read_text())["provenance"]
    document(tmp_path / "fibre_loss.json", {"recording": "of its readings", "localizer": model})
    document(tmp_path / "edited.json", digest, format="padforge-morphology/1")
    document(tmp_path / "contacts.json", {PAD: "of another pad"})
    learnt = ["fibre_loss.json", "health/commanded.json", "localizer.json"]
    made = ["design.json", "fabrication.json", *learnt, "recording"]
    assert files.find_dependents(pad) == made
    assert files.find_dependents(pad, remade=["design.json", "recording"]) == made[1:5]
    assert files.find_dependents(tmp_path / "localizer.json") == ["fibre_loss.json"]
    for name in ("edited.json", "contacts.json"):
        assert files.find_dependents(tmp_path / name) == []
    (tmp_path / "folder.json").mkdir()
    document(tmp_path / ".unfinished-set-0" / "start.json", digest)
    for content in ("", "[]", '{"provenance": {"inputs": [1]}}'):
        (tmp_path / "other.json").write_text(content)
        assert files.find_dependents(pad) == made
