"""Devices of a rig behind two small protocols: an arm that presses and a board that reads the fibres.

Ours and third-party devices are used alike. Times are seconds of one clock, the host's `time.monotonic`;
lengths are mm in the arm's base frame, angles radians. Arms and boards are found by name, as entry points of installed
packages: `padforge.arms` names functions of `RigSettings` that return an `Arm`; `padforge.boards` functions of
`RigSettings` and the inputs to read, in the order of the fibres, that return a `Board`.
"""

import errno
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, Protocol

import padforge
from padforge.common.validation import Fault, InputError
from padforge.sense.arrays import Array, Indices
from padforge.sense.rig import clock

Pose = tuple[float, float, float, float, float, float]
"""x, y, z in mm and a rotation vector in radians."""
Cause = Literal["refused", "lost", "stale", "protective_stop", "emergency_stop", "deadline", "force", "data", "disk"]
Group = Literal["padforge.arms", "padforge.boards"]
ROOT = Path(padforge.__file__).parents[1]
"""The folder that `padforge` is imported from; in a checkout, this file is not below that package."""


class RigFault(Fault):
    """A fault of the rig that ends or prevents a recording: what happened, and what a person can do about it."""

    def __init__(self, cause: Cause, message: str, advice: str = "") -> None:
        super().__init__(f"{message}; {advice}" if advice else message)
        self.cause: Cause = cause  # for programs
        self.exit_code = 2 if cause == "refused" else 1  # of a command that ends with it: 2 if nothing was begun


@dataclass(frozen=True)
class ArmState:
    """State of the arm at one moment."""

    time_s: float  # when it arrived
    pose: Pose  # of the tool
    speed_mm_s: float  # of the tool, >= 0
    force_n: float | None  # at the tool, along z; None without a sensor, which `[rig] max_force_n` has to permit
    protective_stop: bool  # whether the controller has stopped the arm
    emergency_stop: bool  # whether a person has stopped the arm
    moving: bool  # whether the last move is still under way
    sideways_n: float = 0.0  # force on the tool across z, >= 0; 0 without a sensor

    def to_row(self) -> list[float]:
        """Return the row of the state, by `STATE_COLUMNS`."""
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

        `serial` and, where the controller keeps the tool, `tcp` (the tip from the flange, mm and rad) are compared when
        a recording is resumed. Raises RigFault("refused") if another program controls the arm.
        """
        ...

    def state(self) -> ArmState:
        """Return the latest state; raises RigFault("stale") if it is older than 0.5 s, "lost" if the link is down."""
        ...

    def drain(self) -> Array:
        """Return the (n, 10) states since the last call, by `STATE_COLUMNS`, none twice."""
        ...

    def move(self, pose: Pose, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Start a straight move and return; the caller has checked it against the limits."""
        ...

    def stop(self) -> None:
        """Stop the arm where it is, within 0.5 s; safe to call at any time and more than once."""
        ...

    def close(self) -> None:
        """Stop the arm and close the link; never raises."""
        ...


@dataclass(frozen=True)
class BoardSamples:
    """Samples as a board delivers them."""

    times_s: Array  # (n,) host times, ascending
    volts: Array  # (n, C) readings of C channels
    missing: Indices  # (n,) number of samples lost before each of them; a gap is never filled


class Board(Protocol):
    """An analogue-to-digital converter with C channels. Methods raise `RigFault` within 5 s."""

    def connect(self) -> Mapping[str, Any]:
        """Open the link, start sampling and return the board's identity (name, versions, bits ...) as JSON.

        Of it are used: `rate_hz`, samples a second; `channels`, the number C; `inputs`, which of the board they are;
        `supply_v`, the reading at full scale, if that is known; and `warning`, which `doctor` shows.
        """
        ...

    def read(self) -> BoardSamples:
        """Return all samples since the last call at once; raises RigFault("stale") after 1 s without any, or "lost"."""
        ...

    def close(self) -> None:
        """Stop sampling and close the link; never raises."""
        ...


def load_device(group: Group, name: str) -> Callable[..., Any]:
    """Return the function that makes an arm or a board; raises InputError if there is none that can be imported."""
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


def start(module: str, *arguments: str, stderr: int | None = None) -> subprocess.Popen[bytes]:
    """Start `python -m module` with pipes to its stdin and stdout; an interrupt from the keyboard does not reach it.

    It finds this package wherever it is started from, and imports nothing from the current folder (`-P`).
    """
    path = os.pathsep.join((str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env=os.environ | {"PYTHONPATH": path},
        start_new_session=True,
    )


def host_ports() -> list[Any]:
    """List the serial ports of this host, as pyserial does; raises RigFault("refused") without pyserial."""
    _import_pyserial()
    from serial.tools.list_ports import comports

    return list(comports())


class SerialStream:
    """An open serial port. Any method but `close` raises RigFault("lost") once the device is gone."""

    def __init__(self, port: str, baud: int, timeout_s: float, device: str = "board") -> None:
        """Open a port for this process alone; `timeout_s` is the longest wait of `receive`.

        Raises RigFault("refused"), and why, if it cannot be opened.
        """
        serial = _import_pyserial()
        self.port, self._device = port, device
        try:
            self.serial: Any = serial.Serial(port, baud, timeout=timeout_s, write_timeout=1, exclusive=True)
        except Exception as error:  # pyserial lets termios.error through, which is no OSError
            raise port_fault(port, error) from error

    def receive(self) -> tuple[float, bytes]:
        """Wait for bytes; return the host time and all that have come, possibly none."""
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
        return RigFault(
            "lost", f"{self.port}: the {self._device} is gone ({error})", "check its cable and connect again"
        )


def port_fault(port: str, error: Exception) -> RigFault:
    """Translate pyserial's `error` on opening `port` into a fault with advice."""
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
