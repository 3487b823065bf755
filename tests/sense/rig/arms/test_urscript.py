"""Our URScript program on the emulated controller, without sockets and in virtual time."""

import numpy as np
import pytest

from padforge.sense.rig.arms import rtde, urscript
from padforge.sense.rig.arms.urscript import DONE, END, MOVE, REFUSED, STOP, UNDER_WAY, Retreat, write_program
from padforge.sense.virtual.ur5_controller import Controller

FIRST = 1000
HOME = np.array([-0.12, -0.43, 0.2, 0.0, np.pi, 0.0])
TCP = (0.0, 0.0015, 0.15)
RETREAT = Retreat(110.0, (-300.0, 0.0), (-600.0, -200.0), 20.0)
CYCLE_S = 0.008


class ProgramOnArm:
    """The program at work, and what a driver would send to it."""

    def __init__(self, retreat: Retreat | None = None) -> None:
        self.controller, self.cycles = Controller("cb3", HOME, tcp=TCP), 0
        self.values = [FIRST, STOP, 0, *[0.0] * 8]
        self.send()
        self.controller.upload(write_program(FIRST, 125, retreat))
        self.run(0.1)

    def send(self, **changes: int) -> None:
        """Send a package with the next heartbeat."""
        self.values[2] += 1
        self.controller.write(
            dict(zip((*urscript.INT_INPUTS, *urscript.DOUBLE_INPUTS), self.values, strict=True)), self.now
        )

    def command(self, number: int, kind: int, height: float = 0.0, speed: float = 0.05, x: float = HOME[0]) -> None:
        self.values[:2] = number, kind
        self.values[3:] = [x, HOME[1], height, *HOME[3:], speed, 0.5]
        self.run(0.1)

    def run(self, seconds: float, beating: bool = True) -> None:
        for cycle in range(round(seconds / CYCLE_S)):
            if beating and cycle % 5 == 0:
                self.send()
            self.cycles += 1
            self.controller.tick(self.now)

    @property
    def now(self) -> float:
        return self.cycles * CYCLE_S

    @property
    def height(self) -> float:
        return float(self.controller.motion.pose[2])

    @property
    def progress(self) -> int:
        return int(self.controller.outputs[f"output_int_register_{urscript.PROGRESS_REGISTER}"])

    @property
    def is_running(self) -> bool:
        return self.controller.state()["runtime_state"] == rtde.PLAYING


@pytest.fixture
def arm() -> ProgramOnArm:
    return ProgramOnArm()


def test_program_reports_tool_and_runs_while_the_heart_beats(arm: ProgramOnArm) -> None:
    assert arm.progress == 4 * FIRST + DONE
    assert [arm.controller.outputs[name] for name in urscript.TCP_OUTPUTS] == [*TCP, 0, 0, 0]
    arm.run(2.0)
    assert arm.is_running
    arm.run(0.3, beating=False)
    assert not arm.is_running
    assert not arm.controller.popups


def test_move_arrives_and_stop_interrupts(arm: ProgramOnArm) -> None:
    arm.command(FIRST + 1, MOVE, 0.15)
    assert arm.progress == 4 * (FIRST + 1) + UNDER_WAY
    arm.run(1.5)
    assert arm.progress == 4 * (FIRST + 1) + DONE
    assert arm.height == pytest.approx(0.15)
    arm.command(FIRST + 2, MOVE, 0.05)
    arm.command(FIRST + 3, STOP)
    assert arm.progress == 4 * (FIRST + 3) + DONE
    height = arm.height
    arm.run(1.0)
    assert 0.05 < arm.height == height < 0.15


def test_new_move_replaces_the_one_under_way(arm: ProgramOnArm) -> None:
    arm.command(FIRST + 1, MOVE, 0.05)
    arm.command(FIRST + 2, MOVE, 0.25)
    arm.run(3.0)
    assert arm.progress == 4 * (FIRST + 2) + DONE
    assert arm.height == pytest.approx(0.25)


@pytest.mark.parametrize("number", [0, FIRST, FIRST + 1, FIRST + 3, -5])
def test_number_that_is_not_the_next_is_no_command(arm: ProgramOnArm, number: int) -> None:
    """What is repeated, late, or from an earlier program."""
    arm.command(FIRST + 1, STOP)
    arm.command(number, MOVE, 0.05)
    arm.run(1.0)
    assert arm.progress == 4 * (FIRST + 1) + DONE
    assert arm.height == HOME[2]


def test_pose_out_of_reach_is_refused(arm: ProgramOnArm) -> None:
    arm.command(FIRST + 1, MOVE, 1.5)
    assert arm.progress == 4 * (FIRST + 1) + REFUSED
    arm.command(FIRST + 2, MOVE, 0.19)
    arm.run(1.0)
    assert arm.height == pytest.approx(0.19)


def test_silence_stops_the_arm_where_it_is(arm: ProgramOnArm) -> None:
    arm.command(FIRST + 1, MOVE, 0.0)
    height = arm.height
    arm.run(0.28, beating=False)
    stopped_at = arm.height
    assert height - 0.05 * 0.28 < stopped_at < height
    arm.run(1.0)
    assert arm.height == stopped_at
    assert not arm.is_running


@pytest.mark.parametrize(
    ("height", "x", "expected"),
    [(0.09, HOME[0], 0.11), (0.15, HOME[0], 0.15), (0.09, 0.1, 0.09)],
    ids=["in the pad", "above it", "beside the workspace"],
)
def test_silence_lifts_the_tool_off_the_pad(height: float, x: float, expected: float) -> None:
    arm = ProgramOnArm(RETREAT)
    arm.command(FIRST + 1, MOVE, height, 0.5, x)
    arm.run(2.0)
    assert arm.height == pytest.approx(height)
    arm.run(0.35, beating=False)
    if expected > height:
        assert arm.is_running
        assert height < arm.height < expected
    arm.run(1.5, beating=False)
    assert arm.height == pytest.approx(expected)
    assert arm.controller.motion.pose[0] == pytest.approx(x)
    assert not arm.is_running


def test_arm_that_was_not_moved_or_is_stopped_does_not_retreat() -> None:
    arm = ProgramOnArm(RETREAT)
    arm.controller.motion.pose[2] = 0.09  # moved there by hand
    arm.run(2.0, beating=False)
    assert (arm.height, arm.is_running) == (0.09, False)
    for stop in (Controller.protective_stop, Controller.emergency_stop, Controller.stop_program):
        arm = ProgramOnArm(RETREAT)
        arm.command(FIRST + 1, MOVE, 0.09, 0.5)
        arm.run(1.0)
        stop(arm.controller)
        arm.run(2.0, beating=False)
        assert arm.height == pytest.approx(0.09)


def test_end_of_the_driver_ends_the_program_without_retreat() -> None:
    arm = ProgramOnArm(RETREAT)
    arm.command(FIRST + 1, MOVE, 0.05, 0.1)
    arm.run(0.3)
    arm.command(FIRST + 2, END)
    height = arm.height
    arm.run(1.0, beating=False)
    assert 0.05 < arm.height == height < 0.2
    assert not arm.is_running
