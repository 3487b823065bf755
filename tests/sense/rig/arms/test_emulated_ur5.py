"""The emulated arm: the record of what it really did, its dashboard and program, and what it leaves behind."""

import re
import socket
from itertools import count
from typing import Any

import numpy as np
import pytest

from padforge.sense.rig.arms import rtde
from padforge.sense.rig.devices import RigFault
from tests.emulators import ur5_controller
from tests.emulators.ur5 import EmulatedUR5
from tests.emulators.ur5_controller import Controller


def test_pose_log_keeps_newest_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur5_controller, "ROWS", 64)
    log = ur5_controller.PoseLog()
    with pytest.raises(ValueError, match="before the oldest"):
        log.poses(0.0)
    for i in range(150):
        log.append(i, np.full(6, 10.0 * i), 0.0)
    np.testing.assert_allclose(log.poses([90.5, 149, 200])[:, 0], [905, 1490, 1490])
    with pytest.raises(ValueError, match="before the oldest"):
        log.poses(60.0)


def test_emulator_has_its_ports_alone_and_frees_them(address: str) -> None:
    in_use = re.escape(f"{address}: Address already in use")
    with EmulatedUR5(host=address), pytest.raises(RigFault, match=in_use) as caught, EmulatedUR5(host=address):
        pass
    assert "\n" not in str(caught.value)
    with EmulatedUR5("e", host=address) as robot:
        robot.remote_control(False)
        asked = ["PolyscopeVersion", "is in remote control", "get serial number", "running", "nonsense"]
        answers = rtde.ask_dashboard(address, asked, 1.0)
        assert answers[0].startswith("URSoftware 5.12.2.")
        assert answers[1:4] == ["false", "20185500000", "Program running: false"]
        assert answers[4].startswith("could not understand")
        assert robot.dashboard_log() == asked


def test_emulator_drops_packages_of_recipes_that_a_link_has_not_agreed_on(address: str) -> None:
    """ur-rtde sends those of its last link when it connects again."""
    with EmulatedUR5(host=address), socket.create_connection((address, rtde.RTDE_PORT), 1.0) as link:
        for payload in (b"\x0b\x00\x00\x00\x00", b"\x00"):
            link.sendall(rtde.pack_frame(rtde.DATA, payload))
        link.sendall(rtde.pack_frame(rtde.VERSION, b"\x00\x02"))
        assert link.recv(100) == rtde.pack_frame(rtde.VERSION, b"\x01")


START, CYCLE_S = np.array([-0.12, -0.43, 0.2, 0.0, np.pi, 0.0]), 0.008


@pytest.mark.parametrize("stopped", [False, True], ids=["paused", "stopped"])
def test_play_resumes_paused_program_but_not_stopped_one(stopped: bool) -> None:
    """Without sockets, and ur-rtde's orders written as it writes them."""
    controller, clock = Controller("cb3", START), count(1)

    def cycle(seconds: float) -> None:
        for _ in range(round(seconds / CYCLE_S)):
            controller.tick(next(clock) * CYCLE_S)

    controller.upload(ur5_controller.UR_RTDE_PROGRAM)
    cycle(1.0)
    pose = (*START[:2], 0.0, *START[3:], 0.1, 1.0)
    orders = {"input_int_register_1": 1, "input_int_register_0": ur5_controller.MOVE_L}
    controller.write({f"input_double_register_{i}": float(value) for i, value in enumerate(pose)} | orders, 1.0)
    cycle(0.5)
    assert controller.motion.pose[2] < START[2]
    controller.protective_stop()
    controller.play()
    cycle(0.5)
    assert controller.motion.pose[2] > 0.14
    if stopped:
        assert controller.answer_dashboard("stop") == "Stopped"
    controller.clear()
    controller.play()
    cycle(3.0)
    height = controller.motion.pose[2]
    assert height > 0.14 if stopped else height == pytest.approx(0.0)
    assert (controller.state()["runtime_state"] == rtde.PLAYING) is not stopped


class Cycles:
    """A controller that is taken from cycle to cycle, without sockets; m, s."""

    def __init__(self, **options: Any) -> None:
        self.controller, self.now = Controller("cb3", START, **options), 0.0

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / CYCLE_S)):
            self.now += CYCLE_S
            self.controller.tick(self.now)

    @property
    def height(self) -> float:
        return float(self.controller.motion.pose[2])


def moved_down(cycles: Cycles, distance: float = 0.2, speed: float = 0.1, acceleration: float = 1.0) -> None:
    end = START - np.array([0, 0, distance, 0, 0, 0])
    cycles.controller.motion.move_to(end, speed, acceleration, cycles.now)


def test_moves_are_trapezoids_and_brakes_end_at_half_the_way() -> None:
    """0.2 m at 0.1 m/s and 1 m/s²: 0.1 s to speed on 5 mm; brakes of a take v / a on v² / 2 a."""
    cycles = Cycles()
    moved_down(cycles)
    cycles.run(0.04)
    assert START[2] - cycles.height == pytest.approx(0.5 * 0.04**2)
    cycles.run(0.96)
    assert START[2] - cycles.height == pytest.approx(0.005 + 0.9 * 0.1)
    assert cycles.controller.state()["actual_TCP_speed"][2] == pytest.approx(-0.1)
    at = cycles.height
    cycles.controller.motion.brake(0.5, cycles.now)
    cycles.run(0.08)
    assert at - cycles.height == pytest.approx(0.1 * 0.08 - 0.5 * 0.5 * 0.08**2)
    assert cycles.controller.motion.velocity[2] == pytest.approx(-(0.1 - 0.5 * 0.08))
    cycles.controller.motion.brake(9.0, cycles.now)  # braking again changes nothing
    cycles.run(0.2)
    assert at - cycles.height == pytest.approx(0.1**2 / (2 * 0.5))
    assert not cycles.controller.motion.moving
    turn = Cycles()
    turn.controller.motion.move_to(
        START + np.array([0, 0, 0, 0, 0, 0.1]), 0.2, 2.0, 0.0
    )  # rad/s where nothing else moves
    turn.run(0.304)
    assert turn.controller.motion.pose[5] - START[5] == pytest.approx(0.01 + 0.2 * 0.204)


def test_interrupted_move_goes_on_from_rest_at_its_own_speed() -> None:
    cycles = Cycles()
    moved_down(cycles, speed=0.1)
    cycles.run(1.0)
    cycles.controller.motion.interrupt(2.0, cycles.now)
    cycles.run(0.5)
    rest = cycles.height
    assert START[2] - rest == pytest.approx(0.095 + 0.1**2 / 4)
    cycles.controller.motion.resume(cycles.now)
    cycles.run(0.504)
    assert rest - cycles.height == pytest.approx(0.005 + 0.404 * 0.1)
    cycles.run(2.0)
    assert START[2] - cycles.height == pytest.approx(0.2)
    cycles.controller.motion.resume(cycles.now)  # there is none any more
    assert not cycles.controller.motion.moving


def test_surface_pushes_back_as_a_spring_and_states_are_as_rtde_has_them() -> None:
    """2 N/mm: 3 mm below a surface are 6 N upwards; x is the force that a person pushes with."""
    cycles = Cycles(surface=float(START[2]) - 0.01, stiffness=2000.0, tcp=(0.0, 0.01, 0.15))
    assert cycles.controller.surface_force() == 0
    moved_down(cycles, 0.013)
    cycles.controller.sideways_n = 4.0
    cycles.run(1.0)
    state = cycles.controller.state()
    assert state["actual_TCP_force"] == pytest.approx([4, 0, 6, 0, 0, 0])
    assert state["timestamp"] == pytest.approx(1.0)
    assert (state["robot_mode"], state["runtime_state"], state["safety_status_bits"]) == (7, rtde.STOPPED, 1)
    assert state["robot_status_bits"] == 1  # powered on, no program
    cycles.controller.upload(ur5_controller.UR_RTDE_PROGRAM)
    cycles.run(0.016)
    assert cycles.controller.state()["runtime_state"] == rtde.STOPPED  # it starts 20 ms after the upload
    cycles.run(0.016)
    assert cycles.controller.state()["runtime_state"] == rtde.PLAYING
    assert cycles.controller.state()["robot_status_bits"] == 3
    assert cycles.controller.answer_dashboard("running") == "Program running: true"
    cycles.controller.write({"input_int_register_0": ur5_controller.GET_TCP}, cycles.now)
    cycles.run(0.016)
    tcp = [cycles.controller.outputs[f"output_double_register_{i}"] for i in range(6)]
    assert tcp == [0.0, 0.01, 0.15, 0.0, 0.0, 0.0]
    assert cycles.controller.outputs["output_int_register_0"] == 2  # done
    cycles.controller.write({"input_int_register_0": 0}, cycles.now)
    cycles.run(0.008)
    assert cycles.controller.outputs["output_int_register_0"] == 1  # ready
    cycles.controller.emergency_stop()
    state = cycles.controller.state()
    assert (state["robot_mode"], state["runtime_state"], state["safety_status_bits"]) == (3, rtde.STOPPED, 1 << 7)
    cycles.controller.upload(ur5_controller.UR_RTDE_PROGRAM)  # refused until it is cleared
    cycles.run(0.1)
    assert cycles.controller.state()["runtime_state"] == rtde.STOPPED
    cycles.controller.clear()
    assert cycles.controller.state()["safety_status_bits"] == 1
    cycles.controller.protective_stop()
    assert cycles.controller.state()["safety_status_bits"] == 1 << 2
    cycles.controller.restart(cycles.now)
    assert cycles.controller.state()["timestamp"] == 0
    assert "output_int_register_0" not in cycles.controller.state()


def test_watchdog_ends_the_program_a_period_after_the_last_kick() -> None:
    """At 4 Hz after 0.25 s; what kicks is a write of the command."""
    cycles = Cycles()
    cycles.controller.upload(ur5_controller.UR_RTDE_PROGRAM)
    cycles.run(0.04)
    registers = {"input_double_register_0": 4.0, "input_int_register_0": ur5_controller.WATCHDOG}
    cycles.controller.write(registers, cycles.now)
    for _ in range(3):
        cycles.run(0.2)
        cycles.controller.write({"input_int_register_0": 0}, cycles.now)
    cycles.controller.write({"input_double_register_1": 1.0}, cycles.now)
    cycles.run(0.248)
    assert cycles.controller.state()["runtime_state"] == rtde.PLAYING
    cycles.run(0.024)
    assert cycles.controller.state()["runtime_state"] == rtde.STOPPED


def test_poses_are_interpolated_between_rows() -> None:
    log = ur5_controller.PoseLog()
    for time_s, x, force_n in ((0.0, 10.0, 1.0), (2.0, 20.0, 2.0), (3.0, 0.0, 3.0)):
        log.append(time_s, [x, 1, 2, 3, 4, 5], force_n)
    np.testing.assert_allclose(log.poses([0.5, 2.5]), [[12.5, 1, 2, 3, 4, 5], [10, 1, 2, 3, 4, 5]])
    assert log.rows(2.5)[:, [0, 7]].tolist() == [[2, 2], [3, 3]]  # from the last one before it
