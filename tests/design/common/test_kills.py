"""A kill between any two file operations leaves the old or the new set of files, and leftovers that are removed."""

import errno
import itertools
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from padforge.design.common import files
from padforge.design.common.files import EXCHANGE
from padforge.design.common.validation import InputError
from tools.kills import killed

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")

OLD, NEW = ({"a": text, "b": text} for text in (b"old", b"new"))


def made(folder: Path) -> Path:
    """A folder with files of an earlier run, and one of a person."""
    folder.mkdir()
    for name in ("a", "b", "gone", "mine"):
        (folder / name).write_bytes(b"old")
    return folder


def renewed(folder: Path) -> None:
    with files.locked_folder(folder), files.atomic_files(folder, without=["gone", "a"]) as stage:
        for name in ("a", "b", "c"):
            (stage / name).write_bytes(b"new")


@pytest.mark.slow
def test_atomic_files_reads_all_old_or_all_new_after_a_kill_at_any_operation(tmp_path: Path) -> None:
    found = []
    for number in itertools.count():
        folder = made(tmp_path / str(number))
        ended = not killed(lambda folder=folder: renewed(folder), number, folder)
        found.append({name: files.read_bytes(folder / name) for name in ("b", "a")})
        assert found[-1] in (OLD, NEW), number
        exist = [files.resolve_exchange(folder / name).exists() for name in ("c", "gone")]
        assert exist == [found[-1] == NEW, found[-1] == OLD]
        assert (folder / "mine").read_bytes() == b"old"
        renewed(folder)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == NEW | {"c": b"new", "mine": b"old"}
        if ended:
            break
    assert len(found) > 10
    assert found[0] == OLD
    assert sum(one != other for one, other in itertools.pairwise(found)) == 1  # the moment in which they are renewed


def test_atomic_file_removes_the_leftover_of_a_killed_run(tmp_path: Path) -> None:
    def write() -> None:
        with files.atomic_file(tmp_path / "a.json") as temporary:
            temporary.write_bytes(b"new")

    left = set()
    for number in range(3):
        assert killed(write, number, tmp_path)
        left |= {path.name.partition("-")[0] for path in tmp_path.iterdir()}
    assert left == {".unfinished"}
    write()
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_exchange_that_is_a_link_is_ignored_by_readers_and_refused_by_writers(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a").write_bytes(b"another")
    folder = made(tmp_path / "out")
    (folder / EXCHANGE).symlink_to(tmp_path / "elsewhere")
    assert files.read_bytes(folder / "a") == b"old"
    with pytest.raises(InputError):
        renewed(folder)
    assert (folder / "a").read_bytes() == (folder / "gone").read_bytes() == b"old"
    assert (tmp_path / "elsewhere" / "a").read_bytes() == b"another"


@pytest.fixture(scope="module")
def midway(tmp_path_factory: pytest.TempPathFactory) -> int:
    """After how many changes a run is putting its files in place: one of them is, and some are gone."""
    for number in range(50):
        folder = made(tmp_path_factory.mktemp("midway") / "out")
        killed(lambda folder=folder: renewed(folder), number, folder)
        if (folder / "a").read_bytes() != (folder / "b").read_bytes():
            return number
    raise AssertionError


@pytest.fixture
def broken_off(tmp_path: Path, midway: int) -> Path:
    """A folder in which a run was killed then."""
    folder = made(tmp_path / "out")
    assert killed(lambda: renewed(folder), midway, folder)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_reading_changes_nothing_and_the_next_writer_completes_the_exchange(broken_off: Path) -> None:
    before = content(broken_off)
    assert {name: files.read_bytes(broken_off / name) for name in ("a", "b")} == NEW
    digests = {name: files.sha256(broken_off / name) for name in ("a", "b", "mine")}
    assert files.find_unchanged(broken_off, digests) == {"a", "b", "mine"}
    with pytest.raises(InputError, match="cannot be read"):
        files.read_bytes(broken_off / "gone")
    assert content(broken_off) == before
    files.write_text(broken_off / "b", "newer")
    assert content(broken_off) == {"a": b"new", "b": b"newer", "c": b"new", "mine": b"old"}


@pytest.mark.parametrize("is_moved", [False, True])
def test_exchange_is_refused_in_another_folder(tmp_path: Path, broken_off: Path, is_moved: bool) -> None:
    """Neither who reads nor who writes there carries it out, and nobody takes its files for a set."""
    folder = tmp_path / "elsewhere"
    if is_moved:
        made(folder)
        (broken_off / EXCHANGE).rename(folder / EXCHANGE)
    else:
        shutil.copytree(broken_off, folder)
    before = content(folder)
    for use in (
        lambda: files.read_bytes(folder / "a"),
        lambda: renewed(folder),
        lambda: files.write_text(folder / "b", "another"),
    ):
        with pytest.raises(InputError, match=f"{EXCHANGE}: begun in another folder"):
            use()
    assert content(folder) == before
    shutil.rmtree(folder / EXCHANGE)
    renewed(folder)
    assert files.read_bytes(folder / "a") == files.read_bytes(folder / "b") == b"new"


PLANTED: list[Callable[[Path], object]] = [
    lambda note: None,
    lambda note: note.write_text('[[1, 2], ["a"], ["mine"]]'),
    lambda note: note.write_text("[" * 100_000),
    lambda note: note.write_text("3"),
    os.mkfifo,
    lambda note: note.symlink_to("/dev/zero"),
]


def test_exchange_with_a_forged_note_is_refused(tmp_path: Path) -> None:
    for number, plant in enumerate(PLANTED):
        folder = made(tmp_path / str(number))
        (folder / EXCHANGE).mkdir()
        (folder / EXCHANGE / "a").write_bytes(b"planted")
        plant(folder / EXCHANGE / ".unfinished-note")
        before = content(folder)
        for use in (lambda: files.read_bytes(folder / "a"), lambda: renewed(folder)):  # noqa: B023
            with pytest.raises(InputError, match="begun in another folder"):
                use()
        assert content(folder) == before


@pytest.mark.skipif(getattr(os, "geteuid", int)() == 0, reason="root may write everywhere")
def test_exchange_in_a_read_only_folder_is_read_but_not_completed(broken_off: Path) -> None:
    broken_off.chmod(0o555)
    assert {name: files.read_bytes(broken_off / name) for name in ("a", "b")} == NEW
    with pytest.raises(InputError, match="cannot be written"):
        files.recover(broken_off)
    broken_off.chmod(0o755)
    files.recover(broken_off)
    assert (broken_off / "b").read_bytes() == b"new"


@pytest.mark.skipif(getattr(os, "geteuid", int)() != 0, reason="root alone may give files away")
@pytest.mark.parametrize("given", ["", ".unfinished-note"])
def test_exchange_of_another_user_is_read_but_not_completed(broken_off: Path, given: str) -> None:
    """Whoever shares a folder reads them; as in /tmp, where anybody may put files, not even that."""
    os.chown(broken_off / EXCHANGE / given, 12345, 12345)
    before = content(broken_off)
    assert {name: files.read_bytes(broken_off / name) for name in ("a", "b")} == NEW
    with pytest.raises(InputError, match="left by a run of another user"):
        renewed(broken_off)
    if not given:
        broken_off.chmod(0o1777)
        assert files.read_bytes(broken_off / "b") == b"old"
        with pytest.raises(InputError, match="cannot be written"):
            renewed(broken_off)
    assert content(broken_off) == before


NUMBER = "0123456789abcdef"
FILES = (f".unfinished-{NUMBER}", f".unfinished-{NUMBER}.json", f".unfinished-{NUMBER}.with space")
NEAR = (  # names like those of litter that are none
    *(".unfinished-notes.txt", f"x.unfinished-{NUMBER}", f"unfinished-{NUMBER}", f".unfinished-{NUMBER.upper()}.json"),
    *(
        f".unfinished-{NUMBER[:-1]}.json",
        f".unfinished-{NUMBER}0.json",
        f".unfinished-{NUMBER}.tar.gz",
        f".rec-{NUMBER}",
    ),
)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def write_one(folder: Path) -> None:
    files.write_json(folder / "new.json", {})


def write_some(folder: Path) -> None:
    with files.atomic_files(folder) as stage:
        (stage / "new.json").touch()


def claim(folder: Path) -> None:
    with files.locked_folder(folder):
        (folder / "new.json").touch()


@pytest.mark.parametrize("work", [write_one, write_some, claim])
def test_leftovers_are_removed_and_similar_names_stay(tmp_path: Path, work: Callable) -> None:
    for name in FILES:
        (tmp_path / name).write_text("half")
    folder = tmp_path / f".unfinished-{NUMBER[::-1]}"
    (folder / "deeper").mkdir(parents=True)
    (folder / "deeper" / "half").touch()
    for name in NEAR:
        (tmp_path / name).touch()
        (tmp_path / f"{name} ").mkdir()
    near = names(tmp_path) - {*FILES, folder.name}
    work(tmp_path)
    assert names(tmp_path) == near | {"new.json"}


def test_leftovers_that_are_links_or_pipes_stay_and_links_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work").touch()
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / f".unfinished-{NUMBER[::-1]}").symlink_to(tmp_path / "mine" / "work")
    (folder / f".unfinished-{NUMBER}").symlink_to(tmp_path / "mine")
    os.mkfifo(folder / f".unfinished-{NUMBER[::-1]}.pipe")
    before = names(folder)
    (folder / f".unfinished-{NUMBER[1:]}0").mkdir()
    (folder / f".unfinished-{NUMBER[1:]}0" / "link").symlink_to(tmp_path / "mine")
    files.remove_leftovers(folder)
    assert names(folder) == before
    assert names(tmp_path / "mine") == {"work"}


def test_leftovers_of_running_processes_stay(tmp_path: Path) -> None:
    with (
        files.temporary_folder(tmp_path),
        files.temporary_file(tmp_path, ".json"),
        files.atomic_file(tmp_path / "a.txt"),
    ):
        at_work = names(tmp_path)
        assert len(at_work) == 3
        files.remove_leftovers(tmp_path)
        another = "import sys, pathlib as p, padforge.design.common.files as f; f.remove_leftovers(p.Path(sys.argv[1]))"
        subprocess.run([sys.executable, "-c", another, tmp_path], check=True)
        assert names(tmp_path) == at_work
    assert names(tmp_path) == {"a.txt"}


def test_leftovers_of_other_users_and_without_locks_stay(tmp_path: Path, monkeypatch) -> None:
    def none_here(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    (tmp_path / FILES[0]).touch()
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: os.getuid() + 1)
        files.remove_leftovers(tmp_path)
    assert names(tmp_path) == {FILES[0]}
    monkeypatch.setattr("fcntl.flock", none_here)
    claim(tmp_path)
    assert names(tmp_path) == {FILES[0], "new.json"}
