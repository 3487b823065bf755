"""A serial port that speaks frames, with pyserial's ways to fail told apart for a person."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from sense.rig.devices.protocols import RigFault
from sense.rig.devices.serial_port import host_ports, open_port
from sense.settings import RigSettings

from .framing import BoardSettings, Decoder, Frame, Request, encode

BAUD = 115_200
"""Without meaning on a USB port, but never 1200: on a Due that erases the firmware."""
POLL_S = 0.1
"""The longest time `Link.receive` waits."""

F = TypeVar("F", bound=Frame)

_RESEND_S = 0.25
_DUE_PORTS = {0x003E: "native", 0x003D: "programming"}
_VENDORS = (0x2341, 0x2A03)


@dataclass(frozen=True)
class BoardPort:
    """A port at which an Arduino Due seems to be: "native" is the one to use, "programming" cannot carry the data."""

    device: str
    kind: str
    serial_number: str


def find_ports() -> list[BoardPort]:
    """The ports of this host that look like a Due, native ones first. Raises RigFault("refused") without pyserial."""
    found = [
        BoardPort(port.device, _DUE_PORTS[port.pid], port.serial_number or "")
        for port in host_ports()
        if port.vid in _VENDORS and port.pid in _DUE_PORTS
    ]
    return sorted(found, key=lambda port: (port.kind, port.device))


def port_of(rig: RigSettings) -> str:
    """The board's port, looked for where `[rig]` does not set it; raises RigFault("refused") where none is found."""
    if rig.port != "auto":
        return rig.port
    if not (ports := find_ports()):
        raise RigFault("refused", '[rig] port is "auto" and no board is found', "plug it in, or name its port")
    return ports[0].device


class SerialLink:
    """An open port. Any method but `close` raises RigFault("lost") once the board is gone."""

    def __init__(self, port: str) -> None:
        """Open `port` for this process alone; raises RigFault("refused") where that cannot be."""
        self.port = port
        self.decoder = Decoder()
        self._serial = open_port(port, BAUD, POLL_S)

    def receive(self) -> tuple[float, list[Frame]]:
        """The frames that have come, after waiting for at most `POLL_S`, and when they came."""
        try:
            data = self._serial.read(1)
            if data:
                data += self._serial.read(self._serial.in_waiting)
        except OSError as error:
            raise self._lost(error) from error
        return time.monotonic(), self.decoder.feed(data)

    def send(self, command: Request | BoardSettings) -> None:
        """Send one command."""
        try:
            self._serial.write(encode(command))
        except OSError as error:
            raise self._lost(error) from error

    def ask(self, command: Request | BoardSettings, kind: type[F], fits: Callable[[F], bool], wait_s: float) -> F:
        """Send `command` until a frame of `kind` that `fits` comes; all other frames are thrown away.

        Raises:
            RigFault: "stale" where none has come after `wait_s`.
        """
        deadline = time.monotonic() + wait_s
        resend = 0.0
        while (now := time.monotonic()) < deadline:
            if now >= resend:
                self.send(command)
                resend = now + _RESEND_S
            for frame in self.receive()[1]:
                if isinstance(frame, kind) and fits(frame):
                    return frame
        raise RigFault("stale", f"{self.port}: no answer within {wait_s:g} s")

    def close(self) -> None:
        """Close the port; never raises."""
        with suppress(OSError):
            self._serial.close()

    def _lost(self, error: OSError) -> RigFault:
        return RigFault("lost", f"{self.port}: the board is gone ({error})", "check its cable and connect again")
