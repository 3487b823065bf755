"""Motion of a UR arm by ur-rtde."""

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

WATCHDOG_HZ = 4.0
STOP_M_S2 = 5.0
OPERATION, UNDER_WAY = 0x7F << 24, 1 << 15  # of ur-rtde's register of moves


class UrRtdeControl:
    """ur-rtde's program at work; its methods raise an error if the arm is lost. Lengths are m.

    `moving` tells whether the last move is under way, `identity` the version of the driver.
    """

    def __init__(self, host: str) -> None:
        """Send ur-rtde's program and set its watchdog; RuntimeError if there is no arm."""
        import rtde_control

        self.moving = False
        self._progress = self._previous_operation = 0  # number of the operation before the move under way
        self._control: Any = rtde_control.RTDEControlInterface(host)
        if not self._control.setWatchdog(WATCHDOG_HZ):
            raise RuntimeError("it does not take a watchdog")
        self.identity: dict[str, Any] = {"driver": f"ur-rtde {version('ur-rtde')}"}

    def tcp_offset(self) -> Sequence[float]:
        """Return the tool centre point from the flange, m and rad."""
        return self._control.getTCPOffset()

    def update(self, progress: int, is_stopped: bool) -> None:
        """Note the newest register of progress, and whether a protective or emergency stop holds the arm."""
        self._progress = progress
        has_arrived = progress & OPERATION != self._previous_operation and not progress & UNDER_WAY
        if has_arrived or is_stopped:
            self.moving = False

    def kick(self) -> None:
        """Kick the watchdog, which stops the arm after 0.25 s without."""
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
