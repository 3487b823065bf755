"""Atomic writing and self-describing JSON."""

import os

import pytest

from design.common.errors import InputError
from design.common.files import atomic, read_bytes, read_json, sha256, write_json


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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as POSIX has them")
def test_a_pipe_is_neither_waited_for_nor_put_aside(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match=r"pipe\.json: cannot be read \(a pipe or device"):
        read_json(pipe, "x/1")
    with pytest.raises(InputError, match=r"pipe\.json: cannot be written"):
        write_json(pipe, {})
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
