"""What a rig is made of, behind two small protocols: an arm that presses and a converter that reads the fibres.
Real and simulated devices are used alike. All times are seconds of one clock, the host's `time.monotonic`; lengths are
mm in the arm's base frame, angles radians.

Arms and boards by their names: those of padforge, and those of any installed package, found by entry points.
`padforge.arms` names functions of the settings of `[rig]` that give an `Arm`; `padforge.boards` functions of these
settings and of the inputs to read, in the order of the fibres, that give a `Board`.

Starts a module of this package as a process of its own.

Serial ports of this host, with pyserial's ways to fail told apart for a person.
"""

import errno
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, Protocol

from padforge.design.common.validation import Fault, InputError
from padforge.sense.arrays import Array, Indices

Pose = tuple[float, float, float, float, float, float]
"""x, y, z in mm and a rotation vector in radians."""

Cause = Literal["refused", "lost", "stale", "protective_stop", "emergency_stop", "deadline", "force", "data", "disk"]


class RigFault(Fault):
    """Something about the rig that ends or prevents a recording: what it is, and what a person can do about it.

    Attributes:
        cause: kind of fault, for programs.
    """

    def __init__(self, cause: Cause, message: str, advice: str = "") -> None:
        super().__init__(f"{message}; {advice}" if advice else message)
        self.cause: Cause = cause
        self.exit_code = 2 if cause == "refused" else 1


@dataclass(frozen=True)
class ArmState:
    """One state of the arm.

    Attributes:
        time_s: when it arrived. pose: of the tool. speed_mm_s: of the tool, >= 0.
        force_n: at the tool, along z, None without a sensor; then `[rig]` has to say that nobody watches it.
        protective_stop, emergency_stop: whether the controller has stopped the arm.
        moving: whether the last move that was begun is still under way.
        sideways_n: force on the tool across z, >= 0; 0 without a sensor.
    """

    time_s: float
    pose: Pose
    speed_mm_s: float
    force_n: float | None
    protective_stop: bool
    emergency_stop: bool
    moving: bool
    sideways_n: float = 0.0

    @property
    def pushed_n(self) -> float | None:
        """Force on the tool in all, whatever its direction, >= 0; None without a sensor."""
        return None if self.force_n is None else math.hypot(self.force_n, self.sideways_n)


class Arm(Protocol):
    """A robot arm. Methods raise `RigFault` within 5 s rather than wait for ever."""

    def connect(self) -> Mapping[str, Any]:
        """Open the link; returns what the arm says of itself (model, versions, rates) as JSON.

        `serial` and, where the tool is something the arm is told of, `tcp` (the tip from the flange, mm and rad) are
        compared where a recording is gone on with. An arm that others use is refused, not taken from them.
        """
        ...

    def state(self) -> ArmState:
        """The latest state; raises RigFault("stale") where it is older than 0.5 s, "lost" where the link is down."""
        ...

    def drain(self) -> Array:
        """(n, 10) states since the last call, by `STATE_COLUMNS`, none twice."""
        ...

    def move(self, pose: Pose, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Begin a straight move and return; the caller has checked it against the limits."""
        ...

    def stop(self) -> None:
        """Stop the arm where it is, within 0.5 s; safe to call at any time and more than once."""
        ...

    def close(self) -> None:
        """Stop the arm and close the link; never raises."""
        ...


@dataclass(frozen=True)
class BoardSamples:
    """Readings as they come from a converter.

    Attributes:
        times_s: (n,) host times, ascending. volts: (n, C).
        missing: how many samples were lost before each of them, (n,) whole numbers; a gap is never filled.
    """

    times_s: Array
    volts: Array
    missing: Indices


class Board(Protocol):
    """An analogue-to-digital converter with C channels. Methods raise `RigFault` within 5 s."""

    def connect(self) -> Mapping[str, Any]:
        """Open the link and start sampling.

        Returns:
            What the board says of itself (name, versions, bits ...) as JSON; of it `rate_hz`, samples a second,
            `channels`, the number C, `inputs`, which of the board they are, and `supply_v`, the reading at full scale,
            are used. A `warning` is shown to whoever looks the rig over.
        """
        ...

    def read(self) -> BoardSamples:
        """All samples since the last call, without waiting; RigFault("stale") after 1 s without any, "lost" if gone."""
        ...

    def close(self) -> None:
        """Stop sampling and close the link; never raises."""
        ...


Group = Literal["padforge.arms", "padforge.boards"]


def device_names(group: Group) -> list[str]:
    """Names of all arms or boards that are installed."""
    return sorted({point.name for point in entry_points(group=group)})


def device(group: Group, name: str) -> Callable[..., Any]:
    """The function that makes an arm or a board.

    Raises:
        InputError: none has that name, or its package cannot be imported.
    """
    found = [point for point in entry_points(group=group) if point.name == name]
    if not found:
        allowed = ", ".join(device_names(group)) or "none: padforge is not installed, run pip install ."
        raise InputError(f"{group.removeprefix('padforge.')}: got {name!r}, allowed are {allowed}")
    try:
        return found[0].load()
    except Exception as error:  # a package of somebody else may fail in any way
        raise InputError(f"{name}: {found[0].value} cannot be loaded ({type(error).__name__}: {error})") from error


ROOT = Path(__file__).parents[3]


def require_rig_system() -> None:
    """Raise InputError where rigs and their emulators, which need what POSIX has, cannot run."""
    if (here := platform.system()) not in ("Linux", "Darwin"):
        raise InputError(f"a rig needs Linux or macOS, this is {here}; allowed here is --rig simulated")


def start(module: str, *arguments: str, stderr: int | None = None) -> subprocess.Popen[bytes]:
    """Run `python -m module` with pipes to its stdin and stdout.

    It finds this package wherever it is started from, and no code of the folder it is started in, which may be
    anybody's. An interrupt from the keyboard does not reach it: its parent decides what is to end first.
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
    """All serial ports of this host, as pyserial lists them: `device`, `vid`, `pid`, `serial_number`, `description`.

    Raises:
        RigFault: "refused" without pyserial.
    """
    _pyserial()
    from serial.tools.list_ports import comports

    return list(comports())


def open_port(port: str, baud: int, timeout_s: float) -> Any:
    """Open `port` for this process alone, as a `serial.Serial` whose reads wait for at most `timeout_s`.

    Raises:
        RigFault: "refused" where that cannot be, and why.
    """
    serial = _pyserial()
    try:
        return serial.Serial(port, baud, timeout=timeout_s, write_timeout=1, exclusive=True)
    except Exception as error:  # pyserial lets termios.error through, which is no OSError
        raise refusal(port, error) from error


def refusal(port: str, error: Exception) -> RigFault:
    """What pyserial's `error` on opening `port` means and what to do about it."""
    number, text = getattr(error, "errno", None), str(error)  # Windows has the kind in the text only
    if number == errno.ENOENT or "FileNotFoundError" in text:
        advice = "check the cable; `padforge sense doctor` lists the ports there are"
        return RigFault("refused", f"{port}: there is no such port", advice)
    if number in (errno.EAGAIN, errno.EBUSY) or "PermissionError" in text:
        advice = "close it; it may be the serial monitor of the Arduino IDE"
        return RigFault("refused", f"{port}: another program uses it", advice)
    if number in (errno.EACCES, errno.EPERM):
        advice = "join the group that owns it (`sudo usermod -aG dialout $USER`) and log in again"
        return RigFault("refused", f"{port}: no permission to open it", advice)
    return RigFault("refused", f"{port}: cannot be opened ({error})", "check that it is the right port")


def _pyserial() -> Any:
    try:
        import serial
    except ModuleNotFoundError as error:
        raise RigFault("refused", "pyserial is not installed", "pip install 'padforge[rig]'") from error
    return serial
