"""Ports that are refused."""

import pytest

from sense.rig.devices.protocols import RigFault
from sense.rig.devices.serial_port import refusal

serial = pytest.importorskip("serial")


@pytest.mark.parametrize(
    ("error", "match"),
    [
        (serial.SerialException(13, "Permission denied"), "no permission.*dialout"),
        (serial.SerialException("could not open port 'COM7': PermissionError(13, 'Access is denied.')"), "another"),
        (serial.SerialException("could not open port 'COM7': FileNotFoundError(2, '...')"), "no such port"),
        (serial.SerialException("a device attached to the system is not functioning"), "not functioning.*right port"),
    ],
)
def test_every_way_to_be_refused_comes_with_advice(error: Exception, match: str) -> None:
    with pytest.raises(RigFault, match=match):
        raise refusal("COM7", error)
