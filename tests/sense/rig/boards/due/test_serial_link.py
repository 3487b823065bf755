"""Ports, found and refused."""

import sys
from types import SimpleNamespace

import pytest

from sense.rig.boards.due.driver import Arduino
from sense.rig.boards.due.serial_link import BoardPort, find_ports
from sense.rig.devices.protocols import RigFault

pytest.importorskip("serial")


def test_without_pyserial_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    for action in (Arduino("/dev/ttyACM0", 1000).connect, find_ports):
        with pytest.raises(RigFault, match=r"pip install 'padforge\[rig\]'") as caught:
            action()
        assert caught.value.cause == "refused"


def test_ports_of_a_due_are_found_native_first(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [
        SimpleNamespace(device="/dev/ttyACM1", vid=0x2341, pid=0x003D, serial_number="7"),
        SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None),
        SimpleNamespace(device="/dev/ttyACM0", vid=0x2341, pid=0x003E, serial_number=None),
        SimpleNamespace(device="/dev/ttyACM2", vid=0x2341, pid=0x0043, serial_number="uno"),
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    assert find_ports() == [
        BoardPort("/dev/ttyACM0", "native", ""),
        BoardPort("/dev/ttyACM1", "programming", "7"),
    ]
