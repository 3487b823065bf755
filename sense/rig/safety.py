"""Safety of the arm: limits, checks of a target before a move and of states during it, and the retreat.

The arm moves only to targets that `check_target` has passed. `wait_until_still` waits for the end of every move; it
checks every state and stops the arm before it raises. After a fault `retreat` lifts the stopped tool off the pad.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from padforge.sense.rig import clock
from padforge.sense.rig.devices import Arm, ArmState, Pose, RigFault
from padforge.sense.settings import RigSettings

Range = tuple[float, float]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
DOWN: Vector = (0.0, math.pi, 0.0)  # rotation vector of a tool that points straight down
MAX_LEAN_DEG = 10.0  # between the expected tool axis and straight down, since depths are measured along the base's z
MAX_TILT_DEG = 2.0  # between the expected tool axis and a target's
MAX_TURN_DEG = 45.0  # about that axis, between the first target and the tool before the first move
TCP_TOLERANCE_MM = 0.1
MAX_STATE_AGE_S = 0.5  # of the latest state; an older one is stale
DEPTH_TOLERANCE_MM = 0.3  # excess of a moving tip over the maximum depth, by noise and overshoot
POLL_S = 0.004  # between two states

RETREAT_MM_S = 10.0
RETREAT_MM = 10.0  # height above the pad, or above the position where the force was too high
FALL_START_S = 0.2  # time in the retreat after which an excessive force has to fall
FALL_END_S = 1.0  # time after which it has to be below its limit
FRESH_S = 1.0  # longest wait for a state before the retreat: a link that fell silent may recover
MAX_RISE_N = 5.0  # of an excessive force above its minimum so far: the error of force sensors
EDGE_MM = 1.0  # distance outside the box at which the tool may stand before the retreat: arms stop near their target


@dataclass(frozen=True)
class Limits:
    """Limits of the arm's motion, in the base frame. Raises ValueError for a limit that is not positive and finite."""

    box_mm: tuple[Range, Range, Range]  # minimum and maximum of x, y and z of the tip
    contact_mm: float | None  # z of the pad's surface; no target is safe if it is None
    max_depth_mm: float  # of the tip below the surface
    max_speed_mm_s: float = 250.0
    max_acceleration_mm_s2: float = 1200.0
    tool: Vector = DOWN  # expected rotation vector of the tool
    max_force_n: float | None = 50.0  # on the tool, in any direction; None if the force is not watched
    deadline_s: float = 30.0  # of a move

    @classmethod
    def from_settings(cls, rig: RigSettings) -> "Limits":
        """Return the limits that `[rig]` sets; raises RigFault("refused") if the workspace is unknown."""
        if rig.box_mm is None:
            message = "[rig] box_mm is unknown, allowed are six numbers: x, y and z from and to, in the base frame"
            raise RigFault("refused", message, "measure the workspace with the tool by hand")
        x0, x1, y0, y1, z0, z1 = rig.box_mm
        try:
            return cls(
                ((x0, x1), (y0, y1), (z0, z1)),
                rig.contact_mm,
                rig.max_depth_mm,
                max_speed_mm_s=max(rig.travel_mm_s, rig.press_mm_s),
                max_acceleration_mm_s2=rig.acceleration_mm_s2,
                tool=rig.tool_rad,
                max_force_n=rig.max_force_n,
            )
        except ValueError as error:
            raise RigFault("refused", f"[rig] {error}") from None

    def __post_init__(self) -> None:
        for axis, (low, high) in zip("xyz", self.box_mm, strict=True):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"box_mm: {axis} from {low} to {high}; expected two finite numbers, ascending")
        for name in ("max_depth_mm", "max_speed_mm_s", "max_acceleration_mm_s2", "max_force_n", "deadline_s"):
            value, may_be_none = getattr(self, name), name == "max_force_n"
            if not (may_be_none if value is None else 0 < value < math.inf):
                raise ValueError(f"{name} is {value}; expected a finite number above 0")
        if self.contact_mm is not None and not math.isfinite(self.contact_mm):
            raise ValueError(f"contact_mm is {self.contact_mm}; expected a finite number or None")
        if not tilt_deg(self.tool, DOWN) <= MAX_LEAN_DEG:
            raise ValueError(f"tool is {self.tool}; expected a rotation vector that points the tool down")


def tilt_deg(tool: Sequence[float], expected: Sequence[float]) -> float:
    """Return the angle in degrees between the axes of two tools, given by their rotation vectors (swing)."""
    w, x, y, z = _rotation(tool, expected)
    return math.degrees(2 * math.atan2(math.hypot(x, y), math.hypot(w, z)))


def turn_deg(tool: Sequence[float], expected: Sequence[float]) -> float:
    """Return the angle in degrees, 0 to 180, between two tools about their axis (twist)."""
    w, _, _, z = _rotation(tool, expected)
    return math.degrees(2 * math.atan2(abs(z), abs(w)))


def _rotation(start: Sequence[float], end: Sequence[float]) -> Quaternion:
    """Return the rotation from one tool to another in the frame of the first, conj(q1) q2."""
    (w, x, y, z), (p, q, r, s) = _quaternion(start), _quaternion(end)
    return (
        w * p + x * q + y * r + z * s,
        w * q - x * p - y * s + z * r,
        w * r + x * s - y * p - z * q,
        w * s - x * r + y * q - z * p,
    )


def _quaternion(rotation: Sequence[float]) -> Quaternion:
    """Convert a rotation vector to a unit quaternion, its scalar first."""
    angle = math.hypot(*rotation)
    scale = math.sin(angle / 2) / angle if angle else 0.0
    x, y, z = (scale * value for value in rotation)
    return math.cos(angle / 2), x, y, z


def check_finite_move(pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
    """Raise RigFault("refused") unless the pose is six finite numbers, and speed and acceleration are positive."""
    if len(pose) != 6:
        _refuse(f"a pose of {len(pose)} numbers", "6")
    if not all(math.isfinite(value) for value in pose):
        _refuse(f"the pose {list(pose)}", "finite numbers")
    for name, value in (("speed", speed_mm_s), ("acceleration", acceleration_mm_s2)):
        if not 0 < value < math.inf:
            _refuse(f"the {name} {value}", "more than 0")


def check_probe(rig: RigSettings) -> None:
    """Raise RigFault("refused") unless `[rig]` has the position of the tip of a printer's probe."""
    if rig.tcp_mm is None:
        message = "[rig] tcp_mm is unknown, allowed are x, y and z of the probe's tip from the nozzle"
        raise RigFault("refused", message, "measure them with the probe in place")


def check_target(pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float, limits: Limits) -> None:
    """Raise RigFault("refused") if a target is beyond the limits."""
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
    if not (tilt := tilt_deg(pose[3:], limits.tool)) <= MAX_TILT_DEG:
        _refuse(f"the tool tilted by {tilt:.2f} degrees", f"at most {MAX_TILT_DEG:g}")


def check_start_state(state: ArmState, limits: Limits) -> None:
    """Raise RigFault("refused") if the first move would turn the tool too far, or a limited force is not measured."""
    if not (turn := turn_deg(state.pose[3:], limits.tool)) <= MAX_TURN_DEG:
        _refuse(f"the tool is held {turn:.0f} degrees away from [rig] tool_rad", f"at most {MAX_TURN_DEG:g}")
    if state.force_n is None and limits.max_force_n is not None:
        _refuse(f"[rig] max_force_n is {limits.max_force_n:g}, but this arm measures no force", '"unwatched"')


def check_tcp(tcp_mm: Vector | None, identity: Mapping[str, Any]) -> None:
    """Raise RigFault("refused") unless `[rig]` tcp_mm is the tool centre point that an arm stores, if any."""
    if "tcp" not in identity:
        return
    measured = tuple(round(float(value), 3) for value in identity["tcp"][:3])
    if tcp_mm is None:
        _refuse("[rig] tcp_mm is unknown", f"x, y and z of the tip as measured; the controller says {list(measured)}")
    if not all(abs(a - b) <= TCP_TOLERANCE_MM for a, b in zip(tcp_mm, measured, strict=True)):
        allowed = f"what the controller says, {list(measured)}, to {TCP_TOLERANCE_MM} mm"
        _refuse(f"[rig] tcp_mm is {list(tcp_mm)}", allowed)


def check_state(state: ArmState, limits: Limits, now_s: float, until_s: float = math.inf) -> None:
    """Raise RigFault if the latest state in a move is beyond the limits, or the move is not over at `until_s`."""
    advice = "look at the arm, unlock it at the pendant, then connect again"
    if state.emergency_stop:
        raise RigFault("emergency_stop", "the arm is in an emergency stop", advice)
    if state.protective_stop:
        raise RigFault("protective_stop", "the arm is in a protective stop", advice)
    if not (age := now_s - state.time_s) <= MAX_STATE_AGE_S:
        raise RigFault("stale", f"the arm's last state is {age:.2f} s old; allowed {MAX_STATE_AGE_S:g} s")
    force_n, max_n = state.total_force_n, limits.max_force_n
    if max_n is not None and force_n is None:
        raise RigFault("force", f"the arm measures no force any more; allowed {max_n:g} N", "look at its sensor")
    if max_n is not None and force_n is not None and not force_n <= max_n:
        raise RigFault("force", f"the force is {force_n:.1f} N; allowed {max_n:g} N")
    depth = -math.inf if limits.contact_mm is None else limits.contact_mm - state.pose[2]
    if not depth <= limits.max_depth_mm + DEPTH_TOLERANCE_MM:
        raise RigFault("refused", f"the tip is {depth:.2f} mm deep; allowed {limits.max_depth_mm:g} mm")
    if now_s > until_s:
        raise RigFault("deadline", f"the move was not over after {limits.deadline_s:g} s")


def wait_until_still(arm: Arm, limits: Limits, on_wait: Callable[[], None] = lambda: None) -> ArmState:
    """Wait until the arm has ended its move, and return its state; the arm is stopped before any exception is raised.

    Every state is checked against the limits; `on_wait` is called between two states.
    """
    until_s = clock.now() + limits.deadline_s
    try:
        while True:
            state = arm.state()
            check_state(state, limits, clock.now(), until_s)
            if not state.moving and state.speed_mm_s <= 1.0:
                return state
            on_wait()
            clock.sleep(POLL_S)
    except BaseException:
        with suppress(RigFault):
            arm.stop()
        raise


def retreat(arm: Arm, limits: Limits) -> None:
    """Lift the tool straight up, unless it is above the pad already and the force is within its limit.

    The move is checked like any other, with three exceptions: the tool may start at the edge of the box or too deep,
    and a force beyond its limit has to fall. If it does not, the arm is stopped and RigFault("force") raised.
    """
    state = _await_state(arm)
    if state.force_n is None:  # the sensor may have failed during a press, and the tool must be lifted nevertheless
        limits = replace(limits, max_force_n=None)
    if limits.contact_mm is None:
        return
    z, max_n, force_n = state.pose[2], limits.max_force_n, state.total_force_n or 0.0
    overloaded = max_n is not None and force_n > max_n
    sides = ((low - EDGE_MM, high + EDGE_MM) for low, high in limits.box_mm[:2])
    relaxed = replace(
        limits,
        box_mm=(*sides, limits.box_mm[2]),
        max_force_n=None if overloaded else max_n,
        max_depth_mm=max(limits.max_depth_mm, limits.contact_mm - z),
    )
    check_state(state, relaxed, clock.now())
    # RETREAT_MM above the pad, and at least the present height, or RETREAT_MM above that if the force is too high
    clear_mm = max(limits.contact_mm, z if overloaded else z - RETREAT_MM) + RETREAT_MM
    up: Pose = (*state.pose[:2], min(clear_mm, limits.box_mm[2][1]), *state.pose[3:])
    if up[2] <= z:
        return
    speed_mm_s = min(RETREAT_MM_S, limits.max_speed_mm_s)
    check_target(up, speed_mm_s, limits.max_acceleration_mm_s2, relaxed)
    arm.move(up, speed_mm_s, limits.max_acceleration_mm_s2)
    on_wait = _FallingForceCheck(arm, force_n, max_n) if overloaded and max_n else lambda: None
    check_state(wait_until_still(arm, relaxed, on_wait), limits, clock.now())


def _await_state(arm: Arm) -> ArmState:
    """Return the first state that is not stale, or the latest after `FRESH_S`; raises the RigFault of `arm.state`."""
    until_s = clock.now() + FRESH_S
    while True:
        try:
            state = arm.state()
        except RigFault as fault:
            if fault.cause != "stale" or clock.now() >= until_s:
                raise
        else:
            if clock.now() - state.time_s <= MAX_STATE_AGE_S or clock.now() >= until_s:
                return state
        clock.sleep(POLL_S)


class _FallingForceCheck:
    """A check, to be called repeatedly, that raises RigFault("force") unless the force on the tool falls."""

    def __init__(self, arm: Arm, first_n: float, max_n: float) -> None:
        self._arm, self._first_n, self._max_n = arm, first_n, max_n
        self._start_s, self._min_n = clock.now(), first_n

    def __call__(self) -> None:
        force_n = self._arm.state().total_force_n or 0.0
        self._min_n = min(self._min_n, force_n)
        # The allowed force falls linearly from the first one to the limit, and is at most MAX_RISE_N above the minimum.
        remaining = min((self._start_s + FALL_END_S - clock.now()) / (FALL_END_S - FALL_START_S), 1.0)
        line_n = self._max_n + (self._first_n + MAX_RISE_N - self._max_n) * remaining
        if not force_n <= max(self._max_n, min(self._min_n + MAX_RISE_N, line_n)):
            raise RigFault("force", f"the force does not fall, it is {force_n:.1f} N", "free the tool by hand")


def _refuse(problem: str, allowed: str) -> NoReturn:
    raise RigFault("refused", f"no move: {problem}; allowed {allowed}")
