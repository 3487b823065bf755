"""The arm behind the real ur-rtde, against the emulated controller: what it does while nothing fails."""

import importlib.util
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sense.recordings.recorder import STATE_COLUMNS
from sense.rig.arms.ur5 import driver as ur5
from sense.rig.arms.ur5.driver import UR5
from sense.rig.devices.protocols import RigFault
from sense.rig.diagnostics import examine_arm
from sense.rig.emulators.ur.emulator import HOME, UrEmulator
from sense.rig.safety import wait_until_still
from sense.settings import RigSettings
from tests.sense.rig.arms.ur5.arms import (
    LIMITS,
    LONGEST_CALL_S,
    LOW,
    REST_S,
    Robots,
    begin,
    fault_of,
    go,
    rested_s,
    within,
)

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rtde_control") is None, reason="ur-rtde is not here")
BOTH = pytest.mark.parametrize("series", ["cb3", pytest.param("e", marks=pytest.mark.slow)], scope="module")


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
    begun = time.monotonic()
    within(REST_S, arm.stop)
    within(REST_S, arm.stop)
    assert rested_s(robot) < begun + REST_S
    assert not arm.state().moving
    assert arm.state().speed_mm_s == 0
    go(arm, HOME)


def test_poses_that_are_none_never_reach_the_arm(robot: UrEmulator, arm: UR5) -> None:
    before = arm.state().pose
    for pose in (HOME[:5], (*HOME, 0.0), (float("nan"), *HOME[1:]), (*HOME[:5], float("inf"))):
        assert fault_of(arm.move, pose, 10, 10) == "refused"
    for speed, acceleration in ((0, 10), (-1, 10), (float("nan"), 10), (10, 0), (10, float("inf"))):
        assert fault_of(arm.move, HOME, speed, acceleration) == "refused"
    assert arm.state().pose == before


def test_one_move_at_a_time(robot: UrEmulator, arm: UR5) -> None:
    begin(arm)
    assert fault_of(arm.move, HOME, 10, 10) == "refused"
    assert arm.state().moving
    arm.stop()


def refused_until_cured(arm: UR5, spoil: Callable[[], object], cause: str, cure: Callable[[], object]) -> None:
    spoil()
    assert fault_of(arm.connect, seconds=1.5) == cause
    cure()


def test_arms_that_cannot_be_had(robots: Robots, host: str) -> None:
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
    assert "another program on this computer uses the arm" in found.found
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


def test_without_ur_rtde(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RigFault, match=r"pip install 'padforge\[rig\]'"):
        UR5(host).connect()


def test_force_from_below_and_from_the_side_is_felt_and_limited_and_the_tip_told(robots: Robots, host: str) -> None:
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
