"""Child processes run padforge's code, and none that lies about in the current folder."""

import subprocess
from pathlib import Path

import pytest

from sense.rig.devices.processes import start


@pytest.mark.parametrize("python_path", [None, "", ":", "/nowhere::"])
def test_code_in_the_current_folder_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, python_path: str | None
) -> None:
    spoil = "open('pwned', 'w').close()\n"
    (tmp_path / "sense").mkdir()
    for name in ("queue.py", "sense/__init__.py", "selectors.py"):
        (tmp_path / name).write_text(spoil, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    if python_path is None:
        monkeypatch.delenv("PYTHONPATH", raising=False)
    else:
        monkeypatch.setenv("PYTHONPATH", python_path)
    process = start("sense.rig.arms.ur5.child_process", "127.0.0.1", stderr=subprocess.PIPE)
    _, said = process.communicate(timeout=20)  # the end of its stdin ends it
    assert not (tmp_path / "pwned").exists(), said
    assert process.returncode == 0, said
