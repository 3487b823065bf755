"""What an arm does after a fault, once it is stopped: it takes the tool off the pad, slowly, and stands."""

from collections.abc import Callable
from dataclasses import replace

from padforge.sense.rig.devices.protocols import Arm, ArmState, Pose, RigFault
from padforge.sense.rig.safety import Limits, require_safe, wait_until_still, watch

SPEED_MM_S = 10.0
HEIGHT_MM = 10.0
"""How far above the pad the tool ends, and above where it was while the force was too great."""
START_S, FALL_S = 0.2, 1.0
"""When a force that was too great has to begin to fall, and when it has to be below its limit."""
RISE_N = 5.0
"""How far it may rise above the least it was: what sensors are off by."""
EDGE_MM = 1.0
"""How far outside the box a tool may stand that was sent to its edge: no arm stands quite where it was sent."""


def retreat(
    arm: Arm, limits: Limits, acceleration_mm_s2: float, clock: Callable[[], float], sleep: Callable[[float], None]
) -> None:
    """Lift the tool straight up, unless it is above the pad already and no force is too great.

    All is watched as in any move, but that a force or depth beyond its limit has to become less, and that the tool may
    stand at the edge of the box. The arm is stopped where the force does not become less.

    Raises:
        RigFault: see `watch` and `require_safe`; "force" where the force does not fall.
    """
    state = arm.state()
    if limits.contact_mm is None:
        return
    z, most_n = state.pose[2], limits.max_force_n
    pressed = most_n is not None and _force(state) > most_n
    sides = ((low - EDGE_MM, high + EDGE_MM) for low, high in limits.box_mm[:2])
    eased = replace(
        limits,
        box_mm=(*sides, limits.box_mm[2]),
        max_force_n=None if pressed else most_n,
        max_depth_mm=max(limits.max_depth_mm, limits.contact_mm - z),
    )
    watch(state, eased, clock())
    free = max(limits.contact_mm, z if pressed else z - HEIGHT_MM) + HEIGHT_MM
    up: Pose = (*state.pose[:2], min(free, limits.box_mm[2][1]), *state.pose[3:])
    if up[2] <= z:
        return
    speed_mm_s = min(SPEED_MM_S, limits.max_speed_mm_s)
    require_safe(up, speed_mm_s, acceleration_mm_s2, eased)
    arm.move(up, speed_mm_s, acceleration_mm_s2)
    falling = _falling(arm, _force(state), most_n, clock) if most_n is not None and pressed else lambda: None
    watch(wait_until_still(arm, eased, clock, sleep, falling), limits, clock())


def _falling(arm: Arm, first_n: float, most_n: float, clock: Callable[[], float]) -> Callable[[], None]:
    """What raises RigFault("force") unless the force of an arm falls from now on."""
    begun_s, least_n = clock(), first_n

    def require_fall() -> None:
        nonlocal least_n
        force_n = _force(arm.state())
        least_n = min(least_n, force_n)
        left = min((begun_s + FALL_S - clock()) / (FALL_S - START_S), 1.0)
        if not force_n <= max(most_n, min(least_n + RISE_N, most_n + (first_n + RISE_N - most_n) * left)):
            raise RigFault("force", f"the force does not fall, it is {force_n:.1f} N", "free the tool by hand")

    return require_fall


def _force(state: ArmState) -> float:
    """Force on the tool, whatever its direction, N; 0 where the arm tells none."""
    return state.pushed_n or 0.0
