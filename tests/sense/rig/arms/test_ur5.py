"""The arm behind the real ur-rtde, against the emulated controller: what it does, and that it rests after a fault."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig.arms import ur5
from padforge.sense.rig.arms import ur5 as ur5_link
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.devices import ArmState, Pose, RigFault
from padforge.sense.rig.doctor import examine_arm
from padforge.sense.rig.safety import Limits, wait_until_still
from padforge.sense.settings import RigSettings
from padforge.sense.virtual.ur5 import HOME, UrEmulator

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rtde_control") is None, reason="ur-rtde is not here")
BOTH = pytest.mark.parametrize("series", ["cb3", pytest.param("e", marks=pytest.mark.slow)], scope="module")
LIMITS = Limits(box_mm=((-300, 0), (-600, -200), (0, 400)), contact_mm=100, max_depth_mm=80, deadline_s=10)
LOW: Pose = (*HOME[:2], 40.0, *HOME[3:])
REST_S = 0.5
LONGEST_CALL_S = 5.0
T = TypeVar("T")


def go(arm: UR5, pose: Pose, speed_mm_s: float = 1000) -> ArmState:
    arm.move(pose, speed_mm_s, 20 * speed_mm_s)
    return wait_until_still(arm, LIMITS)


def begin(arm: UR5) -> None:
    """Be a little into a slow way down."""
    if arm.state().pose[2] < 120:
        go(arm, HOME)
    arm.move(LOW, 50, 500)
    end = time.monotonic() + 0.15
    while time.monotonic() < end:
        assert arm.state().moving
        time.sleep(0.005)


def rested_s(robot: UrEmulator) -> float:
    """When the arm last moved, in truth."""
    rows = robot.truth.rows()
    return float(rows[1 + np.flatnonzero(np.diff(rows[:, 1:7], axis=0).any(axis=1))[-1], 0])


def within(seconds: float, call: Callable[..., T], *arguments: object) -> T:
    """The result of a call that may not take longer."""
    down_command = time.monotonic()
    try:
        return call(*arguments)
    finally:
        assert time.monotonic() - down_command < seconds


def fault_of(call: Callable[..., object], *arguments: object, seconds: float = LONGEST_CALL_S) -> str:
    """Cause of the fault a call ends with: soon, and with one line of text."""
    with pytest.raises(RigFault) as caught:
        within(seconds, call, *arguments)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    return caught.value.cause


@BOTH
def test_moves_arrive_and_no_state_is_missed(robot: UrEmulator, arm: UR5) -> None:
    go(arm, HOME)
    arm.drain()
    places = np.random.default_rng(3).uniform((-150, -460, 150), (-90, -400, 210), (4, 3))
    pieces = []
    for x, y, z in places.tolist():
        state = go(arm, (x, y, z, *HOME[3:]), 400)
        pieces.append(arm.drain())
        np.testing.assert_allclose(state.pose[:3], (x, y, z), atol=0.1)
        np.testing.assert_allclose(robot.pose_at(time.monotonic())[0, :3], (x, y, z), atol=0.1)
    rows = np.vstack(pieces)
    assert rows.shape[1] == len(STATE_COLUMNS)
    assert arm.skipped == 0
    period = float(np.median(np.diff(rows[:, 0])))
    np.testing.assert_allclose(np.diff(rows[:, 0]), period, rtol=0.5)
    assert np.abs(robot.pose_at(rows[:, 0])[:, :3] - rows[:, 1:4]).max() < 400 * 0.003
    assert rows[:, 7].max() == pytest.approx(400, rel=0.5)
    assert (rows[:, 9] == 1).all()


@BOTH
def test_what_the_arm_says_of_itself(robot: UrEmulator, arm: UR5) -> None:
    about = within(LONGEST_CALL_S, arm.connect)
    assert about["rate_hz"] in (125, 500)
    assert about["model"] == "UR5"
    assert about["polyscope"].startswith("3.15" if about["rate_hz"] == 125 else "5.12")
    assert about["tcp"] == [0] * 6
    assert (arm.state().force_n is None) == (about["rate_hz"] == 125)
    within(LONGEST_CALL_S, arm.close)
    within(LONGEST_CALL_S, arm.close)
    assert fault_of(arm.state) == "lost"
    assert fault_of(arm.drain) == "lost"


@BOTH
def test_stop(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    assert fault_of(arm.move, HOME, 10, 10) == "refused"  # one move at a time
    assert arm.state().moving
    down_command = time.monotonic()
    within(REST_S, arm.stop)
    within(REST_S, arm.stop)
    assert rested_s(robot) < down_command + REST_S
    assert not arm.state().moving
    assert arm.state().speed_mm_s == 0


def test_poses_that_are_none_never_reach_the_arm(robot: UrEmulator, arm: UR5) -> None:
    before = arm.state().pose
    for pose in (HOME[:5], (*HOME, 0.0), (float("nan"), *HOME[1:]), (*HOME[:5], float("inf"))):
        assert fault_of(arm.move, pose, 10, 10) == "refused"
    for speed, acceleration in ((0, 10), (-1, 10), (float("nan"), 10), (10, 0), (10, float("inf"))):
        assert fault_of(arm.move, HOME, speed, acceleration) == "refused"
    assert arm.state().pose == before


def refused_until_cured(arm: UR5, spoil: Callable[[], object], cause: str, cure: Callable[[], object]) -> None:
    spoil()
    assert fault_of(arm.connect, seconds=1.5) == cause
    cure()


def test_arms_that_cannot_be_had(robots: Any, host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    robots.free()
    with closing(UR5(host)) as arm:
        assert fault_of(arm.connect) == "refused"
        assert fault_of(arm.state) == "lost"
        arm.stop()
        robot = robots.get("e")
        refused_until_cured(arm, lambda: robot.remote_control(False), "refused", lambda: robot.remote_control(True))
        refused_until_cured(arm, robot.protective_stop, "protective_stop", robot.clear)
        refused_until_cured(arm, robot.emergency_stop, "emergency_stop", robot.clear)
        arm.connect()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RigFault, match=r"pip install 'padforge\[rig\]'"):
        UR5(host).connect()


@pytest.mark.slow
def test_arms_that_do_not_answer_are_not_waited_for(robot: UrEmulator, host: str, monkeypatch) -> None:
    with closing(UR5(host)) as arm:
        refused_until_cured(arm, lambda: robot.refuse(True), "refused", lambda: robot.refuse(False))
        refused_until_cured(arm, lambda: robot.unplug(True), "refused", lambda: robot.unplug(False))
        monkeypatch.setattr(ur5, "CONNECT_S", 1.0)
        refused_until_cured(arm, lambda: robot.slow(0.5), "deadline", lambda: robot.slow(0))
        arm.connect()


def test_an_arm_at_work_is_not_taken_over_by_a_program_on_this_computer(
    robot: UrEmulator, arm: UR5, address: str
) -> None:
    """Nor looked over by `doctor`; the move that is under way goes on."""
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    (found,) = examine_arm(UR5(address), RigSettings(), time.monotonic, time.sleep)
    assert found.status == "fail"
    assert "another program on this computer uses the arm" in found.message
    assert arm.state().moving
    arm.stop()


@pytest.mark.slow
def test_an_arm_at_work_is_not_taken_over_from_another_computer(
    robot: UrEmulator, arm: UR5, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where the child locks: as if it ran on another computer
    with pytest.raises(RigFault, match="a program runs on the arm"):
        UR5(address).connect()
    assert arm.state().moving
    assert wait_until_still(arm, LIMITS).pose == pytest.approx(LOW, abs=0.1)
    go(arm, HOME)


def test_force_from_below_and_from_the_side_is_felt_and_limited_and_the_tip_told(robots: Any, host: str) -> None:
    robot = robots.get("e", surface_mm=100, stiffness_n_mm=2.0, tcp_mm=(0.0, 1.5, 150.0))
    with closing(UR5(host)) as arm:
        assert arm.connect()["tcp"] == [0, 1.5, 150, 0, 0, 0]
        assert go(arm, (*HOME[:2], 90.0, *HOME[3:]), 300).force_n == pytest.approx(20)
        arm.move(LOW, 50, 500)
        assert fault_of(wait_until_still, arm, LIMITS) == "force"
        state = arm.state()
        assert not state.moving
        assert 50 < (state.force_n or 0) < 60
        arm.move(HOME, 1000, 20_000)
        wait_until_still(arm, replace(LIMITS, max_force_n=None))
        arm.move((HOME[0] + 80, *HOME[1:]), 40, 500)
        robot.push(60.0)
        assert fault_of(wait_until_still, arm, LIMITS) == "force"
        state = arm.state()
        assert state.pose[0] < HOME[0] + 40
        assert (state.force_n, state.sideways_n) == (0, 60)
    robots.free()


def unlock_and_play(robot: UrEmulator) -> None:
    """A person unlocks the arm, and presses play as well."""
    robot.clear()
    robot.play()


def signal_child(name: str) -> Callable[[UrEmulator, UR5], None]:
    def send(robot: UrEmulator, arm: UR5) -> None:
        assert arm.child is not None
        os.kill(arm.child, signal.Signals[name])

    return send


FAULTS: dict[str, tuple[Callable[[UrEmulator, UR5], object], str, float, Callable[[UrEmulator], object]]] = {
    "protective stop": (lambda robot, arm: robot.protective_stop(), "protective_stop", 0.5, unlock_and_play),
    "stream frozen": (lambda robot, arm: robot.freeze(True), "stale", 1.0, lambda robot: robot.freeze(False)),
    "program stopped": (lambda robot, arm: robot.halt(), "lost", 1.0, lambda robot: None),
    "child killed": (signal_child("SIGKILL"), "lost stale", 1.5, lambda robot: None),
    "child hangs": (signal_child("SIGSTOP"), "lost stale", 1.5, lambda robot: None),
    "emergency stop": (lambda robot, arm: robot.emergency_stop(), "emergency_stop", 0.5, unlock_and_play),
    "links closed": (lambda robot, arm: robot.drop("rtde"), "lost", 3.0, lambda robot: None),
    "cable out": (lambda robot, arm: robot.unplug(True), "stale", 1.0, lambda robot: robot.unplug(False)),
    "restart": (lambda robot, arm: robot.restart(0.5), "lost", 3.0, lambda robot: time.sleep(0.3)),
    "slow": (lambda robot, arm: robot.slow(1.0), "lost", 3.0, lambda robot: robot.slow(0.0)),
}
"""What goes wrong, its cause, how soon it is told, and what helps."""
QUICK = ("protective stop", "stream frozen", "program stopped", "child killed")


@pytest.mark.parametrize(
    ("series", "name"),
    [
        *(("cb3", name) for name in QUICK),
        *(pytest.param("cb3", name, marks=pytest.mark.slow) for name in FAULTS if name not in QUICK),
        *(pytest.param("e", name, marks=pytest.mark.slow) for name in (*QUICK[:2], "links closed")),
    ],
)
def test_faults_during_a_move(robot: UrEmulator, arm: UR5, name: str) -> None:
    inject, causes, notice_s, cure = FAULTS[name]
    begin(arm)
    down_command = time.monotonic()
    inject(robot, arm)
    assert fault_of(wait_until_still, arm, LIMITS, seconds=notice_s) in causes.split()
    with suppress(RigFault):  # there may be nobody to confirm it
        within(REST_S, arm.stop)
    time.sleep(max(0.0, down_command + 0.55 - time.monotonic()))
    assert rested_s(robot) < down_command + REST_S
    cure(robot)
    time.sleep(0.1)
    assert rested_s(robot) < down_command + REST_S
    within(LONGEST_CALL_S, arm.connect)
    x, y, z = arm.state().pose[:3]
    go(arm, (x, y, z + 1, *HOME[3:]))


def test_a_protective_stop_ends_a_move_for_good_though_nobody_looks(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    robot.protective_stop()
    time.sleep(0.4)
    down_command = time.monotonic()
    unlock_and_play(robot)
    time.sleep(0.2)
    assert rested_s(robot) < down_command
    arm.connect()


@pytest.mark.slow
def test_play_does_not_bring_back_an_old_move(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    robot.refuse(True)
    robot.protective_stop()
    assert fault_of(wait_until_still, arm, LIMITS, seconds=0.5) == "protective_stop"
    assert fault_of(arm.stop, seconds=REST_S) == "lost"
    down_command = time.monotonic()
    unlock_and_play(robot)
    time.sleep(0.7)
    assert rested_s(robot) < down_command + REST_S
    robot.refuse(False)
    arm.connect()


PARENT = f"""
import sys, time
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.virtual.ur5_controller import Series
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
        down_command = time.monotonic()
        program.send_signal(signal.Signals[name])
        time.sleep(0.55)
        program.kill()
    assert down_command < rested_s(robot) < down_command + REST_S


@pytest.mark.slow
def test_a_program_that_does_not_look(robot: UrEmulator, arm: UR5, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur5_link, "LOOK_S", 0.4)
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    down_command = time.monotonic()
    time.sleep(1.0)
    assert down_command + 0.4 < rested_s(robot) < down_command + 1.0
    assert fault_of(arm.state) == "deadline"


@pytest.mark.slow
def test_the_script_link_is_not_missed(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    robot.drop("script")
    arm.stop()
    assert go(arm, LOW).pose == pytest.approx(LOW)
