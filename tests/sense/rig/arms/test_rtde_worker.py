"""One program at a time moves an arm, whichever user started it and whatever others put into the folder of locks."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

fcntl = pytest.importorskip("fcntl", reason="arms need POSIX")
from padforge.sense.rig.arms import rtde_worker  # noqa: E402
from padforge.sense.rig.arms.rtde_worker import CommandRejected, lock_arm  # noqa: E402

HOST = "127.0.0.1"


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The lock of the arm at HOST, in a folder of its own."""
    monkeypatch.setattr(rtde_worker, "LOCK_FOLDER", tmp_path)
    monkeypatch.setattr(rtde_worker, "SESSION_END_S", 0.05)
    before = os.umask(0o077)
    yield tmp_path / f"padforge-arm-{HOST}.lock"
    os.umask(before)


def test_lock_is_shared_by_users_whatever_their_umask_and_temporary_folder(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = lock_arm(HOST)
    assert path.stat().st_mode & 0o777 == 0o644
    monkeypatch.setenv("TMPDIR", str(tmp_path / "another"))
    with pytest.raises(CommandRejected) as refused:
        lock_arm(HOST)
    cause, message, _ = refused.value.args
    assert cause == "refused"
    assert message == f"another program on this computer uses the arm {HOST}: it has locked {path}"
    os.close(lock)
    os.close(lock_arm(HOST))


def test_link_in_place_of_a_lock_is_refused_by_name_and_not_followed(path: Path) -> None:
    path.symlink_to(path.with_name("target"))
    with pytest.raises(CommandRejected, match="cannot be locked") as refused:
        lock_arm(HOST)
    _, message, advice = refused.value.args
    assert message.startswith(f"{path}: cannot be locked (")
    assert advice.startswith("remove it")
    assert list(path.parent.iterdir()) == [path]


def test_lock_on_a_file_that_was_removed_meanwhile_does_not_count(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flock = fcntl.flock

    def remove_and_lock(handle: int, operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", flock)
        path.unlink()
        flock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", remove_and_lock)
    lock = lock_arm(HOST)
    assert os.path.samestat(os.fstat(lock), path.stat())
    os.close(lock)
