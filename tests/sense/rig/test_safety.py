"""No target beyond the limits gets through, and no wait goes on after a fault."""

import contextlib
import math
from dataclasses import replace
from itertools import chain, repeat
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.sense.rig import safety
from padforge.sense.rig.devices import ArmState, Pose, RigFault
from padforge.sense.rig.safety import Limits, Vector, require_safe, tilt_deg, wait_until_still, watch
from padforge.sense.settings import RigSettings
from tests.sense.rig.fakes import Time

LIMITS = Limits(box_mm=((-100, 100), (-500, -300), (40, 120)), contact_mm=50.0, max_depth_mm=6.0, max_force_n=40.0)
SAFE: Pose = (0.0, -400.0, 60.0, 0.0, math.pi, 0.0)
X, Y, Z, *TOOL = SAFE
REST = ArmState(10.0, SAFE, 0.0, None, False, False, moving=False)
numbers = st.floats(allow_nan=True, allow_infinity=True)
inside = st.tuples(st.floats(-100, 100), st.floats(-500, -300), st.floats(44, 120))


def refused(pose: object, speed: float = 50.0, acceleration: float = 500.0, limits: Limits = LIMITS) -> str:
    """Why a target is refused, one line."""
    with pytest.raises(RigFault) as caught:
        require_safe(pose, speed, acceleration, limits)  # pyright: ignore[reportArgumentType]
    assert caught.value.cause == "refused"
    assert "\n" not in str(caught.value)
    return str(caught.value)


def tilted(degrees: float) -> tuple[float, float, float]:
    return 0.0, math.pi - math.radians(degrees), 0.0


@given(inside, st.floats(0.1, 250), st.floats(1, 1200))
def test_targets_inside_are_safe(place: tuple[float, float, float], speed: float, acceleration: float) -> None:
    require_safe((*place, *TOOL), speed, acceleration, LIMITS)


@given(st.lists(numbers, max_size=8), numbers.filter(lambda value: not 0 < value <= 250))
def test_what_gets_through_is_within_every_limit(pose: list[float], speed: float) -> None:
    with contextlib.suppress(RigFault):
        require_safe(pose, 50, 500, LIMITS)
        assert len(pose) == 6
        assert all(low <= value <= high for value, (low, high) in zip(pose[:3], LIMITS.box_mm, strict=True))
        assert 50 - pose[2] <= 6
        assert tilt_deg(pose[3:], LIMITS.tool) <= LIMITS.max_tilt_deg
    assert "speed" in refused(SAFE, speed)


@pytest.mark.parametrize(
    ("pose", "speeds", "said"),
    [
        ((-100.1, Y, Z, *TOOL), (), "x -100.1 mm; allowed -100 to 100 mm"),
        ((100.1, Y, Z, *TOOL), (), "x 100.1 mm"),
        ((X, -500.1, Z, *TOOL), (), "y -500.1 mm; allowed -500 to -300 mm"),
        ((X, -299.9, Z, *TOOL), (), "y -299.9 mm"),
        ((X, Y, 39, *TOOL), (), "z 39 mm; allowed 40 to 120 mm"),
        ((X, Y, 120.1, *TOOL), (), "z 120.1 mm"),
        ((X, Y, 43.9, *TOOL), (), "depth 6.1 mm; allowed at most 6 mm"),
        (SAFE, (250.1,), "speed 250.1 mm/s; allowed at most 250"),
        (SAFE, (50, 1200.1), "acceleration 1200.1 mm/s²; allowed at most 1200"),
        (SAFE, (50, 0), "acceleration 0; allowed more than 0"),
        (SAFE[:5], (), "5 numbers; allowed 6"),
        ((*SAFE, 0.0), (), "7 numbers; allowed 6"),
        ((X, Y, Z, *tilted(2.01)), (), "tilted by 2.0 degrees; allowed at most 2"),
        ((X, Y, Z, 0.0, 0.0, 0.0), (), "tilted by 180.0"),
        *(((*SAFE[:k], value, *SAFE[k + 1 :]), (), "finite") for k in range(6) for value in (math.nan, -math.inf)),
    ],
)
def test_a_hair_beyond_a_limit_is_refused_by_its_name(pose: tuple, speeds: tuple, said: str) -> None:
    assert said in refused(pose, *speeds)


def test_targets_on_the_limits_are_safe_and_without_a_surface_none_is() -> None:
    for place in ((-100, Y, Z), (100, Y, Z), (X, -500, Z), (X, -300, Z), (X, Y, 44), (X, Y, 120)):
        require_safe((*place, *TOOL), 250, 1200, LIMITS)
    require_safe((X, Y, Z, *tilted(1.99)), 50, 500, LIMITS)
    assert "surface unknown" in refused(SAFE, limits=replace(LIMITS, contact_mm=None))


@pytest.mark.parametrize(
    "change",
    [
        {"box_mm": ((0, 0), (0, 1), (0, 1))},
        {"box_mm": ((0, math.nan), (0, 1), (0, 1))},
        {"max_depth_mm": 0.0},
        {"max_speed_mm_s": math.inf},
        {"max_force_n": -1.0},
        {"deadline_s": math.nan},
        {"max_tilt_deg": 91.0},
        {"max_turn_deg": 181.0},
        {"contact_mm": math.nan},
        {"tool": (0.0, 0.0, 0.0)},
        {"tool": (0.0, math.pi * 0.94, 0.0)},
    ],
)
def test_limits_that_limit_nothing_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(change)).split("_")[0]):
        replace(LIMITS, **change)  # pyright: ignore[reportArgumentType]
    for just in ({"max_tilt_deg": 0.0}, {"max_tilt_deg": 90.0}, {"tool": (0.0, math.pi * 0.95, 0.0)}):
        replace(LIMITS, **just)


def test_limits_are_those_of_the_settings() -> None:
    rig = RigSettings(box_mm=(-1, 1, -2, 2, 0, 90), contact_mm=30, travel_mm_s=80, press_mm_s=20)
    limits = Limits.of(rig.model_copy(update={"max_depth_mm": 4.5, "acceleration_mm_s2": 700, "max_force_n": 33}))
    assert (limits.box_mm, limits.contact_mm, limits.max_speed_mm_s) == (((-1, 1), (-2, 2), (0, 90)), 30, 80)
    assert (limits.max_depth_mm, limits.max_acceleration_mm_s2, limits.max_force_n) == (4.5, 700, 33)
    for change in ({"box_mm": None}, {"box_mm": (1, -1, -2, 2, 0, 90)}, {"tool_rad": (0, 0, 0)}):
        with pytest.raises(RigFault, match=r"\[rig\]") as caught:
            Limits.of(rig.model_copy(update=change))
        assert caught.value.cause == "refused"


@given(st.floats(-math.pi, math.pi), st.tuples(*[st.floats(-7, 7)] * 3), st.tuples(*[st.floats(-7, 7)] * 3))
def test_tilt_is_the_angle_between_axes_that_neither_a_turn_about_them_nor_the_order_changes(
    turn: float, a: tuple[float, ...], b: tuple[float, ...]
) -> None:
    """A rotation about x by a takes the z axis to (0, -sin a, cos a); one about y to (sin b, 0, cos b)."""
    down = (math.pi * math.cos(turn), math.pi * math.sin(turn), 0.0)
    assert tilt_deg(down, LIMITS.tool) == pytest.approx(0, abs=1e-6)
    assert 0 <= tilt_deg(a, b) <= 180
    assert tilt_deg(a, b) == pytest.approx(tilt_deg(b, a), abs=1e-9)
    for x, y in ((0.3, 0.4), (2.0, -1.0), (math.pi, 3.0)):
        cosine = math.cos(x) * math.cos(y)
        assert tilt_deg((x, 0, 0), (0, y, 0)) == pytest.approx(math.degrees(math.acos(cosine)))
    third = (2 * math.pi / 3 / math.sqrt(3),) * 3  # a third of a turn about the diagonal takes z to x
    assert tilt_deg(third, (0, math.pi / 2, 0)) == pytest.approx(0, abs=1e-9)
    assert tilt_deg(third, (0, 0, 0)) == pytest.approx(90)


def down(turn: float) -> tuple[float, float, float]:
    """A tool that points down, turned about its axis."""
    return -math.pi * math.sin(turn / 2), math.pi * math.cos(turn / 2), 0.0


@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_a_turn_is_the_angle_about_the_axis(a: float, b: float) -> None:
    apart = abs(math.remainder(a - b, 2 * math.pi))
    assert safety.turn_deg(down(a), down(b)) == pytest.approx(math.degrees(apart), abs=1e-4)
    assert safety.turn_deg((0.0, math.pi - 0.03, 0.0), LIMITS.tool) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("degrees", "refuses"), [(44.9, False), (45.1, True), (-44.9, False), (-170.0, True)])
def test_the_first_move_turns_the_wrist_by_so_much_at_most(degrees: float, refuses: bool) -> None:
    state = replace(REST, force_n=0.0, pose=(*SAFE[:3], *down(math.radians(degrees))))
    with pytest.raises(RigFault, match="at most 45") if refuses else contextlib.nullcontext():
        safety.require_ready(state, LIMITS)


@pytest.mark.parametrize(
    ("tcp_mm", "told", "refusal"),
    [
        ((0.0, 0.0, 150.0), [0.0, 0.05, 150.09], None),
        ((0.0, 0.0, 0.0), [0.0, 0.0, 0.0], None),
        (None, [0.0, 0.0, 0.0], r"tcp_mm is unknown; allowed .* says \[0\.0, 0\.0, 0\.0\]"),
        ((0.0, 0.0, 150.0), [0.0, 0.0, 0.0], r"tcp_mm is \[0\.0, 0\.0, 150\.0\]; allowed what the controller says"),
        ((0.0, 0.0, 150.0), [0.0, 0.0, 150.11], "to 0.1 mm"),
        ((0.0, 0.0, 150.0), [math.nan] * 3, "tcp_mm"),
    ],
)
def test_the_tip_is_where_the_controller_thinks(tcp_mm: Vector | None, told: list[float], refusal: str | None) -> None:
    safety.require_tool(tcp_mm, {"model": "a printer, which has no such thing"})
    with pytest.raises(RigFault, match=refusal) if refusal else contextlib.nullcontext():
        safety.require_tool(tcp_mm, {"tcp": [*told, 0.0, 0.0, 0.0]})


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"time_s": 9.51}, None),
        ({"force_n": 39.9}, None),
        ({"force_n": -39.9}, None),
        ({"force_n": 30.0, "sideways_n": 26.0}, None),
        ({"pose": (0.0, -400.0, 44.0 - 0.29, *TOOL)}, None),
        ({"pose": (900.0, 900.0, 900.0, *TOOL)}, None),
        ({"emergency_stop": True, "protective_stop": True}, "emergency_stop"),
        ({"protective_stop": True}, "protective_stop"),
        ({"time_s": 9.49}, "stale"),
        ({"time_s": math.nan}, "stale"),
        ({"force_n": 40.1}, "force"),
        ({"force_n": -40.1}, "force"),
        ({"force_n": math.nan}, "force"),
        ({"force_n": 0.0, "sideways_n": 40.1}, "force"),
        ({"force_n": 30.0, "sideways_n": 27.0}, "force"),
        ({"force_n": 0.0, "sideways_n": math.nan}, "force"),
        ({"pose": (0.0, -400.0, 44.0 - 0.31, *TOOL)}, "refused"),
        ({"pose": (0.0, -400.0, math.nan, *TOOL)}, "refused"),
    ],
)
def test_a_move_goes_on_in_sound_states_and_ends_in_others(change: dict[str, object], cause: str | None) -> None:
    state = replace(REST, **change)  # pyright: ignore[reportArgumentType]
    with pytest.raises(RigFault) if cause else contextlib.nullcontext() as caught:
        watch(state, LIMITS, 10.0, until_s=10.0)
    if caught is not None:
        assert caught.value.cause == cause
        assert "\n" not in str(caught.value)


def test_a_force_that_nobody_watches_stops_nothing_and_a_move_takes_as_long_as_it_may() -> None:
    watch(replace(REST, force_n=1e6), replace(LIMITS, max_force_n=None), 10.0)
    safety.require_ready(REST, replace(LIMITS, max_force_n=None))
    with pytest.raises(RigFault, match='allowed "unwatched"'):
        safety.require_ready(REST, LIMITS)
    with pytest.raises(RigFault, match="30 s") as caught:
        watch(REST, LIMITS, 10.4, until_s=10.3)
    assert caught.value.cause == "deadline"


def actor(*script: ArmState | BaseException) -> tuple[mock.Mock, Time]:
    """An arm that plays states or raises what is among them, at its own pace, then stays as it is; and its clock."""
    clock, left = Time(10.0, 0.0), chain(script, repeat(script[-1]))

    def state() -> ArmState:
        what = next(left)
        if isinstance(what, BaseException):
            raise what
        return replace(what, time_s=clock())

    return mock.Mock(state=state, stop=mock.Mock(side_effect=RigFault("lost", "no answer"))), clock


def test_a_wait_ends_when_the_move_has_ended_and_the_tip_rests() -> None:
    arm, clock = actor(replace(REST, moving=True), replace(REST, speed_mm_s=1.1), replace(REST, speed_mm_s=1.0))
    assert wait_until_still(arm, LIMITS, clock, clock.sleep).speed_mm_s == 1
    assert not arm.stop.called
    assert clock() > 10


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        (replace(REST, moving=True), "deadline"),
        (replace(REST, speed_mm_s=1.1), "deadline"),
        (replace(REST, protective_stop=True, moving=True), "protective_stop"),
        (RigFault("lost", "gone"), "lost"),
        (KeyboardInterrupt(), None),
    ],
)
def test_a_wait_stops_the_arm_before_it_tells(what: ArmState | BaseException, expected: str | None) -> None:
    arm, clock = actor(replace(REST, moving=True), what)
    with pytest.raises(RigFault if expected else KeyboardInterrupt) as caught:
        wait_until_still(arm, LIMITS, clock, clock.sleep)
    assert getattr(caught.value, "cause", None) == expected
    arm.stop.assert_called_once()
    assert clock() < 10 + LIMITS.deadline_s + 1
