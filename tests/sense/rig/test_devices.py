"""Devices by their names, their ports, and processes that run padforge's own code."""

import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from padforge.sense.rig.boards import due, line_board
from padforge.sense.rig.devices import start
from padforge.sense.settings import RigSettings

serial = pytest.importorskip("serial")


def test_start_imports_nothing_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hostile = "open('pwned', 'w').close()\n"
    (tmp_path / "sense").mkdir()
    for name in ("queue.py", "sense/__init__.py", "selectors.py"):
        (tmp_path / name).write_text(hostile, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "/nowhere::")
    process = start("padforge.sense.rig.arms.rtde_worker", "127.0.0.1", stderr=subprocess.PIPE)
    assert os.getsid(process.pid) == process.pid, "an interrupt from the keyboard would reach it"
    _, stderr = process.communicate(timeout=20)  # the end of its stdin ends it
    assert not (tmp_path / "pwned").exists(), stderr
    assert process.returncode == 0, stderr


BUILT_IN = SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None)
UNO = SimpleNamespace(device="/dev/ttyACM2", vid=0x2341, pid=0x0043, serial_number="uno")
PROGRAMMING = SimpleNamespace(device="/dev/ttyACM1", vid=0x2341, pid=0x003D, serial_number="7")
NATIVE = SimpleNamespace(device="/dev/ttyACM3", vid=0x2341, pid=0x003E, serial_number=None)


def test_ports_of_boards_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Due by its native port before that for programming, any other board where it is the only one on USB."""

    def connect(*ports: SimpleNamespace) -> None:
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [BUILT_IN, *ports])

    connect(PROGRAMMING, NATIVE, UNO)
    assert due.list_due_ports() == ["/dev/ttyACM3", "/dev/ttyACM1"]
    assert due.find_due_port(RigSettings()) == "/dev/ttyACM3"
    connect(UNO)
    assert line_board.find_line_port(RigSettings()) == "/dev/ttyACM2"
    for find_port in (due.find_due_port, line_board.find_line_port):
        assert find_port(RigSettings(port="COM3")) == "COM3"
