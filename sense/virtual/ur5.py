"""An emulated UR controller on this machine, in a process of its own, with faults to be switched on at any moment."""

import json
import tempfile
from contextlib import ExitStack
from functools import partialmethod
from pathlib import Path
from typing import Any, Self

from numpy.typing import ArrayLike

from padforge.design.common.files import temporary_file
from padforge.sense.rig.devices import Array, Pose, RigFault, start
from padforge.sense.virtual.ur5_controller import Series, Truth, create

HOST = "127.0.0.1"
HOME: Pose = (-120.0, -430.0, 200.0, 0.0, 3.141592653589793, 0.0)
"""Where the emulated arm stands at first: 200 mm up, the tool pointing down."""

_TRUTH = "padforge-ur-"
"""What the names of its temporary files begin with."""


class UrEmulator:
    """A context: the controller runs from entry to exit.

    Of 127.0.0.1 ur-rtde never asks whether the arm is in remote control, of other names (127.1, say) it does.

    Attributes:
        truth: where the tip really was; other processes can open `Truth(emulator.truth.path)`.
    """

    truth: Truth

    def __init__(
        self,
        series: Series = "cb3",
        pose: Pose = HOME,
        surface_mm: float | None = None,
        stiffness_n_mm: float = 2.0,
        host: str = HOST,
        tcp_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Describe the controller.

        Args:
            series: "cb3" (PolyScope 3, 125 Hz) or "e" (PolyScope 5, 500 Hz). pose: where the arm stands.
            surface_mm: height of a springy plane the tool can press on; None for none. stiffness_n_mm: of it.
            host: address of this machine at which it listens. tcp_mm: the tip from the flange, as installed.
        """
        self._settings = {"series": series, "pose_mm": pose, "surface_mm": surface_mm}
        self._settings |= {"stiffness_n_mm": stiffness_n_mm, "host": host, "tcp_mm": tcp_mm}

    def __enter__(self) -> Self:
        self._end = ExitStack()
        with ExitStack() as down_command:
            path = down_command.enter_context(temporary_file(Path(tempfile.gettempdir()), prefix=_TRUTH))
            create(path)
            self._process = start(
                "padforge.sense.virtual.ur5_server", json.dumps(self._settings | {"truth": str(path)})
            )
            self.truth = Truth(path)
            self._end = down_command.pop_all()
        if problem := self._hear():
            self.__exit__()
            raise RigFault("refused", f"no emulated arm at {problem}", "is there another one?")
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._end.close()

    def pose_at(self, times_s: ArrayLike) -> Array:
        """(n, 6) true poses in mm and rad at monotonic times; see `Truth.pose_at`."""
        return self.truth.pose_at(times_s)

    def _order(self, *order: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order).encode() + b"\n")
        self._process.stdin.flush()
        return self._hear()

    protective_stop = partialmethod(_order, "protective_stop")
    """Stop the arm as after a collision: the program is paused."""
    emergency_stop = partialmethod(_order, "emergency_stop")
    """Press the red button."""
    clear = partialmethod(_order, "clear")
    """What a person does after a stop: unlock the arm, power on, release the brakes."""
    play = partialmethod(_order, "play")
    """Press play at the pendant: a paused program goes on."""
    halt = partialmethod(_order, "stop_program")
    """Press stop at the pendant: the program ends."""

    def refuse(self, on: bool) -> None:
        """Refuse new links, or take them again; links that are open stay."""
        self._order("refuse" if on else "listen")

    drop = partialmethod(_order, "drop")
    """Close the links to a port; new ones are taken."""
    freeze = partialmethod(_order, "set", "frozen")
    """Send no more states; all else goes on."""
    unplug = partialmethod(_order, "set", "unplugged")
    """Nothing comes in and nothing goes out, and no link is closed: the cable is out."""
    slow = partialmethod(_order, "slow")
    """Let every answer and every order take this much longer."""
    push = partialmethod(_order, "set", "sideways_n")
    """Push the tool sideways with so many N."""
    remote_control = partialmethod(_order, "set", "remote")
    """Switch between local and remote control."""
    restart = partialmethod(_order, "restart")
    """Restart the controller: all links die, and it is back after some seconds."""
    asked = partialmethod(_order, "asked")
    """Every line that was sent to the dashboard."""

    def _hear(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline() or b'"the emulator has ended"')
