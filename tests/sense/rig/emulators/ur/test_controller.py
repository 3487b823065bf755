"""The emulated controller without its sockets: how its tool moves, and what its program, watchdog and safety do."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sense.rig.arms.ur5 import rtde_frames as ur_frames
from sense.rig.emulators.ur import controller as ur_controller
from sense.rig.emulators.ur.controller import Controller, SpringySurface
from sense.rig.emulators.ur.motion import Line, Ramp

START = np.array([-0.12, -0.43, 0.2, 0.0, np.pi, 0.0])
CYCLE_S = 0.008

coordinates = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)


@settings(max_examples=30)
@given(coordinates, coordinates, coordinates, st.floats(0.001, 2), st.floats(0.01, 20))
def test_a_line_keeps_to_its_speed_and_acceleration_and_a_ramp_ends_with_its_velocity(
    start, end, after, speed, acceleration
) -> None:
    line = Line(start, end, speed, acceleration)
    poses, velocities = map(np.array, zip(*map(line.at, np.linspace(0, line.duration, 201)), strict=True))
    np.testing.assert_allclose(poses[[0, -1]], [start, end], atol=1e-9)
    part = slice(3) if (start[:3] != end[:3]).any() else slice(3, 6)
    speeds, step = np.linalg.norm(velocities[:, part], axis=1), line.duration / 200
    assert speeds.max() <= speed * (1 + 1e-9)
    if line.duration > 1e-6:
        assert np.abs(np.diff(speeds)).max() <= acceleration * step * (1 + 1e-6) + 1e-9
        assert np.linalg.norm(np.diff(poses[:, part], axis=0), axis=1).max() <= speed * step * (1 + 1e-6) + 1e-9
    time_s = float(np.linalg.norm(after - end)) / acceleration
    pose, velocity = Ramp(start, end, after, acceleration).at(time_s)
    np.testing.assert_allclose(velocity, after, atol=1e-9)
    np.testing.assert_allclose(pose, start + (end + after) / 2 * time_s, atol=1e-6)


class Client:
    """Does to a controller without sockets what ur-rtde does over them."""

    def __init__(self, surface: SpringySurface | None = None) -> None:
        self.controller, self.now = Controller("cb3", START, surface), 0.0
        self.controller.upload()
        self.until(lambda: self.ready == 1)

    @property
    def ready(self) -> float:
        return self.controller.outputs.get("output_int_register_0", 0)

    @property
    def height(self) -> float:
        return float(self.controller.motion.pose[2])

    @property
    def runs(self) -> bool:
        return self.controller.state()["runtime_state"] == ur_frames.PLAYING

    @property
    def progress(self) -> int:
        return int(self.controller.outputs["output_int_register_2"])

    def cycle(self, seconds: float = CYCLE_S) -> None:
        for _ in range(max(1, round(seconds / CYCLE_S))):
            self.now += CYCLE_S
            self.controller.tick(self.now)

    def until(self, condition: Callable[[], bool]) -> None:
        end = self.now + 60
        while not condition():
            assert self.now < end
            self.cycle()

    def send(self, command: int, *doubles: float, asynchronous: int = 0) -> None:
        values = {f"input_double_register_{i}": value for i, value in enumerate(doubles)}
        told = {"input_int_register_1": asynchronous, "input_int_register_0": command}
        self.controller.write(values | told, self.now)

    def do(self, command: int, *doubles: float, asynchronous: int = 0) -> None:
        self.send(command, *doubles, asynchronous=asynchronous)
        self.until(lambda: self.ready == 2)
        self.send(0)
        self.until(lambda: self.ready == 1)

    def move(self, height: float, asynchronous: int = 0) -> None:
        self.do(ur_controller.MOVE, *START[:2], height, *START[3:], 0.1, 1.0, asynchronous=asynchronous)


def test_moves_arrive_press_and_stop_and_the_progress_register_tells_of_asynchronous_ones() -> None:
    client = Client(SpringySurface(0.15, 2000.0))
    client.move(0.14)
    assert client.height == pytest.approx(0.14)
    assert client.controller.state()["actual_TCP_force"][2] == pytest.approx(20)
    before = client.progress
    client.move(0.19, asynchronous=1)
    client.cycle()
    during = client.progress
    client.cycle(1.0)
    assert [value >> 15 & 1 for value in (before, during, client.progress)] == [0, 1, 0]
    assert before >> 24 != during >> 24 == client.progress >> 24
    assert client.height == pytest.approx(0.19)
    client.move(0.05, asynchronous=1)
    client.cycle(0.2)
    client.do(ur_controller.STOP, 5.0)
    stopped = client.height
    client.cycle(0.5)
    assert client.height == stopped > 0.15


def test_the_watchdog_stops_an_arm_that_nobody_kicks() -> None:
    client = Client()
    client.do(ur_controller.WATCHDOG, 5.0)
    client.move(0.0, asynchronous=1)
    for _ in range(20):
        client.cycle(0.1)
        client.controller.write({"input_int_register_0": 0}, client.now)
        if client.height < 0.1:
            break
    assert client.runs
    client.cycle(0.3)
    assert not client.runs
    assert not client.controller.motion.moving


@pytest.mark.parametrize("stopped", [False, True], ids=["paused", "stopped"])
def test_a_program_that_a_protective_stop_has_paused_goes_on_when_a_person_plays_and_a_stopped_one_does_not(
    stopped: bool,
) -> None:
    client = Client()
    client.move(0.0, asynchronous=1)
    client.cycle(0.5)
    client.controller.protective_stop()
    client.controller.play()
    client.cycle(0.5)
    assert client.height > 0.14
    if stopped:
        assert client.controller.dashboard("stop") == "Stopped"
    client.controller.clear()
    client.controller.play()
    client.cycle(3.0)
    assert client.height > 0.14 if stopped else client.height == pytest.approx(0.0)
    assert client.runs is not stopped
