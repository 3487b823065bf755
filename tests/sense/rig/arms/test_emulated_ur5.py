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
