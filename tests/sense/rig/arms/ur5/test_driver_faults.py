"""The arm behind the real ur-rtde: every way in which a move can fail, and that the arm is at rest soon after."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from sense.rig.arms.ur5 import link as ur5_link
from sense.rig.arms.ur5.driver import UR5
from sense.rig.emulators.ur.emulator import HOME, UrEmulator
from sense.rig.safety import wait_until_still
from tests.sense.rig.arms.ur5.arms import (
    LIMITS,
    LONGEST_CALL_S,
    LOW,
    REST_S,
    begin,
    fault_of,
    go,
    rested_s,
    stop,
    within,
)

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rtde_control") is None, reason="ur-rtde is not here")


def nothing(robot: UrEmulator) -> None:
    """No cure is needed."""


def unlock_and_play(robot: UrEmulator) -> None:
    """A person unlocks the arm, and presses play as well."""
    robot.clear()
    robot.play()


FAULTS: dict[str, tuple[Callable[[UrEmulator], object], str, float, Callable[[UrEmulator], object]]] = {
    "protective stop": (UrEmulator.protective_stop, "protective_stop", 0.5, unlock_and_play),
    "emergency stop": (UrEmulator.emergency_stop, "emergency_stop", 0.5, unlock_and_play),
    "links closed": (lambda robot: robot.drop("rtde"), "lost", 3.0, nothing),
    "stream frozen": (lambda robot: robot.freeze(True), "stale", 1.0, lambda robot: robot.freeze(False)),
    "cable out": (lambda robot: robot.unplug(True), "stale", 1.0, lambda robot: robot.unplug(False)),
    "restart": (lambda robot: robot.restart(0.5), "lost", 3.0, lambda robot: time.sleep(0.3)),
    "slow": (lambda robot: robot.slow(1.0), "lost", 3.0, lambda robot: robot.slow(0.0)),
}

QUICK = ("protective stop", "stream frozen")


@pytest.mark.parametrize(
    ("series", "name"),
    [
        *(("cb3", name) for name in QUICK),
        *(pytest.param("cb3", name, marks=pytest.mark.slow) for name in FAULTS if name not in QUICK),
        *(pytest.param("e", name, marks=pytest.mark.slow) for name in (*QUICK, "links closed")),
    ],
)
def test_faults_during_a_move(robot: UrEmulator, arm: UR5, name: str) -> None:
    inject, cause, notice_s, cure = FAULTS[name]
    begin(arm)
    begun = time.monotonic()
    inject(robot)
    assert fault_of(wait_until_still, arm, LIMITS, seconds=notice_s) == cause
    stop(arm)
    time.sleep(max(0.0, begun + 0.55 - time.monotonic()))
    assert rested_s(robot) < begun + REST_S
    cure(robot)
    time.sleep(0.1)
    assert rested_s(robot) < begun + REST_S
    within(LONGEST_CALL_S, arm.connect)
    x, y, z = arm.state().pose[:3]
    go(arm, (x, y, z + 1, *HOME[3:]))


@pytest.mark.slow
def test_play_does_not_bring_back_an_old_move(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    robot.refuse(True)
    robot.protective_stop()
    assert fault_of(wait_until_still, arm, LIMITS, seconds=0.5) == "protective_stop"
    assert fault_of(arm.stop, seconds=REST_S) == "lost"
    begun = time.monotonic()
    unlock_and_play(robot)
    time.sleep(0.7)
    assert rested_s(robot) < begun + REST_S
    robot.refuse(False)
    arm.connect()


@pytest.mark.parametrize("name", ["SIGKILL", pytest.param("SIGSTOP", marks=pytest.mark.slow)])
def test_the_child_dies_or_hangs(robot: UrEmulator, arm: UR5, name: str) -> None:
    begin(arm)
    begun = time.monotonic()
    assert arm.child is not None
    os.kill(arm.child, signal.Signals[name])
    assert fault_of(wait_until_still, arm, LIMITS, seconds=1.5) in ("lost", "stale")
    time.sleep(max(0.0, begun + 0.55 - time.monotonic()))
    assert rested_s(robot) < begun + REST_S
    within(LONGEST_CALL_S, arm.connect)
    go(arm, HOME)


PARENT = f"""
import sys, time
from sense.rig.arms.ur5.driver import UR5
from sense.rig.emulators.ur.controller import Series
arm = UR5(sys.argv[1])
arm.connect()
arm.move({LOW}, 50, 500)
print("moving", flush=True)
while True:
    arm.state()
    time.sleep(0.01)
"""


@pytest.mark.parametrize(
    ("series", "name"),
    [
        ("cb3", "SIGKILL"),
        pytest.param("cb3", "SIGSTOP", marks=pytest.mark.slow),
        pytest.param("e", "SIGKILL", marks=pytest.mark.slow),
    ],
)
def test_the_program_dies_or_is_suspended(robot: UrEmulator, arm: UR5, host: str, name: str) -> None:
    go(arm, HOME)
    arm.close()
    with subprocess.Popen([sys.executable, "-c", PARENT, host], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "moving\n"
        time.sleep(0.15)
        begun = time.monotonic()
        program.send_signal(signal.Signals[name])
        time.sleep(0.55)
        program.kill()
    assert begun < rested_s(robot) < begun + REST_S


@pytest.mark.slow
def test_a_program_that_does_not_look(robot: UrEmulator, arm: UR5, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur5_link, "LOOK_S", 0.4)
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    begun = time.monotonic()
    time.sleep(1.0)
    assert begun + 0.4 < rested_s(robot) < begun + 1.0
    assert fault_of(arm.state) == "deadline"


@pytest.mark.slow
def test_the_script_link_is_not_missed(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    robot.drop("script")
    arm.stop()
    assert go(arm, LOW).pose == pytest.approx(LOW)


def test_a_person_stops_the_program(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    robot.halt()
    assert fault_of(wait_until_still, arm, LIMITS, seconds=1.0) == "lost"
    arm.connect()
    go(arm, HOME)
