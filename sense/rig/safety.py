"""Checks of a target before the arm moves, of its state while it moves, and the one wait that all moves use."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NoReturn

from padforge.sense.rig.devices import Arm, ArmState, RigFault
from padforge.sense.settings import RigSettings

Vector = tuple[float, float, float]
DOWN: Vector = (0.0, math.pi, 0.0)
"""Rotation vector of a tool that points straight down."""
MAX_LEAN_DEG = 10.0
"""Largest angle between the expected tool axis and straight down: depths are measured along the base's z axis."""
TCP_SLACK_MM = 0.1
STILL_MM_S = 1.0
DEPTH_SLACK_MM = 0.3
"""How much deeper than allowed a moving tip may read: noise and overshoot, not a wrong target."""
POLL_S = 0.004


@dataclass(frozen=True)
class Limits:
    """What the arm may do; lengths in the base frame.

    Attributes:
        box_mm: lowest and highest x, y and z of the tip. contact_mm: z of the pad's surface; None while it is unknown,
            and then no target is safe. max_depth_mm: below it. max_speed_mm_s, max_acceleration_mm_s2: of the tip.
        tool: rotation vector of the tool as it should be held. max_tilt_deg: between its axis and a target's.
        max_turn_deg: about its axis, from how the arm holds it before the first move.
        max_force_n: on the tool, whatever its direction; None where nobody watches it.
        max_state_age_s: of the latest state. deadline_s: longest duration of a move.
    """

    box_mm: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    contact_mm: float | None
    max_depth_mm: float
    max_speed_mm_s: float = 250.0
    max_acceleration_mm_s2: float = 1200.0
    tool: Vector = DOWN
    max_tilt_deg: float = 2.0
    max_turn_deg: float = 45.0
    max_force_n: float | None = 50.0
    max_state_age_s: float = 0.5
    deadline_s: float = 30.0

    @classmethod
    def of(cls, rig: RigSettings) -> "Limits":
        """The limits that `[rig]` says; RigFault("refused") where the workspace is unknown."""
        if rig.box_mm is None:
            raise RigFault(
                "refused",
                "[rig] box_mm is unknown, allowed are six numbers: x, y and z from and to, in the base frame",
                "measure the workspace with the tool by hand",
            )
        x0, x1, y0, y1, z0, z1 = rig.box_mm
        try:
            return cls(
                box_mm=((x0, x1), (y0, y1), (z0, z1)),
                contact_mm=rig.contact_mm,
                max_depth_mm=rig.max_depth_mm,
                max_speed_mm_s=max(rig.travel_mm_s, rig.press_mm_s),
                max_acceleration_mm_s2=rig.acceleration_mm_s2,
                tool=rig.tool_rad,
                max_force_n=rig.max_force_n,
            )
        except ValueError as error:
            raise RigFault("refused", f"[rig] {error}") from None

    def __post_init__(self) -> None:
        """ValueError for limits that limit nothing."""
        for axis, (low, high) in zip("xyz", self.box_mm, strict=True):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ValueError(f"box_mm: {axis} from {low} to {high}; expected two finite numbers, ascending")
        speeds = ("max_speed_mm_s", "max_acceleration_mm_s2")
        force = () if self.max_force_n is None else ("max_force_n",)
        for name in ("max_depth_mm", *speeds, *force, "max_state_age_s", "deadline_s"):
            if not (math.isfinite(value := getattr(self, name)) and value > 0):
                raise ValueError(f"{name} is {value}; expected a finite number above 0")
        for name, most in (("max_tilt_deg", 90), ("max_turn_deg", 180)):
            if not 0 <= (value := getattr(self, name)) <= most:
                raise ValueError(f"{name} is {value}; allowed 0 to {most}")
        if self.contact_mm is not None and not math.isfinite(self.contact_mm):
            raise ValueError(f"contact_mm is {self.contact_mm}; expected a finite number or None")
        if not tilt_deg(self.tool, DOWN) <= MAX_LEAN_DEG:
            raise ValueError(f"tool is {self.tool}; expected a rotation vector that points the tool down")


def tilt_deg(tool: Sequence[float], expected: Sequence[float]) -> float:
    """Angle in degrees between the axes of two tools given by their rotation vectors."""
    a, b = _axis(tool), _axis(expected)
    cross = math.hypot(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return math.degrees(math.atan2(cross, sum(p * q for p, q in zip(a, b, strict=True))))


def turn_deg(tool: Sequence[float], expected: Sequence[float]) -> float:
    """Angle in degrees, 0 to 180, by which two tools given by their rotation vectors differ about their axis."""
    (w, x, y, z), (p, q, r, s) = _quaternion(tool), _quaternion(expected)
    about, along = w * s - z * p - x * r + y * q, w * p + x * q + y * r + z * s
    return math.degrees(2 * math.atan2(abs(about), abs(along)))


def check_finite_move(pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
    """RigFault("refused") unless these are six finite numbers and two positive ones."""
    if len(pose) != 6:
        _refuse(f"a pose of {len(pose)} numbers", "6")
    if not all(math.isfinite(value) for value in pose):
        _refuse(f"the pose {list(pose)}", "finite numbers")
    for name, value in (("speed", speed_mm_s), ("acceleration", acceleration_mm_s2)):
        if not (math.isfinite(value) and value > 0):
            _refuse(f"the {name} {value}", "more than 0")


def require_safe(pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float, limits: Limits) -> None:
    """Check a target before any motion.

    Args:
        pose: x, y, z in mm and a rotation vector in rad. speed_mm_s, acceleration_mm_s2: of the move.
        limits: what is allowed.

    Raises:
        RigFault: "refused", naming what is out of limits, its value and what is allowed.
    """
    check_finite_move(pose, speed_mm_s, acceleration_mm_s2)
    if limits.contact_mm is None:
        _refuse("the height of the pad's surface unknown", "a measured height")
    for axis, value, (low, high) in zip("xyz", pose[:3], limits.box_mm, strict=True):
        if not low <= value <= high:
            _refuse(f"{axis} {value:g} mm", f"{low:g} to {high:g} mm")
    if (depth := limits.contact_mm - pose[2]) > limits.max_depth_mm:
        _refuse(f"depth {depth:g} mm", f"at most {limits.max_depth_mm:g} mm")
    if speed_mm_s > limits.max_speed_mm_s:
        _refuse(f"speed {speed_mm_s:g} mm/s", f"at most {limits.max_speed_mm_s:g} mm/s")
    if acceleration_mm_s2 > limits.max_acceleration_mm_s2:
        _refuse(f"acceleration {acceleration_mm_s2:g} mm/s²", f"at most {limits.max_acceleration_mm_s2:g} mm/s²")
    if not (tilt := tilt_deg(pose[3:], limits.tool)) <= limits.max_tilt_deg:
        _refuse(f"the tool tilted by {tilt:.1f} degrees", f"at most {limits.max_tilt_deg:g}")


def require_ready(state: ArmState, limits: Limits) -> None:
    """Check how the arm stands before it moves for the first time.

    Raises:
        RigFault: "refused" where the first move would turn the tool too far, and with it its cable, or where the force
            is to be watched and the arm tells none.
    """
    if not (turn := turn_deg(state.pose[3:], limits.tool)) <= limits.max_turn_deg:
        _refuse(f"the tool is held {turn:.0f} degrees away from [rig] tool_rad", f"at most {limits.max_turn_deg:g}")
    if state.force_n is None and limits.max_force_n is not None:
        _refuse(f"[rig] max_force_n is {limits.max_force_n:g}, but this arm tells no force", '"unwatched"')


def require_tool(tcp_mm: Vector | None, about: Mapping[str, Any]) -> None:
    """Check `[rig]` tcp_mm against what an arm said of itself on connecting; some, such as printers, have no tcp.

    Raises:
        RigFault: "refused" where it is unknown, or another than the arm's.
    """
    if "tcp" not in about:
        return
    told = tuple(round(float(value), 3) for value in about["tcp"][:3])
    if tcp_mm is None:
        _refuse("[rig] tcp_mm is unknown", f"x, y and z of the tip as measured; the controller says {list(told)}")
    if not all(abs(a - b) <= TCP_SLACK_MM for a, b in zip(tcp_mm, told, strict=True)):
        _refuse(f"[rig] tcp_mm is {list(tcp_mm)}", f"what the controller says, {list(told)}, to {TCP_SLACK_MM} mm")


def watch(state: ArmState, limits: Limits, now_s: float, until_s: float = math.inf) -> None:
    """Check a state during a move.

    Args:
        state: the latest. limits: what is allowed. now_s: the time. until_s: when the move has to be over.

    Raises:
        RigFault: "emergency_stop", "protective_stop", "stale", "force", "refused" (too deep), or "deadline".
    """
    look = "look at the arm, unlock it at the pendant, then connect again"
    if state.emergency_stop:
        raise RigFault("emergency_stop", "the arm is in an emergency stop", look)
    if state.protective_stop:
        raise RigFault("protective_stop", "the arm is in a protective stop", look)
    if not (age := now_s - state.time_s) <= limits.max_state_age_s:
        raise RigFault("stale", f"the arm's last state is {age:.2f} s old; allowed {limits.max_state_age_s:g} s")
    force_n, most_n = state.pushed_n, limits.max_force_n
    if force_n is not None and most_n is not None and not force_n <= most_n:
        raise RigFault("force", f"the force is {force_n:.1f} N; allowed {most_n:g} N")
    depth = -math.inf if limits.contact_mm is None else limits.contact_mm - state.pose[2]
    if not depth <= limits.max_depth_mm + DEPTH_SLACK_MM:
        raise RigFault("refused", f"the tip is {depth:.2f} mm deep; allowed {limits.max_depth_mm:g} mm")
    if now_s > until_s:
        raise RigFault("deadline", f"the move was not over after {limits.deadline_s:g} s")


def wait_until_still(
    arm: Arm,
    limits: Limits,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    meanwhile: Callable[[], None] = lambda: None,
) -> ArmState:
    """Wait until the arm has ended its move; whatever goes wrong, the arm is stopped before that is raised.

    Args:
        arm: which moves. limits: checked at every state. clock, sleep: time in s and a pause.
        meanwhile: what is to be done between two states, such as reading a converter.

    Returns:
        The first state at rest.

    Raises:
        RigFault: see `watch`, and the arm's own faults.
    """
    until_s = clock() + limits.deadline_s
    try:
        while True:
            state = arm.state()
            watch(state, limits, clock(), until_s)
            if not state.moving and state.speed_mm_s <= STILL_MM_S:
                return state
            meanwhile()
            sleep(POLL_S)
    except BaseException:
        with suppress(RigFault):
            arm.stop()
        raise


def _axis(rotation: Sequence[float]) -> Vector:
    """Where a rotation vector takes the z axis."""
    angle = math.hypot(*rotation)
    if angle == 0:
        return 0.0, 0.0, 1.0
    x, y, z = (value / angle for value in rotation)
    sine, rest = math.sin(angle), 1 - math.cos(angle)
    return y * sine + x * z * rest, -x * sine + y * z * rest, math.cos(angle) + z * z * rest


def _quaternion(rotation: Sequence[float]) -> tuple[float, float, float, float]:
    """A rotation vector as a unit quaternion, its scalar first."""
    angle = math.hypot(*rotation)
    share = math.sin(angle / 2) / angle if angle else 0.0
    x, y, z = (share * value for value in rotation)
    return math.cos(angle / 2), x, y, z


def _refuse(what: str, allowed: str) -> NoReturn:
    raise RigFault("refused", f"no move: {what}; allowed {allowed}")
