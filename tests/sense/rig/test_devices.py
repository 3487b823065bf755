"""Devices by their names, their ports, and processes that run padforge's own code."""

import errno
import os
import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import pytest

from padforge.common.validation import InputError
from padforge.sense.rig import devices
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.boards import due, line_board
from padforge.sense.rig.boards.due import DueBoard
from padforge.sense.rig.devices import RigFault, load_device, start
from padforge.sense.settings import RigSettings

serial = pytest.importorskip("serial")


def test_load_device_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(load_device("padforge.arms", "ur5")(RigSettings()), UR5)
    with pytest.raises(InputError, match=r"^arms: got 'crane', allowed are .*printer.*ur5"):
        load_device("padforge.arms", "crane")
    broken = EntryPoints([EntryPoint("crane", "no.such.module:Crane", "padforge.arms")])
    monkeypatch.setattr(devices, "entry_points", lambda group: broken)
    with pytest.raises(InputError, match=r"^crane: no.such.module:Crane cannot be loaded"):
        load_device("padforge.arms", "crane")


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


@pytest.mark.parametrize(
    ("error", "match"),
    [
        (serial.SerialException(13, "Permission denied"), "no permission.*dialout"),
        (serial.SerialException(errno.EAGAIN, "Resource temporarily unavailable"), "another program uses it"),
        (serial.SerialException(errno.ENOENT, "No such file or directory"), "no such port"),
        (serial.SerialException("a device attached to the system is not functioning"), "not functioning.*right port"),
    ],
)
def test_port_fault_gives_advice(error: Exception, match: str) -> None:
    with pytest.raises(RigFault, match=match):
        raise devices.port_fault("/dev/ttyACM0", error)


BUILT_IN = SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None)
UNO = SimpleNamespace(device="/dev/ttyACM2", vid=0x2341, pid=0x0043, serial_number="uno")
PROGRAMMING = SimpleNamespace(device="/dev/ttyACM1", vid=0x2341, pid=0x003D, serial_number="7")
NATIVE = SimpleNamespace(device="/dev/ttyACM3", vid=0x2341, pid=0x003E, serial_number=None)


def test_ports_of_boards_are_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def connect(*ports: SimpleNamespace) -> None:
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [BUILT_IN, *ports])

    connect(PROGRAMMING, NATIVE, UNO)
    assert due.list_due_ports() == ["/dev/ttyACM3", "/dev/ttyACM1"]
    assert due.find_due_port(RigSettings()) == "/dev/ttyACM3"
    with pytest.raises(RigFault, match="3 serial ports on USB; name one of /dev/ttyACM1, /dev/ttyACM2, /dev/ttyACM3"):
        line_board.find_line_port(RigSettings())
    connect(UNO)
    assert line_board.find_line_port(RigSettings()) == "/dev/ttyACM2"
    with pytest.raises(RigFault, match="no board is found; plug it in"):
        due.find_due_port(RigSettings())
    connect()
    with pytest.raises(RigFault, match="0 serial ports on USB; plug the board in"):
        line_board.find_line_port(RigSettings())
    for find_port in (due.find_due_port, line_board.find_line_port):
        assert find_port(RigSettings(port="COM3")) == "COM3"
    monkeypatch.setitem(sys.modules, "serial", None)
    for action in (DueBoard("/dev/ttyACM0", 921_600, 1000).connect, due.list_due_ports):
        with pytest.raises(RigFault, match=r"pip install 'padforge\[rig\]'") as caught:
            action()
        assert caught.value.cause == "refused"
