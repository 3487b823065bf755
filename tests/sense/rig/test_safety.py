"""No target beyond the limits gets through, and no wait goes on after a fault."""

import contextlib
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sense.rig import safety
from sense.rig.devices.protocols import ArmState, Pose, RigFault
from sense.rig.safety import Limits, Vector, require_safe, tilt_deg, wait_until_still, watch
from sense.settings import RigSettings

LIMITS = Limits(box_mm=((-100, 100), (-500, -300), (40, 120)), contact_mm=50.0, max_depth_mm=6.0, max_force_n=40.0)
SAFE: Pose = (0.0, -400.0, 60.0, 0.0, math.pi, 0.0)
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


@given(inside, st.floats(0.1, 250), st.floats(1, 1200))
def test_targets_inside_are_safe(place: tuple[float, float, float], speed: float, acceleration: float) -> None:
    require_safe((*place, *SAFE[3:]), speed, acceleration, LIMITS)


@given(st.lists(numbers, max_size=8))
def test_what_gets_through_is_within_every_limit(pose: list[float]) -> None:
    with contextlib.suppress(RigFault):
        require_safe(pose, 50, 500, LIMITS)
        assert len(pose) == 6
        assert all(low <= value <= high for value, (low, high) in zip(pose[:3], LIMITS.box_mm, strict=True))
        assert 50 - pose[2] <= 6
        assert tilt_deg(pose[3:], LIMITS.tool) <= LIMITS.max_tilt_deg


@given(st.integers(0, 5), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_numbers_that_are_none(place: int, value: float) -> None:
    pose = list(SAFE)
    pose[place] = value
    assert "finite" in refused(pose)


@given(numbers.filter(lambda value: not 0 < value <= 250))
def test_speeds_that_are_none_or_too_great(speed: float) -> None:
    assert "speed" in refused(SAFE, speed)


def test_each_refusal_names_the_thing_its_value_and_what_is_allowed() -> None:
    assert "x 101 mm; allowed -100 to 100 mm" in refused((101.0, *SAFE[1:]))
    assert "z 39 mm; allowed 40 to 120 mm" in refused((0.0, -400.0, 39.0, *SAFE[3:]))
    assert "depth 7 mm; allowed at most 6 mm" in refused((0.0, -400.0, 43.0, *SAFE[3:]))
    assert "acceleration 1300 mm/s²; allowed at most 1200" in refused(SAFE, acceleration=1300)
    assert "acceleration 0; allowed more than 0" in refused(SAFE, acceleration=0)
    assert "5 numbers; allowed 6" in refused(SAFE[:5])
    assert "tilted by 3.0 degrees; allowed at most 2" in refused((*SAFE[:3], 0.0, math.pi - math.radians(3), 0.0))
    assert "tilted by 180.0" in refused((*SAFE[:3], 0.0, 0.0, 0.0))
    assert "surface unknown" in refused(SAFE, limits=replace(LIMITS, contact_mm=None))


@given(st.floats(-math.pi, math.pi))
def test_turning_the_tool_about_its_axis_is_no_tilt(turn: float) -> None:
    down = (math.pi * math.cos(turn), math.pi * math.sin(turn), 0.0)
    assert tilt_deg(down, LIMITS.tool) == pytest.approx(0, abs=1e-6)


@given(st.tuples(*[st.floats(-7, 7)] * 3), st.tuples(*[st.floats(-7, 7)] * 3))
def test_tilt_is_an_angle_that_does_not_depend_on_the_order(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    assert 0 <= tilt_deg(a, b) <= 180
    assert tilt_deg(a, b) == pytest.approx(tilt_deg(b, a), abs=1e-9)


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
    ],
)
def test_limits_that_limit_nothing(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(change)).split("_")[0]):
        replace(LIMITS, **change)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "change", [{"max_tilt_deg": 0.0}, {"max_tilt_deg": 90.0}, {"tool": (0.0, math.pi * 0.95, 0.0)}]
)
def test_limits_that_just_limit(change: dict[str, object]) -> None:
    replace(LIMITS, **change)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="tool"):
        replace(LIMITS, tool=(0.0, math.pi * 0.94, 0.0))


def test_targets_on_the_limits_are_safe_and_a_hair_beyond_are_not() -> None:
    x, y, z, *tool = SAFE
    for pose in ((-100, y, z), (100, y, z), (x, -500, z), (x, -300, z), (x, y, 44), (x, y, 120)):
        require_safe((*pose, *tool), 250, 1200, LIMITS)
    for pose in ((-100.1, y, z), (100.1, y, z), (x, -500.1, z), (x, -299.9, z), (x, y, 43.9), (x, y, 120.1)):
        refused((*pose, *tool))
    assert "speed 250.1" in refused(SAFE, 250.1)
    assert "acceleration 1200.1" in refused(SAFE, 50, 1200.1)
    require_safe((x, y, z, 0.0, math.pi - math.radians(1.99), 0.0), 50, 500, LIMITS)
    assert "tilted by 2.0" in refused((x, y, z, 0.0, math.pi - math.radians(2.01), 0.0))


def test_tilt_is_the_angle_between_the_axes_of_two_tools() -> None:
    """A rotation about x by a takes the z axis to (0, -sin a, cos a); one about y to (sin b, 0, cos b)."""
    for a, b in ((0.3, 0.4), (2.0, -1.0), (math.pi, 3.0)):
        cosine = math.cos(a) * math.cos(b)
        assert tilt_deg((a, 0, 0), (0, b, 0)) == pytest.approx(math.degrees(math.acos(cosine)))
    axis = (1 / math.sqrt(3),) * 3  # a third of a turn about the diagonal takes z to x
    third = tuple(2 * math.pi / 3 * part for part in axis)
    assert tilt_deg(third, (0, math.pi / 2, 0)) == pytest.approx(0, abs=1e-9)
    assert tilt_deg(third, (0, 0, 0)) == pytest.approx(90)


@pytest.mark.parametrize(
    "change",
    [
        {"time_s": 9.51},
        {"force_n": 39.9},
        {"force_n": -39.9},
        {"force_n": None},
        {"force_n": 30.0, "sideways_n": 26.0},
        {"pose": (0.0, -400.0, 44.0 - 0.29, *SAFE[3:])},
        {"pose": (900.0, 900.0, 900.0, *SAFE[3:])},
    ],
)
def test_states_that_let_a_move_go_on(change: dict[str, object]) -> None:
    watch(replace(REST, **change), LIMITS, 10.0, until_s=10.0)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("speed", "rests"), [(0.9, True), (1.0, True), (1.1, False)])
def test_a_tip_rests_up_to_a_millimetre_a_second(speed: float, rests: bool) -> None:
    actor = Actor(replace(REST, speed_mm_s=speed), replace(REST, protective_stop=True))
    with contextlib.nullcontext() if rests else pytest.raises(RigFault):
        actor.wait()


def test_limits_of_the_settings() -> None:
    limits = Limits.of(RigSettings(box_mm=(-1, 1, -2, 2, 0, 90), contact_mm=30, travel_mm_s=80, press_mm_s=20))
    assert (limits.box_mm, limits.contact_mm, limits.max_speed_mm_s) == (((-1, 1), (-2, 2), (0, 90)), 30, 80)
    for rig in (
        RigSettings(),
        RigSettings(box_mm=(1, -1, -2, 2, 0, 90)),
        RigSettings(box_mm=(-1, 1, -2, 2, 0, 90), tool_rad=(0, 0, 0)),
    ):
        with pytest.raises(RigFault, match=r"\[rig\]") as caught:
            Limits.of(rig)
        assert caught.value.cause == "refused"


@pytest.mark.parametrize(
    ("change", "cause"),
    [
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
        ({"pose": (0.0, -400.0, 44.0 - 0.31, *SAFE[3:])}, "refused"),
        ({"pose": (0.0, -400.0, math.nan, *SAFE[3:])}, "refused"),
    ],
)
def test_states_that_end_a_move(change: dict[str, object], cause: str) -> None:
    with pytest.raises(RigFault) as caught:
        watch(replace(REST, **change), LIMITS, 10.0)  # pyright: ignore[reportArgumentType]
    assert caught.value.cause == cause
    assert "\n" not in str(caught.value)


def test_a_force_that_nobody_watches_stops_nothing() -> None:
    watch(replace(REST, force_n=1e6), replace(LIMITS, max_force_n=None), 10.0)
    safety.require_ready(REST, replace(LIMITS, max_force_n=None))
    with pytest.raises(RigFault, match='allowed "unwatched"'):
        safety.require_ready(REST, LIMITS)


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


def test_a_move_may_take_as_long_as_it_may() -> None:
    watch(REST, LIMITS, 10.2, until_s=10.3)
    with pytest.raises(RigFault, match="30 s") as caught:
        watch(REST, LIMITS, 10.4, until_s=10.3)
    assert caught.value.cause == "deadline"


class Actor:
    """An arm that plays a list of states or raises what is in it, at its own pace; then it stays as it is."""

    def __init__(self, *script: ArmState | BaseException) -> None:
        self.script, self.now, self.stops = list(script), 10.0, 0

    def state(self) -> ArmState:
        what = self.script.pop(0) if len(self.script) > 1 else self.script[0]
        if isinstance(what, BaseException):
            raise what
        return replace(what, time_s=self.now)

    def stop(self) -> None:
        self.stops += 1
        raise RigFault("lost", "no answer")

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def wait(self) -> ArmState:
        return wait_until_still(self, LIMITS, self.clock, self.sleep)  # pyright: ignore[reportArgumentType]


def test_a_wait_ends_when_the_move_has_ended_and_the_tip_rests() -> None:
    actor = Actor(replace(REST, moving=True), replace(REST, speed_mm_s=5.0), REST)
    assert not actor.wait().moving
    assert not actor.stops
    assert actor.now > 10


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        (replace(REST, moving=True), "deadline"),
        (replace(REST, protective_stop=True, moving=True), "protective_stop"),
        (RigFault("lost", "gone"), "lost"),
    ],
)
def test_a_wait_stops_the_arm_before_it_tells(what: ArmState | RigFault, expected: str) -> None:
    actor = Actor(replace(REST, moving=True), what)
    with pytest.raises(RigFault) as caught:
        actor.wait()
    assert caught.value.cause == expected
    assert actor.stops == 1


def test_an_interrupt_stops_the_arm() -> None:
    actor = Actor(replace(REST, moving=True), KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        actor.wait()
    assert actor.stops == 1
