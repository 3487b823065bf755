"""Atomic writing and self-describing JSON."""

import os

import pytest

from design.files import atomic, read_json, sha256, write_json


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
