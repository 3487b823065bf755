"""The port of an Arduino Due: where it is found, and frames to and from it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from padforge.sense.rig.boards.byte_stream import ByteStream
from padforge.sense.rig.devices.protocols import RigFault
from padforge.sense.rig.devices.serial_port import host_ports
from padforge.sense.settings import RigSettings

from padforge.sense.rig.boards.due.framing import BoardSettings, DueDecoder, Frame, Request, encode

BAUD = 115_200
"""Without meaning on a USB port, but never 1200: on a Due that erases the firmware."""

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
    """An open port that speaks frames. Any method but `close` raises RigFault("lost") once the board is gone."""

    def __init__(self, port: str) -> None:
        """Open `port` for this process alone; raises RigFault("refused") where that cannot be."""
        self.port = port
        self.decoder = DueDecoder()
        self._stream = ByteStream(port, BAUD)

    def receive(self) -> tuple[float, list[Frame]]:
        """When bytes have come, after a short wait, and the frames they completed."""
        now_s, data = self._stream.receive()
        return now_s, self.decoder.feed(data)

    def send(self, command: Request | BoardSettings) -> None:
        """Send one command."""
        self._stream.send(encode(command))

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
        self._stream.close()
