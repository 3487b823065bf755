"""No target beyond the limits passes, no wait goes on after a fault, and the retreat never pushes."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain, repeat
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.sense.rig import safety
from padforge.sense.rig.devices import ArmState, Pose, RigFault
from padforge.sense.rig.safety import FALL_END_S, FALL_START_S, MAX_RISE_N, RETREAT_MM, RETREAT_MM_S, Limits
from padforge.sense.settings import RigSettings
from tests.sense.rig.fakes import RIG, FakeArm, Time, fault_of

LIMITS = Limits(box_mm=((-100, 100), (-500, -300), (40, 120)), contact_mm=50.0, max_depth_mm=6.0, max_force_n=40.0)
SAFE: Pose = (0.0, -400.0, 60.0, 0.0, math.pi, 0.0)
X, Y, Z, *TOOL = SAFE
STILL = ArmState(10.0, SAFE, 0.0, 0.0, False, False, moving=False)
numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(numbers, max_size=8), numbers.filter(lambda value: not 0 < value <= 250))
def test_check_target_passes_only_within_every_limit(pose: list[float], speed: float) -> None:
    with contextlib.suppress(RigFault):
        safety.check_target(pose, 50, 500, LIMITS)  # pyright: ignore[reportArgumentType]
        assert len(pose) == 6
        assert all(low <= value <= high for value, (low, high) in zip(pose[:3], LIMITS.box_mm, strict=True))
        assert 50 - pose[2] <= 6
        assert safety.tilt_deg(pose[3:], LIMITS.tool) <= safety.MAX_TILT_DEG
    with pytest.raises(RigFault, match="speed"):
        safety.check_target(SAFE, speed, 500, LIMITS)


def test_checks_pass_on_the_limits_of_settings() -> None:
    """What lies beyond them is in the table of refusals."""
    rig = RigSettings(box_mm=(-1, 1, -2, 2, 0, 90), contact_mm=30, travel_mm_s=80, press_mm_s=20)
    update = {"max_depth_mm": 4.5, "acceleration_mm_s2": 700, "max_force_n": 33}
    expected = Limits(((-1, 1), (-2, 2), (0, 90)), 30, 4.5, 80, 700, max_force_n=33)
    assert Limits.from_settings(rig.model_copy(update=update)) == expected
    for position in ((-100, Y, Z), (100, Y, Z), (X, -500, Z), (X, -300, Z), (X, Y, 44), (X, Y, 120)):
        safety.check_target((*position, *TOOL), 250, 1200, LIMITS)
    safety.check_target((X, Y, Z, 0.0, math.pi - math.radians(1.99), 0.0), 50, 500, LIMITS)
    replace(LIMITS, tool=(0.0, math.pi * 0.95, 0.0))
    with pytest.raises(ValueError, match="points the tool down"):
        replace(LIMITS, tool=(0.0, math.pi * 0.94, 0.0))
    for degrees in (44.9, -44.9, 45.1, -170.0):
        with pytest.raises(RigFault, match="at most 45") if abs(degrees) > 45 else contextlib.nullcontext():
            safety.check_start_state(replace(STILL, pose=(X, Y, Z, *down(math.radians(degrees)))), LIMITS)
    tcp_mm = 0.0, 0.0, 150.0
    for each in (tcp_mm, None):
        safety.check_tcp(each, {"model": "a printer, which has none"})
    safety.check_tcp(tcp_mm, {"tcp": [0.0, 0.05, 150.09, 0.0, 0.0, 0.0]})
    with pytest.raises(RigFault, match="tcp_mm"):
        safety.check_tcp(tcp_mm, {"tcp": [math.nan] * 6})
    for change in ({"time_s": 9.51}, {"force_n": -39.9}, {"pose": (900.0, 900.0, 44.0 - 0.29, *TOOL)}):
        safety.check_state(replace(STILL, **change), LIMITS, 10.0, until_s=10.0)
    for cause, change in (("force", {"sideways_n": math.nan}), ("refused", {"pose": (X, Y, math.nan, *TOOL)})):
        with pytest.raises(RigFault) as caught:
            safety.check_state(replace(STILL, **change), LIMITS, 10.0)
        assert caught.value.cause == cause
    for force_n in (1e6, None):
        for check, more in ((safety.check_state, (10.0,)), (safety.check_start_state, ())):
            check(replace(STILL, force_n=force_n), replace(LIMITS, max_force_n=None), *more)


@given(st.floats(-math.pi, math.pi), st.tuples(*[st.floats(-7, 7)] * 3), st.tuples(*[st.floats(-7, 7)] * 3))
def test_tilt_deg_is_the_angle_between_axes(turn: float, a: tuple[float, ...], b: tuple[float, ...]) -> None:
    """A rotation about x by a takes the z axis to (0, -sin a, cos a); one about y to (sin b, 0, cos b)."""
    assert safety.tilt_deg(down(turn), LIMITS.tool) == pytest.approx(0, abs=1e-6)
    assert 0 <= safety.tilt_deg(a, b) <= 180
    assert safety.tilt_deg(a, b) == pytest.approx(safety.tilt_deg(b, a), abs=1e-9)
    for x, y in ((0.3, 0.4), (2.0, -1.0), (math.pi, 3.0)):
        cosine = math.cos(x) * math.cos(y)
        assert safety.tilt_deg((x, 0, 0), (0, y, 0)) == pytest.approx(math.degrees(math.acos(cosine)))


def down(turn: float) -> tuple[float, float, float]:
    """A tool that points down, turned about its axis."""
    return -math.pi * math.sin(turn / 2), math.pi * math.cos(turn / 2), 0.0


@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_turn_deg_is_the_angle_about_the_axis(a: float, b: float) -> None:
    turn = abs(math.remainder(a - b, 2 * math.pi))
    assert safety.turn_deg(down(a), down(b)) == pytest.approx(math.degrees(turn), abs=1e-4)
    assert safety.turn_deg((0.0, math.pi - 0.03, 0.0), LIMITS.tool) == pytest.approx(0, abs=1e-9)


def scripted_arm(*script: ArmState | BaseException) -> tuple[mock.Mock, Time]:
    """An arm that plays states or raises what is among them, then stays as it is; and its clock."""
    clock, states = Time(10.0, 0.0), chain(script, repeat(script[-1]))

    def state() -> ArmState:
        step = next(states)
        if isinstance(step, BaseException):
            raise step
        return replace(step, time_s=clock())

    return mock.Mock(state=state, stop=mock.Mock(side_effect=RigFault("lost", "no response"))), clock


def test_wait_until_still_waits_for_the_tip_to_rest() -> None:
    changes = {"moving": True}, {"speed_mm_s": 1.1}, {"speed_mm_s": 1.0}
    arm, clock = scripted_arm(*(replace(STILL, **change) for change in changes))
    with clock.of_all():
        assert safety.wait_until_still(arm, LIMITS).speed_mm_s == 1
    assert not arm.stop.called
    assert clock() > 10


@pytest.mark.parametrize(
    ("step", "cause"),
    [
        (replace(STILL, moving=True), "deadline"),
        (replace(STILL, speed_mm_s=1.1), "deadline"),
        (replace(STILL, protective_stop=True, moving=True), "protective_stop"),
        (RigFault("lost", "gone"), "lost"),
        (KeyboardInterrupt(), None),
    ],
)
def test_wait_until_still_stops_the_arm_before_it_raises(step: ArmState | BaseException, cause: str | None) -> None:
    arm, clock = scripted_arm(replace(STILL, moving=True), step)
    with clock.of_all(), pytest.raises(RigFault if cause else KeyboardInterrupt) as caught:
        safety.wait_until_still(arm, LIMITS)
    assert getattr(caught.value, "cause", None) == cause
    arm.stop.assert_called_once()
    assert clock() < 10 + LIMITS.deadline_s + 1


RETREAT_LIMITS = Limits.from_settings(RIG)
DEEP_MM = 46.0
"""Height of the tool 4 mm below the pad's surface."""


def arm_at(height_mm: float, force: Callable[[FakeArm], float]) -> FakeArm:
    """An arm that stands at a height and feels a force."""
    arm = FakeArm(Time(), pose=(0.0, -400.0, height_mm, 0.0, np.pi, 0.0))
    arm.hook = lambda arm: setattr(arm, "force_n", force(arm))
    return arm


def retreated(arm: FakeArm) -> FakeArm:
    with arm.time.of_all():
        safety.retreat(arm, RETREAT_LIMITS)
    return arm


def test_retreat_lifts_the_tool_slowly_off_what_it_presses() -> None:
    arm = retreated(arm_at(DEEP_MM, lambda arm: 25 * max(0.0, 50 - arm.pose[2])))
    assert arm.pose[2] == pytest.approx(50 + RETREAT_MM)
    assert arm.stops == 0
    assert arm.time() - 100 == pytest.approx((4 + RETREAT_MM) / RETREAT_MM_S, abs=0.1)
    assert retreated(arm_at(75.0, lambda arm: 0.0)).moves == []
    arm = retreated(arm_at(75.0, lambda arm: 80.0 if arm.pose[2] < 76 else 0.0))
    assert arm.pose[2] == pytest.approx(75 + RETREAT_MM)
    arm = retreated(arm_at(115.0, lambda arm: 80.0 if arm.pose[2] < 116 else 0.0))
    assert arm.pose[2] == RETREAT_LIMITS.box_mm[2][1]


@pytest.mark.parametrize(
    ("force", "max_rise_mm"),
    [
        (lambda arm: 80.0, FALL_END_S * RETREAT_MM_S / 2),
        (lambda arm: 80.0 + 20 * (arm.pose[2] - DEEP_MM), 1.0),
        (lambda arm: 80.0 if arm.pose[2] < 47 else 0.0 if arm.pose[2] < 48 else -70.0, 3.0),
        (lambda arm: 80.0 if arm.pose[2] < 47 else float("nan"), 2.0),
    ],
    ids=["stays", "rises", "comes back", "is lost"],
)
def test_retreat_stops_if_the_force_does_not_fall(force: Callable[[FakeArm], float], max_rise_mm: float) -> None:
    arm = arm_at(DEEP_MM, force)
    fault_of(partial(retreated, arm), "force")
    assert arm.stops == 1
    assert arm.pose[2] < DEEP_MM + max_rise_mm


@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_retreat_gives_a_force_time_to_fall(late_s: float) -> None:
    """It has to begin to fall after FALL_START_S, and then along a line."""
    limit_n = RETREAT_LIMITS.max_force_n or 0.0

    def force(arm: FakeArm) -> float:
        remaining = (100 + FALL_END_S + late_s - arm.time()) / (FALL_END_S - FALL_START_S)
        return limit_n + (200 - limit_n) * min(max(remaining, 0.0), 1.0)

    check_end(arm_at(DEEP_MM, force), is_allowed=not late_s)


def check_end(arm: FakeArm, is_allowed: bool) -> None:
    with contextlib.nullcontext() if is_allowed else pytest.raises(RigFault, match="the force does not fall"):
        assert retreated(arm).pose[2] == pytest.approx(50 + RETREAT_MM)
    assert arm.stops == (not is_allowed)


@pytest.mark.parametrize("fault", ["protective_stop", "emergency_stop", "lost", "pose"])
def test_retreat_does_not_move_a_stopped_lost_or_misplaced_arm(fault: str) -> None:
    arm = arm_at(DEEP_MM, lambda arm: 80.0)
    setattr(arm, fault, (102.0, *arm.pose[1:]) if fault == "pose" else True)
    with pytest.raises(RigFault, match="x 102 mm" if fault == "pose" else ".") as caught:
        retreated(arm)
    assert fault in (caught.value.cause, "pose")
    assert arm.moves == []


@pytest.mark.parametrize(
    ("x", "y", "z"),
    [(0.0, -400.0, 42.0), *((x, y, DEEP_MM) for x, y in ((100.4, -400), (-100.4, -400), (0, -299.6), (0, -500.4)))],
)
def test_retreat_lifts_a_tool_too_deep_or_at_the_edge_of_the_box(x: float, y: float, z: float) -> None:
    """Arms stop near their target: half of those at the edge stand beyond it."""
    arm = arm_at(z, lambda arm: 0.0)
    arm.pose = (x, y, *arm.pose[2:])
    assert retreated(arm).pose[:3] == (x, y, pytest.approx(50 + RETREAT_MM))


@pytest.mark.parametrize(("more_n", "is_allowed"), [(0.9 * MAX_RISE_N, True), (1.2 * MAX_RISE_N, False)])
def test_retreat_allows_a_force_the_error_of_its_sensor(more_n: float, is_allowed: bool) -> None:
    """The force reads more than at first as the tool begins to move, and none from 2 mm on."""
    check_end(
        arm_at(DEEP_MM, lambda arm: 80.0 + more_n * (arm.pose[2] > DEEP_MM) if arm.pose[2] < DEEP_MM + 2 else 0.0),
        is_allowed,
    )
