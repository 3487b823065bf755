"""The arm behind the real ur-rtde: what it does, and that it rests after a fault."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig.arms import rtde, ur5
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.devices import ArmState, Pose, RigFault
from padforge.sense.rig.doctor import examine_arm
from padforge.sense.rig.safety import Limits, wait_until_still
from padforge.sense.settings import RigSettings
from tests.emulators.ur5 import HOME, INPUTS, SCRIPT_PORT, EmulatedUR5, pack_frame

BOTH = pytest.mark.parametrize("series", ["cb3", pytest.param("e", marks=pytest.mark.slow)], scope="module")
LIMITS = Limits(
    box_mm=((-300, 0), (-600, -200), (0, 400)), contact_mm=100, max_depth_mm=80, max_force_n=None, deadline_s=10
)
FORCE_LIMITS = replace(LIMITS, max_force_n=50.0)
LOW: Pose = (*HOME[:2], 40.0, *HOME[3:])
REST_S = 0.5
LONGEST_CALL_S = 5.0


def go(arm: UR5, pose: Pose, speed_mm_s: float = 1000) -> ArmState:
    arm.move(pose, speed_mm_s, 20 * speed_mm_s)
    return wait_until_still(arm, LIMITS)


def start_slow_move(arm: UR5) -> None:
    """Start a slow move down and let it go on for a moment."""
    if arm.state().pose[2] < 120:
        go(arm, HOME)
    arm.move(LOW, 50, 500)
    end = time.monotonic() + 0.15
    while time.monotonic() < end:
        assert arm.state().moving
        time.sleep(0.005)


def last_motion_s(robot: EmulatedUR5) -> float:
    """Return when the arm last moved in truth."""
    rows = robot.pose_log.rows()
    return float(rows[1 + np.flatnonzero(np.diff(rows[:, 1:7], axis=0).any(axis=1))[-1], 0])


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Check that the body takes no longer."""
    start_s = time.monotonic()
    try:
        yield
    finally:
        assert time.monotonic() - start_s < seconds


def fault_of(call: Callable[..., object], *arguments: object, seconds: float = LONGEST_CALL_S) -> str:
    """Return the cause of the fault that a call raises, soon and with one line of text."""
    with pytest.raises(RigFault) as caught, within(seconds):
        call(*arguments)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    return caught.value.cause


@BOTH
def test_move_arrives_and_hardly_a_state_is_skipped(robot: EmulatedUR5, arm: UR5) -> None:
    go(arm, HOME)
    arm.drain()
    places = np.random.default_rng(3).uniform((-150, -460, 150), (-90, -400, 210), (4, 3))
    pieces = []
    for x, y, z in places.tolist():
        state = go(arm, (x, y, z, *HOME[3:]), 400)
        pieces.append(arm.drain())
        np.testing.assert_allclose(state.pose[:3], (x, y, z), atol=0.1)
        np.testing.assert_allclose(robot.true_poses(time.monotonic())[0, :3], (x, y, z), atol=0.1)
    rows = np.vstack(pieces)
    assert rows.shape[1] == len(STATE_COLUMNS)
    period = float(np.median(np.diff(rows[:, 0])))
    gaps = np.diff(rows[:, 0]) / period  # ur-rtde drops states that a busy computer has no time for
    assert gaps.min() > 0.5
    assert gaps.mean() < 1.1
    assert np.abs(robot.true_poses(rows[:, 0])[:, :3] - rows[:, 1:4]).max() < 400 * 0.003
    assert rows[:, 7].max() == pytest.approx(400, rel=0.5)
    assert (rows[:, 9] == 1).all()


@BOTH
def test_connect_reports_identity(robot: EmulatedUR5, arm: UR5) -> None:
    about = arm.connect()
    assert about["rate_hz"] in (125, 500)
    assert about["model"] == "UR5"
    assert about["polyscope"].startswith("3.15" if about["rate_hz"] == 125 else "5.12")
    assert about["tcp"] == [0] * 6
    assert (arm.state().force_n is None) == (about["rate_hz"] == 125)
    for _ in range(2):
        with within(LONGEST_CALL_S):
            arm.close()
    assert fault_of(arm.state) == "lost"
    assert fault_of(arm.drain) == "lost"


@BOTH
def test_stop_ends_move_within_half_a_second(robot: EmulatedUR5, arm: UR5) -> None:
    start_slow_move(arm)
    for pose, speed in ((HOME, 10), ((*HOME[:5], float("inf")), 10), (HOME, -1)):  # one at a time, and none impossible
        assert fault_of(arm.move, pose, speed, 10) == "refused"
    assert arm.state().moving
    start_s = time.monotonic()
    for _ in range(2):
        with within(REST_S):
            arm.stop()
    assert last_motion_s(robot) < start_s + REST_S
    assert not arm.state().moving
    assert arm.state().speed_mm_s == 0


def refused_until_cured(arm: UR5, spoil: Callable[[], object], cause: str, cure: Callable[[], object]) -> None:
    spoil()
    try:
        assert fault_of(arm.connect, seconds=1.5) == cause
    finally:  # others use the arm, too
        cure()


def test_connect_refuses_unavailable_arm(robots: Any, host: str) -> None:
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


@pytest.mark.slow
def test_connect_refuses_silent_arm_in_time(robot: EmulatedUR5, host: str, monkeypatch) -> None:
    with closing(UR5(host)) as arm:
        refused_until_cured(arm, lambda: robot.refuse(True), "refused", lambda: robot.refuse(False))
        refused_until_cured(arm, lambda: robot.unplug(True), "refused", lambda: robot.unplug(False))
        monkeypatch.setattr(ur5, "CONNECT_S", 1.0)
        refused_until_cured(arm, lambda: robot.slow(0.5), "deadline", lambda: robot.slow(0))
        arm.connect()


def test_connect_refuses_arm_in_use_on_this_computer(robot: EmulatedUR5, arm: UR5, address: str) -> None:
    """Nor looked over by `doctor`; the move that is under way goes on."""
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    (diagnosis,) = examine_arm(UR5(address), RigSettings())
    assert diagnosis.status == "fail"
    assert "another program on this computer uses the arm" in diagnosis.message
    assert arm.state().moving
    arm.stop()


@pytest.mark.slow
def test_connect_refuses_arm_in_use_by_another_computer(robot: EmulatedUR5, arm: UR5, address: str) -> None:
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    # by another name of its address, under which nothing on this computer has locked it
    with pytest.raises(RigFault, match="a program runs on the arm"):
        UR5(f"::ffff:{address}").connect()
    assert arm.state().moving
    assert wait_until_still(arm, LIMITS).pose == pytest.approx(LOW, abs=0.1)
    go(arm, HOME)


def test_force_is_limited_in_all_directions(robots: Any, host: str) -> None:
    robot = robots.get("e", surface_mm=100, stiffness_n_mm=2.0, tcp_mm=(0.0, 1.5, 150.0))
    with closing(UR5(host)) as arm:
        assert arm.connect()["tcp"] == [0, 1.5, 150, 0, 0, 0]
        assert go(arm, (*HOME[:2], 90.0, *HOME[3:]), 300).force_n == pytest.approx(20)
        arm.move(LOW, 10, 500)  # slowly: this arm's time does not wait for a driver that gets no processor
        assert fault_of(wait_until_still, arm, FORCE_LIMITS) == "force"
        state = arm.state()
        assert not state.moving
        assert 50 < (state.force_n or 0) < 60
        arm.move(HOME, 1000, 20_000)
        wait_until_still(arm, LIMITS)
        arm.move((HOME[0] + 80, *HOME[1:]), 10, 500)
        robot.push(60.0)
        assert fault_of(wait_until_still, arm, FORCE_LIMITS) == "force"
        state = arm.state()
        assert state.pose[0] < HOME[0] + 10
        assert (state.force_n, state.sideways_n) == (0, 60)
    robots.free()


def unlock_and_play(robot: EmulatedUR5) -> None:
    """A person unlocks the arm, and presses play as well."""
    robot.clear()
    robot.play()


def signal_worker(name: str) -> Callable[[EmulatedUR5, UR5], None]:
    def send(robot: EmulatedUR5, arm: UR5) -> None:
        assert arm._worker is not None  # noqa: SLF001
        arm._worker.process.send_signal(signal.Signals[name])  # noqa: SLF001

    return send


def upload_other_program(robot: EmulatedUR5) -> None:
    """Another computer sends a program, which replaces the one that moves the arm."""
    with socket.create_connection((robot.host, SCRIPT_PORT)) as script:
        script.sendall(b"def other():\n  while True:\n    sync()\n  end\nend\n")


FAULTS: dict[str, tuple[Callable[[EmulatedUR5, UR5], object], str, float, Callable[[EmulatedUR5], object]]] = {
    "protective stop": (lambda robot, arm: robot.protective_stop(), "protective_stop", 0.5, unlock_and_play),
    "stream frozen": (lambda robot, arm: robot.freeze(True), "stale", 1.0, lambda robot: robot.freeze(False)),
    "other program": (lambda robot, arm: upload_other_program(robot), "lost", 1.0, lambda robot: robot.stop_program()),
    "program stopped": (lambda robot, arm: robot.stop_program(), "lost", 1.0, lambda robot: None),
    "force without value": (
        *(lambda robot, arm: robot.break_force_sensor(True), "lost", 1.0),
        lambda robot: robot.break_force_sensor(False),
    ),
    "worker killed": (signal_worker("SIGKILL"), "lost stale", 1.5, lambda robot: None),
    "worker hangs": (signal_worker("SIGSTOP"), "lost stale", 1.5, lambda robot: None),
    "emergency stop": (lambda robot, arm: robot.emergency_stop(), "emergency_stop", 0.5, unlock_and_play),
    "links closed": (lambda robot, arm: robot.drop("rtde"), "lost", 3.0, lambda robot: None),
    "cable out": (lambda robot, arm: robot.unplug(True), "stale", 1.0, lambda robot: robot.unplug(False)),
    "restart": (lambda robot, arm: robot.restart(0.5), "lost", 3.0, lambda robot: time.sleep(0.3)),
    "slow": (lambda robot, arm: robot.slow(1.0), "lost", 3.0, lambda robot: robot.slow(0.0)),
}
"""What goes wrong, its cause, how soon it is raised, and the remedy."""
QUICK = ("protective stop", "stream frozen", "force without value", "program stopped", "worker killed")


@pytest.mark.parametrize(
    ("series", "name"),
    [
        *(("cb3", name) for name in QUICK),
        *(pytest.param("cb3", name, marks=pytest.mark.slow) for name in FAULTS if name not in QUICK),
        *(pytest.param("e", name, marks=pytest.mark.slow) for name in (*QUICK[:3], "links closed")),
    ],
)
def test_arm_rests_after_fault_during_move(robot: EmulatedUR5, arm: UR5, name: str) -> None:
    inject, causes, notice_s, cure = FAULTS[name]
    start_slow_move(arm)
    start_s = time.monotonic()
    inject(robot, arm)
    assert fault_of(wait_until_still, arm, LIMITS, seconds=notice_s) in causes.split()
    with suppress(RigFault), within(REST_S):  # there may be nobody to confirm it
        arm.stop()
    time.sleep(max(0.0, start_s + 0.55 - time.monotonic()))
    assert last_motion_s(robot) < start_s + REST_S
    cure(robot)
    time.sleep(0.1)
    assert last_motion_s(robot) < start_s + REST_S
    with within(LONGEST_CALL_S):
        arm.connect()
    x, y, z = arm.state().pose[:3]
    go(arm, (x, y, z + 1, *HOME[3:]))


def test_arm_rests_after_a_move_that_was_not_confirmed(robot: EmulatedUR5, arm: UR5, monkeypatch) -> None:
    go(arm, (*HOME[:2], HOME[2] - 5, *HOME[3:]))
    go(arm, HOME)
    monkeypatch.setattr(ur5, "MOVE_S", 0.0)
    start_s = time.monotonic()
    assert fault_of(arm.move, LOW, 50, 500) == "deadline"
    assert fault_of(arm.state) == "lost"
    time.sleep(max(0.0, start_s + REST_S + 0.1 - time.monotonic()))
    assert last_motion_s(robot) < start_s + REST_S


def test_program_is_ended_at_a_protective_stop_without_being_asked(robot: EmulatedUR5, arm: UR5) -> None:
    """Paused, it would go on with the old move once a person unlocks the arm and presses play."""
    start_slow_move(arm)
    n_lines, end_s = len(robot.dashboard_log), time.monotonic() + LONGEST_CALL_S
    robot.protective_stop()
    while "stop" not in robot.dashboard_log[n_lines:]:
        assert time.monotonic() < end_s
        time.sleep(0.01)
    robot.clear()
    arm.connect()


@pytest.mark.slow
def test_play_does_not_resume_old_move(robot: EmulatedUR5, arm: UR5) -> None:
    start_slow_move(arm)
    robot.refuse(True)
    robot.protective_stop()
    assert fault_of(wait_until_still, arm, LIMITS, seconds=0.5) == "protective_stop"
    assert fault_of(arm.stop, seconds=REST_S) == "lost"
    start_s = time.monotonic()
    unlock_and_play(robot)
    time.sleep(0.7)
    assert last_motion_s(robot) < start_s + REST_S
    robot.refuse(False)
    arm.connect()


PARENT = f"""
import sys, time
from padforge.sense.rig.arms.ur5 import UR5
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
def test_arm_rests_after_program_dies_or_is_suspended(robot: EmulatedUR5, arm: UR5, host: str, name: str) -> None:
    go(arm, HOME)
    arm.close()
    with subprocess.Popen([sys.executable, "-c", PARENT, host], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "moving\n"
        time.sleep(0.15)
        start_s = time.monotonic()
        program.send_signal(signal.Signals[name])
        time.sleep(0.55)
        program.kill()
    assert start_s < last_motion_s(robot) < start_s + REST_S


@pytest.mark.slow
def test_arm_rests_when_program_stops_asking(robot: EmulatedUR5, arm: UR5, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur5, "SUPERVISION_S", 0.4)
    go(arm, HOME)
    arm.move(LOW, 50, 500)
    start_s = time.monotonic()
    time.sleep(1.0)
    assert start_s + 0.4 < last_motion_s(robot) < start_s + 1.0
    assert fault_of(arm.state) == "deadline"


def test_connect_refuses_registers_that_another_client_writes(robots: Any, host: str) -> None:
    robots.free()
    robot = robots.get("cb3")
    with socket.create_connection((robot.host, rtde.RTDE_PORT)) as other, closing(UR5(host)) as arm:
        other.sendall(pack_frame(INPUTS, b"input_int_register_0"))
        assert other.recv(100)
        with pytest.raises(RigFault, match="input registers are already in use"):
            arm.connect()
