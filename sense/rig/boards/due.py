"""An Arduino Due with padforge's firmware: a line board whose port is recognised by its USB identity."""

from collections.abc import Sequence

from padforge.sense.rig.boards.line_board import LineBoard
from padforge.sense.rig.devices import RigFault, host_ports
from padforge.sense.settings import RigSettings

_PRODUCTS = (0x003E, 0x003D)  # native port; programming port, which cannot carry the data


class DueBoard(LineBoard):
    """A Due at its native USB port."""

    @classmethod
    def from_settings(cls, rig: RigSettings, inputs: Sequence[int]) -> "DueBoard":
        """Return the Due that `[rig]` names; see `find_due_port`."""
        return cls(find_due_port(rig), rig.baud, rig.board_rate_hz, inputs)


def find_due_port(rig: RigSettings) -> str:
    """Return the port of `[rig]`, or that of the first Due if it is "auto"; RigFault("refused") if there is none."""
    if rig.port != "auto":
        return rig.port
    if not (ports := list_due_ports()):
        raise RigFault("refused", '[rig] port is "auto" and no board is found', "plug it in, or name its port")
    return ports[0]


def list_due_ports() -> list[str]:
    """Return the ports that look like a Due by their USB identity, native ones first; RigFault without pyserial."""
    ports = [port for port in host_ports() if port.vid in (0x2341, 0x2A03) and port.pid in _PRODUCTS]
    return [port.device for port in sorted(ports, key=lambda port: (_PRODUCTS.index(port.pid), port.device))]
