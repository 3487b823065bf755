"""What a rig is made of, behind two small protocols: an arm that presses and a converter that reads the fibres.

Real and simulated devices are used alike. All times are seconds of one clock, the host's `time.monotonic`; lengths are
mm in the arm's base frame, angles radians.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from padforge.design.common.validation import Fault
from padforge.sense.recordings.processing.limits import Array, Indices

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
class ConverterSamples:
    """Readings as they come from a converter.

    Attributes:
        times_s: (n,) host times, ascending. volts: (n, C).
        missing: how many samples were lost before each of them, (n,) whole numbers; a gap is never filled.
    """

    times_s: Array
    volts: Array
    missing: Indices


class Converter(Protocol):
    """An analogue-to-digital converter with C channels. Methods raise `RigFault` within 5 s."""

    def connect(self) -> Mapping[str, Any]:
        """Open the link and start sampling.

        Returns:
            What the board says of itself (name, versions, bits ...) as JSON; of it `rate_hz`, samples a second,
            `channels`, the number C, `inputs`, which of the board they are, and `supply_v`, the reading at full scale,
            are used. A `warning` is shown to whoever looks the rig over.
        """
        ...

    def read(self) -> ConverterSamples:
        """All samples since the last call, without waiting; RigFault("stale") after 1 s without any, "lost" if gone."""
        ...

    def close(self) -> None:
        """Stop sampling and close the link; never raises."""
        ...
