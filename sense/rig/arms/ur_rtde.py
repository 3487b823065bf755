"""Motion of a UR arm by ur-rtde."""

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

STOP_M_S2 = 5.0  # deceleration
OPERATION = 0x7F << 24  # bits of ur-rtde's progress register: number of the operation
UNDER_WAY = 1 << 15  # bit of the same register: the operation is in progress


class UrRtdeControl:
    """A connection to ur-rtde's program on the arm. Methods raise an error if the link is lost; lengths are m."""

    def __init__(self, host: str) -> None:
        """Send ur-rtde's program and set its watchdog; RuntimeError if there is no arm."""
        import rtde_control

        self.moving = False  # whether the last move is in progress
        self._progress = 0  # latest value of the register
        self._previous_operation = 0  # number of the operation before the current move
        self._control: Any = rtde_control.RTDEControlInterface(host)
        if not self._control.setWatchdog(4.0):  # Hz, minimum rate of kicks
            raise RuntimeError("it does not take a watchdog")
        self.identity: dict[str, Any] = {"driver": f"ur-rtde {version('ur-rtde')}"}

    def tcp_offset(self) -> Sequence[float]:
        """Return the tool centre point from the flange, m and rad."""
        return self._control.getTCPOffset()

    def update(self, progress: int, is_stopped: bool) -> None:
        """Update `moving` from the progress register; a protective or emergency stop (`is_stopped`) ends the move."""
        self._progress = progress
        has_arrived = progress & OPERATION != self._previous_operation and not progress & UNDER_WAY
        if has_arrived or is_stopped:
            self.moving = False

    def kick(self) -> None:
        """Kick the watchdog, which stops the arm 0.25 s after the last kick."""
        self._control.kickWatchdog()

    def move(self, pose: Sequence[float], speed: float, acceleration: float) -> bool:
        """Start a straight move (m, rad, m/s, m/s²); return whether the arm accepts it."""
        self._previous_operation = self._progress & OPERATION
        self.moving = True
        if not (accepted := self._control.moveL(list(pose), speed, acceleration, True)):
            self.moving = False
        return accepted

    def stop(self) -> None:
        """Stop the arm, and return once it is at rest."""
        self._control.stopL(STOP_M_S2)
        self.moving = False

    def end(self) -> None:
        """Stop the arm and end the program."""
        self._control.stopL(STOP_M_S2)
        self._control.stopScript()
