"""An emulated UR controller on 127.0.0.1, in a process of its own, with faults to be switched on at any moment."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any, Literal, Self

from numpy.typing import ArrayLike

from sense.rig.devices import Array, Pose, RigFault
from sense.rig.ur5.processes import start

from .ur_controller import Series
from .ur_truth import Truth, create

HOME: Pose = (-120.0, -430.0, 200.0, 0.0, 3.141592653589793, 0.0)
"""Where the emulated arm stands at first: 200 mm up, the tool pointing down."""


class UrEmulator:
    """A context: the controller runs from entry to exit.

    Clients reach it as 127.0.0.1, or as 127.1, for which ur-rtde asks whether the arm is in remote control.

    Attributes:
        truth: where the tip really was; other processes can open `Truth(emulator.truth.path)`.
    """

    truth: Truth

    def __init__(
        self, series: Series = "cb3", pose: Pose = HOME, surface_mm: float | None = None, stiffness_n_mm: float = 2.0
    ) -> None:
        """Describe the controller.

        Args:
            series: "cb3" (PolyScope 3, 125 Hz) or "e" (PolyScope 5, 500 Hz). pose: where the arm stands.
            surface_mm: height of a springy plane the tool can press on; None for none. stiffness_n_mm: of it.
        """
        self._settings = {"series": series, "pose_mm": pose, "surface_mm": surface_mm, "stiffness_n_mm": stiffness_n_mm}

    def __enter__(self) -> Self:
        handle, name = tempfile.mkstemp(prefix="padforge-ur-")
        os.close(handle)
        create(Path(name))
        self._process = start("sense.rig.emulators.ur_server", json.dumps(self._settings | {"truth": name}))
        self.truth = Truth(Path(name))
        if problem := self._hear():
            self.__exit__()
            raise RigFault("refused", f"no emulated arm at {problem}", "is there another one?")
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self.truth.path.unlink(missing_ok=True)

    def pose_at(self, times_s: ArrayLike) -> Array:
        """(n, 6) true poses in mm and rad at monotonic times; see `Truth.pose_at`."""
        return self.truth.pose_at(times_s)

    def protective_stop(self) -> None:
        """Stop the arm as after a collision: the program is paused."""
        self._order("protective_stop")

    def emergency_stop(self) -> None:
        """Press the red button."""
        self._order("emergency_stop")

    def clear(self) -> None:
        """What a person does after a stop: unlock the arm, power on, release the brakes."""
        self._order("clear")

    def play(self) -> None:
        """Press play at the pendant: a paused program goes on."""
        self._order("play")

    def halt(self) -> None:
        """Press stop at the pendant: the program ends."""
        self._order("stop_program")

    def refuse(self, on: bool) -> None:
        """Refuse new links, or take them again; links that are open stay."""
        self._order("refuse" if on else "listen")

    def drop(self, port: Literal["rtde", "script", "dashboard"]) -> None:
        """Close the links to a port; new ones are taken."""
        self._order("drop", port)

    def freeze(self, on: bool) -> None:
        """Send no more states; all else goes on."""
        self._order("set", "frozen", on)

    def unplug(self, on: bool) -> None:
        """Nothing comes in and nothing goes out, and no link is closed: the cable is out."""
        self._order("set", "unplugged", on)

    def slow(self, seconds: float) -> None:
        """Let every answer and every order take this much longer."""
        self._order("slow", seconds)

    def remote_control(self, on: bool) -> None:
        """Switch between local and remote control."""
        self._order("set", "remote", on)

    def restart(self, seconds: float) -> None:
        """Restart the controller: all links die, and it is back after some seconds."""
        self._order("restart", seconds)

    def asked(self) -> list[str]:
        """Every line that was sent to the dashboard."""
        return self._order("asked")

    def _order(self, *order: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order).encode() + b"\n")
        self._process.stdin.flush()
        return self._hear()

    def _hear(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline() or b'"the emulator has ended"')
