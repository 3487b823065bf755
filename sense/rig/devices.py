"""Protocols of the devices of a rig: an arm that presses, and a board that reads the fibres.

Times are seconds of one clock, the host's `time.monotonic`; lengths are mm in the arm's base frame, angles radians.
Devices are entry points of installed packages, of padforge or others: in the group `padforge.arms` functions of
`RigSettings` that return an `Arm`; in `padforge.boards` functions of `RigSettings` and the inputs to read, in the order
of the fibres, that return a `Board`.
"""

import errno
import math
import platform
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Literal, Protocol

from padforge.common.validation import Fault, InputError
from padforge.sense.arrays import Array, Indices
from padforge.sense.rig import clock

Pose = tuple[float, float, float, float, float, float]  # x, y, z in mm and a rotation vector in radians
Cause = Literal["refused", "lost", "stale", "protective_stop", "emergency_stop", "deadline", "force", "data", "disk"]
Group = Literal["padforge.arms", "padforge.boards"]


class RigFault(Fault):
    """A fault of the rig that ends or prevents a recording; its cause is "refused" if nothing was begun."""

    def __init__(self, cause: Cause, message: str, advice: str = "") -> None:
        super().__init__(f"{message}; {advice}" if advice else message)
        self.cause: Cause = cause
        self.exit_code = 2 if cause == "refused" else 1  # of the command


@dataclass(frozen=True)
class ArmState:
    """State of the arm at one moment."""

    time_s: float  # host time of its arrival
    pose: Pose  # of the tool
    speed_mm_s: float  # of the tool, >= 0
    force_n: float | None  # on the tool along z; None without a sensor, allowed if `[rig] max_force_n` is "unwatched"
    protective_stop: bool  # whether the controller has stopped the arm
    emergency_stop: bool  # whether a person has stopped the arm
    moving: bool  # whether the last move is in progress
    sideways_n: float = 0.0  # force on the tool across z, >= 0; 0 without a sensor

    def to_row(self) -> list[float]:
        """Return the state as a row of `STATE_COLUMNS`."""
        force_n = math.nan if self.force_n is None else self.force_n
        stopped = self.protective_stop or self.emergency_stop
        return [self.time_s, *self.pose, self.speed_mm_s, force_n, float(not stopped)]

    @property
    def total_force_n(self) -> float | None:
        """Magnitude of the force on the tool, >= 0; None without a sensor."""
        return None if self.force_n is None else math.hypot(self.force_n, self.sideways_n)


class Arm(Protocol):
    """A robot arm. Methods raise `RigFault` within 5 s rather than wait for ever."""

    def connect(self) -> Mapping[str, Any]:
        """Open the link and return the arm's identity (model, versions, rates) as JSON.

        When a recording is resumed, `serial` is compared, and `tcp` (the tip from the flange, mm and rad) if the
        controller stores it. Raises RigFault("refused") if another program controls the arm.
        """

    def state(self) -> ArmState:
        """Return the latest state; raises RigFault("stale") if it is older than 0.5 s, "lost" if the link is down."""

    def drain(self) -> Array:
        """Return the states since the last call, each exactly once; shape (n, 10), by `STATE_COLUMNS`."""

    def move(self, pose: Pose, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Start a straight move and return; the caller has checked it against the limits."""

    def stop(self) -> None:
        """Stop the arm where it is, within 0.5 s; safe to call at any time and more than once."""

    def close(self) -> None:
        """Stop the arm and close the link; never raises."""


@dataclass(frozen=True)
class BoardSamples:
    """Consecutive samples of a board."""

    times_s: Array  # (n,) host times, ascending
    volts: Array  # (n, C) readings of C channels
    missing: Indices  # (n,) number of samples lost before each sample; gaps are not filled


class Board(Protocol):
    """An analogue-to-digital converter with C channels. Methods raise `RigFault` within 5 s."""

    def connect(self) -> Mapping[str, Any]:
        """Open the link, start sampling and return the board's identity (name, versions, bits ...) as JSON.

        These keys are used: `rate_hz`, samples a second; `channels`, the number C; `inputs`, their numbers on the
        board; optionally `supply_v`, the reading at full scale; and `warning`, which `doctor` shows.
        """

    def read(self) -> BoardSamples:
        """Return all samples since the last call, without waiting; raises RigFault("stale") after 1 s without any."""

    def close(self) -> None:
        """Stop sampling and close the link; never raises."""


def load_device(group: Group, name: str) -> Callable[..., Any]:
    """Return the function that creates an arm or a board; raises InputError if it is missing or cannot be imported."""
    points = {point.name: point for point in reversed(list(entry_points(group=group)))}
    if name not in points:
        allowed = ", ".join(sorted(points)) or "none: padforge is not installed, run pip install ."
        raise InputError(f"{group.removeprefix('padforge.')}: got {name!r}, allowed are {allowed}")
    try:
        return points[name].load()
    except Exception as error:  # a third-party package may fail in any way
        raise InputError(f"{name}: {points[name].value} cannot be loaded ({type(error).__name__}: {error})") from error


def check_platform() -> None:
    """Raise InputError if rigs, which need POSIX, cannot run here."""
    if (system := platform.system()) not in ("Linux", "Darwin"):
        raise InputError(f"a rig needs Linux or macOS, this is {system}; allowed here is --rig simulated")


def host_ports() -> list[Any]:
    """List the serial ports of this host, as pyserial does; raises RigFault("refused") without pyserial."""
    _import_pyserial()
    from serial.tools.list_ports import comports

    return list(comports())


class SerialStream:
    """An open serial port, locked by this process; once the device is gone, methods raise RigFault("lost")."""

    def __init__(self, port: str, baud: int, timeout_s: float, device: str = "board") -> None:
        """Open a port; `timeout_s` is the longest wait of `receive`, `device` a name for messages."""
        serial = _import_pyserial()
        self.port, self._device = port, device
        try:
            self.serial: Any = serial.Serial(port, baud, timeout=timeout_s, write_timeout=1, exclusive=True)
        except Exception as error:  # pyserial also raises termios.error, which is not an OSError
            raise port_fault(port, error) from error

    def receive(self) -> tuple[float, bytes]:
        """Wait for bytes; return the host time and all bytes received, possibly none."""
        try:
            data = self.serial.read(1)
            if data:
                data += self.serial.read(self.serial.in_waiting)
        except OSError as error:
            raise self._lost(error) from error
        return clock.now(), data

    def send(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self.serial.write(data)
        except OSError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Close the port; never raises."""
        with suppress(OSError):
            self.serial.close()

    def _lost(self, error: OSError) -> RigFault:
        message = f"{self.port}: the {self._device} is gone ({error})"
        return RigFault("lost", message, "check its cable and connect again")


def port_fault(port: str, error: Exception) -> RigFault:
    """Return the fault, with advice, for pyserial's error on opening a port."""
    number = getattr(error, "errno", None)
    reason, advice = f"cannot be opened ({error})", "check that it is the right port"
    if number == errno.ENOENT:
        reason, advice = "there is no such port", "check the cable; `padforge sense doctor` lists the ports there are"
    elif number in (errno.EAGAIN, errno.EBUSY):
        reason, advice = "another program uses it", "close it; it may be the serial monitor of the Arduino IDE"
    elif number in (errno.EACCES, errno.EPERM):
        reason = "no permission to open it"
        advice = "join the group that owns it (`sudo usermod -aG dialout $USER`) and log in again"
    return RigFault("refused", f"{port}: {reason}", advice)


def _import_pyserial() -> Any:
    try:
        import serial
    except ModuleNotFoundError as error:
        raise RigFault("refused", "pyserial is not installed", "pip install 'padforge[rig]'") from error
    return serial
