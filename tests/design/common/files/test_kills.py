"""A kill between any two file operations leaves what was there, or what was to come, and nothing that stays."""

import itertools
import os
import shutil
from pathlib import Path

import pytest

from design.common.errors import InputError
from design.common.files import atomic, claimed, read_bytes, staged
from design.common.files.folders import EXCHANGE
from tests.helpers.kills import killed

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")

OLD, NEW = ({"a": text, "b": text} for text in (b"old", b"new"))


def made(folder: Path) -> Path:
    """A folder with files of an earlier run, and one of a person."""
    folder.mkdir()
    for name in ("a", "b", "gone", "mine"):
        (folder / name).write_bytes(b"old")
    return folder


def renewed(folder: Path) -> None:
    with claimed(folder), staged(folder, without=["gone", "a"]) as stage:
        for name in ("a", "b", "c"):
            (stage / name).write_bytes(b"new")


def test_files_are_all_old_or_all_new_to_whoever_reads_them(tmp_path: Path) -> None:
    found = []
    for number in itertools.count():
        folder = made(tmp_path / str(number))
        ended = not killed(lambda folder=folder: renewed(folder), number, folder)
        copy = shutil.copytree(folder, tmp_path / f"{number} read first at b")
        assert read_bytes(copy / "b") == read_bytes(copy / "a")
        found.append({name: read_bytes(folder / name) for name in ("a", "b")})
        assert found[-1] in (OLD, NEW), number
        assert [(folder / name).exists() for name in ("c", "gone")] == (
            [True, False] if found[-1] == NEW else [False, True]
        )
        assert (folder / "mine").read_bytes() == b"old"
        renewed(folder)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == NEW | {"c": b"new", "mine": b"old"}
        if ended:
            break
    assert len(found) > 15
    assert found[0] == OLD
    assert (
        sum(found[i] != found[i + 1] for i in range(len(found) - 1)) == 1
    )  # there is one moment in which they are renewed


def test_the_next_run_clears_up_a_file_that_was_being_written(tmp_path: Path) -> None:
    def write() -> None:
        with atomic(tmp_path / "a.json") as temporary:
            temporary.write_bytes(b"new")

    left = set()
    for number in range(3):
        assert killed(write, number, tmp_path)
        left |= {path.name.partition("-")[0] for path in tmp_path.iterdir()}
    assert left == {".unfinished"}
    write()
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_link_is_no_exchange(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a").write_bytes(b"another")
    folder = made(tmp_path / "out")
    (folder / EXCHANGE).symlink_to(tmp_path / "elsewhere")
    assert read_bytes(folder / "a") == b"old"
    with pytest.raises(InputError):
        renewed(folder)
    assert (folder / "a").read_bytes() == (folder / "gone").read_bytes() == b"old"
    assert (tmp_path / "elsewhere" / "a").read_bytes() == b"another"


ODD = '["../mine", "", "..", "/", "\\u0000", "\\ud800", 3, null, "gone"]'


@pytest.mark.parametrize("note", ["", "3", "[" * 100_000, ODD])
def test_a_torn_or_odd_note_takes_nothing_out_of_other_folders(tmp_path: Path, note: str) -> None:
    folder = made(tmp_path / "out")
    (tmp_path / "mine").touch()
    exchange = folder / EXCHANGE
    (exchange / "folder").mkdir(parents=True)
    (exchange / "a").write_bytes(b"new")
    (exchange / "b").symlink_to(tmp_path / "mine")
    (exchange / ".unfinished-gone").write_text(note)
    assert read_bytes(folder / "a") == b"new"
    assert (folder / "b").read_bytes() == b"old"
    assert {path.name for path in folder.iterdir()} == {"a", "b", "mine"} | ({"gone"} if note != ODD else set())
    assert {path.name for path in tmp_path.iterdir()} == {"out", "mine"}


@pytest.mark.skipif(getattr(os, "geteuid", int)() == 0, reason="root may write everywhere")
def test_who_may_not_put_files_in_place_is_told_so(tmp_path: Path) -> None:
    folder = made(tmp_path / "out")
    (folder / EXCHANGE).mkdir()
    (folder / EXCHANGE / "a").write_bytes(b"new")
    folder.chmod(0o555)
    with pytest.raises(InputError, match="cannot be written"):
        read_bytes(folder / "a")
    folder.chmod(0o755)
    assert read_bytes(folder / "a") == b"new"


def test_a_note_that_is_no_file_is_none(tmp_path: Path) -> None:
    folder = made(tmp_path / "out")
    for number, make in enumerate((os.mkfifo, lambda note: note.symlink_to("/dev/zero"))):
        (folder / EXCHANGE).mkdir()
        (folder / EXCHANGE / "a").write_text(f"new {number}")
        make(folder / EXCHANGE / ".unfinished-gone")
        assert read_bytes(folder / "a") == f"new {number}".encode()
    assert (folder / "gone").exists()


@pytest.mark.skipif(getattr(os, "geteuid", int)() != 0, reason="root alone may give files away")
def test_where_anybody_may_put_files_nobody_replaces_those_of_others(tmp_path: Path) -> None:
    """As in /tmp: a name there that one reads must not let another user have files deleted by it."""
    folder = made(tmp_path / "out")
    folder.chmod(0o1777)
    exchange = folder / EXCHANGE
    exchange.mkdir()
    (exchange / "a").write_bytes(b"another")
    (exchange / ".unfinished-gone").write_text('["mine"]')
    os.chown(exchange, 12345, 12345)
    assert read_bytes(folder / "a") == (folder / "mine").read_bytes() == b"old"
    with pytest.raises(InputError, match="cannot be written"):
        renewed(folder)
    assert (folder / "a").read_bytes() == b"old"
    folder.chmod(0o775)  # those who share a folder may do so
    assert read_bytes(folder / "a") == b"another"
