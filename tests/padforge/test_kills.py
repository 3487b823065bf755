"""A command that is killed, at a random moment and between file operations, and what it leaves; see `kill_rounds`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.effort import few

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")
def test_whatever_a_killed_command_leaves_is_whole_and_the_next_one_goes_on_from_it(tmp_path: Path) -> None:
    """A search a few times a day; every command, and more often, under stress."""
    stress = few(1).max_examples > 1
    more = ("10", "0") if stress else ("2", "0", "design")
    command = [sys.executable, "-m", "tools.kill_rounds", str(tmp_path / "rounds"), *more]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "FAILED" not in ended.stdout
    assert ended.stdout.startswith("design: 2 kills at random") or stress
