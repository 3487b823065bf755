"""A 3D printer with Marlin as an arm: a probe clamped beside its nozzle presses, G-code over a serial port moves it.

Poses are of the probe's tip, in the printer's own frame: the nozzle's place and `[rig] tcp_mm`. The tip cannot turn.
A printer feels no force.
"""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from padforge.sense.recordings.recorder import STATE_COLUMNS
from padforge.sense.rig.devices.protocols import ArmState, Array, Pose, RigFault
from padforge.sense.rig.safety import require_numbers
from padforge.sense.settings import RigSettings

from padforge.sense.rig.arms.printer import marlin
from padforge.sense.rig.arms.printer.link import HOME, MarlinLink
from padforge.sense.rig.arms.printer.motion import Place, StraightMove
from padforge.sense.rig.arms.printer.mover import Mover

CONNECT_S = 3.0
"""Longest wait for a printer that restarts as its port is opened."""
STALE_S = 0.5
SETTINGS = ("G21", "G90", "M220 S100", "M211 S1", "M84 S0")
"""Millimetres, places from the origin, speeds as said, ends of the axes heeded, and motors that never let go."""


class Printer:
    """The printer at `[rig] printer_port`.

    It is never homed from here, for the probe would meet the bed: a person does that. If this process ends, the printer
    ends the one move that is under way and stands.
    """

    def __init__(self, rig: RigSettings) -> None:
        self._rig = rig
        self._link: MarlinLink | None = None
        self._mover: Mover | None = None
        self._tcp: Place = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, rig: RigSettings) -> "Printer":
        """The printer that `[rig]` names."""
        return cls(rig)

    def connect(self) -> Mapping[str, Any]:
        """Open the port and set the printer up; nothing moves.

        Returns:
            port, baud, firmware and machine by name, the greatest speeds (mm/s) and accelerations (mm/s²) of its axes,
            and whether it can halt at once.

        Raises:
            RigFault: "refused" where there is no printer with Marlin, it has not been homed, it restarts as its port is
                opened, its axes are too slow for the presses wanted, or a setting is missing; "lost", "stale".
        """
        self.close()
        rig = self._rig
        if rig.printer_port is None:
            raise RigFault("refused", "[rig] printer_port is unknown, allowed is a serial port such as /dev/ttyUSB0")
        if rig.tcp_mm is None:
            message = "[rig] tcp_mm is unknown, allowed are x, y and z of the probe's tip from the nozzle"
            raise RigFault("refused", message, "measure them with the probe in place")
        self._tcp = rig.tcp_mm
        self._link = link = MarlinLink(rig.printer_port, rig.printer_baud)
        try:
            link.begin(CONNECT_S)
            firmware = marlin.PrinterDialect.of(link.ask("M115"))
            if marlin.FIRMWARE not in firmware.name:
                raise RigFault("refused", f"the firmware is {firmware.name or 'of no name'!r}, allowed is Marlin")
            if marlin.waits_for_moves(firmware.name):
                message = f"the firmware is {firmware.name!r}, which says where it is only once it stands"
                raise RigFault("refused", message, "allowed is Marlin 2")
            speeds, accelerations = self._limits(link)
            self._require_quick(speeds, accelerations)
            for command in SETTINGS:
                link.ask(command)
            at = _standing(link)
        except BaseException:
            self.close()
            raise
        self._mover = Mover(link, at, speeds, accelerations)
        self._mover.start()
        return {
            "port": rig.printer_port,
            "baud": rig.printer_baud,
            "firmware": firmware.name,
            "machine": firmware.machine,
            "max_mm_s": list(speeds),
            "max_mm_s2": list(accelerations),
            "halts_at_once": "EMERGENCY_PARSER" in firmware.capabilities,
        }

    def state(self) -> ArmState:
        """The latest state; see `Arm.state`."""
        seen = self._running().latest
        if (age := time.monotonic() - seen.time_s) > STALE_S:
            message = f"the printer's last answer is {age:.2f} s old; allowed {STALE_S} s"
            raise RigFault("stale", message, "it may be busy: look at its display")
        return ArmState(seen.time_s, self._pose(seen.at), seen.speed_mm_s, None, False, False, seen.moving)

    def drain(self) -> Array:
        """(n, 10) states since the last call; those before a fault come before it."""
        mover = self._mover
        seen = mover.take() if mover else []
        if not seen:
            self._running()
            return np.empty((0, len(STATE_COLUMNS)))
        return np.array([[one.time_s, *self._pose(one.at), one.speed_mm_s, np.nan, 1.0] for one in seen])

    def move(self, pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Begin a straight move from rest, as fast as wanted or as the printer's axes can.

        Args:
            pose: x, y, z in mm of the tip, and `[rig] tool_rad`. speed_mm_s, acceleration_mm_s2: of the tip.

        Raises:
            RigFault: "refused" for what is no pose or speed, or another turn of the tool; "lost", "stale".
        """
        require_numbers(pose, speed_mm_s, acceleration_mm_s2)
        if not np.allclose(pose[3:], self._rig.tool_rad, atol=1e-6):
            raise RigFault("refused", f"a turn of the tool to {list(pose[3:])} rad; a printer cannot turn it")
        x, y, z = (float(value) - offset for value, offset in zip(pose, self._tcp, strict=False))
        self._running().move((x, y, z), speed_mm_s, acceleration_mm_s2)

    def stop(self) -> None:
        """Stop the printer, for good where it does not confirm it; see `Arm.stop`."""
        if self._mover is not None:
            self._mover.stop()

    def close(self) -> None:
        """Stop the printer and close the port; never raises."""
        if self._mover is not None:
            with suppress(RigFault):
                self._mover.stop()
            self._mover.end()
        if self._link is not None:
            self._link.close()
        self._mover = self._link = None

    def _running(self) -> Mover:
        if self._mover is None:
            raise RigFault("lost", "there is no link to the printer", "connect first")
        if fault := self._mover.fault:
            raise fault
        return self._mover

    def _pose(self, nozzle: Place) -> Pose:
        x, y, z = (a + b for a, b in zip(nozzle, self._tcp, strict=True))
        return (x, y, z, *self._rig.tool_rad)

    def _limits(self, link: MarlinLink) -> tuple[Place, Place]:
        lines = link.ask("M503", CONNECT_S)
        speeds, accelerations = marlin.limits(lines, "M203"), marlin.limits(lines, "M201")
        if speeds is None or accelerations is None:
            raise RigFault("refused", "the printer does not tell the limits of its axes (M503: M203 and M201)")
        return speeds, accelerations

    def _require_quick(self, speeds: Place, accelerations: Place) -> None:
        """Refuse presses that would be over before the tip is down."""
        rig = self._rig
        way = rig.clearance_mm + max(rig.depths_mm or (rig.depth_mm,))
        down = StraightMove((0, 0, way), (0, 0, 0), rig.press_mm_s, rig.acceleration_mm_s2)
        down_s = down.within(speeds, accelerations).duration_s
        if down_s >= (half_s := rig.readings_per_press / 2 / rig.rate_hz):
            raise RigFault(
                "refused",
                f"the printer's way down of {way:g} mm takes {down_s:.1f} s, allowed is less than {half_s:.2g} s,"
                " half of a press's cycle",
                "lower [rig] clearance_mm, or raise readings_per_press or press_mm_s",
            )


def _standing(link: MarlinLink) -> Place:
    """Where the nozzle stands; RigFault("refused") where it has not been homed."""
    places = [place for _ in range(3) for line in link.ask("M114") if (place := marlin.place(line)) is not None]
    if not places:
        raise RigFault("refused", "the printer does not say where it is (M114)")
    if math.hypot(*places[-1]) == 0:
        raise RigFault("refused", "the printer says that it is at 0, 0, 0: it has not been homed, or not raised", HOME)
    return places[-1]
