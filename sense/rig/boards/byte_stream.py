"""A board's serial port as bytes, both ways, with the time at which they came."""

import time
from contextlib import suppress

from padforge.sense.rig.devices.protocols import RigFault
from padforge.sense.rig.devices.serial_port import open_port

POLL_S = 0.1
"""The longest time `ByteStream.receive` waits."""


class ByteStream:
    """An open port. Any method but `close` raises RigFault("lost") once the board is gone."""

    def __init__(self, port: str, baud: int) -> None:
        """Open `port` for this process alone; raises RigFault("refused") where that cannot be."""
        self.port = port
        self._serial = open_port(port, baud, POLL_S)

    def receive(self) -> tuple[float, bytes]:
        """When bytes have come, after waiting for at most `POLL_S`, and all of them; none where nothing has."""
        try:
            data = self._serial.read(1)
            if data:
                data += self._serial.read(self._serial.in_waiting)
        except OSError as error:
            raise self._lost(error) from error
        return time.monotonic(), data

    def send(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self._serial.write(data)
        except OSError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Close the port; never raises."""
        with suppress(OSError):
            self._serial.close()

    def _lost(self, error: OSError) -> RigFault:
        return RigFault("lost", f"{self.port}: the board is gone ({error})", "check its cable and connect again")
