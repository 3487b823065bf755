"""The emulated controller without its sockets: how its tool moves, and what its program does after a stop."""

from itertools import count

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sense.rig.arms.ur5 import rtde_frames as ur_frames
from sense.rig.emulators.ur import controller as ur_controller
from sense.rig.emulators.ur.controller import Controller
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


@pytest.mark.parametrize("stopped", [False, True], ids=["paused", "stopped"])
def test_a_program_that_a_protective_stop_has_paused_goes_on_when_a_person_plays_and_a_stopped_one_does_not(
    stopped: bool,
) -> None:
    """Without sockets, and ur-rtde's orders written as it writes them."""
    controller, clock = Controller("cb3", START), count(1)

    def cycle(seconds: float) -> None:
        for _ in range(round(seconds / CYCLE_S)):
            controller.tick(next(clock) * CYCLE_S)

    controller.upload()
    cycle(1.0)
    pose = (*START[:2], 0.0, *START[3:], 0.1, 1.0)
    orders = {"input_int_register_1": 1, "input_int_register_0": ur_controller.MOVE}
    controller.write({f"input_double_register_{i}": float(value) for i, value in enumerate(pose)} | orders, 1.0)
    cycle(0.5)
    assert controller.motion.pose[2] < START[2]
    controller.protective_stop()
    controller.play()
    cycle(0.5)
    assert controller.motion.pose[2] > 0.14
    if stopped:
        assert controller.dashboard("stop") == "Stopped"
    controller.clear()
    controller.play()
    cycle(3.0)
    height = controller.motion.pose[2]
    assert height > 0.14 if stopped else height == pytest.approx(0.0)
    assert (controller.state()["runtime_state"] == ur_frames.PLAYING) is not stopped
