"""After a fault the tool comes off what it presses, slowly, or the arm is stopped again."""

import importlib.util
import os
import threading
import time as real_time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.run_directory import Recorder
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.devices import RigFault
from padforge.sense.rig.press_loop import FALL_S, HEIGHT_MM, SPEED_MM_S, Session, retreat
from padforge.sense.rig.safety import Limits
from tests.sense.rig.fakes import RIG, FakeArm, FakeConverter, Time

LIMITS = Limits.of(RIG)
DEEP_MM = 46.0
"""Height of the tool 4 mm below the pad's surface."""


def pressed(height_mm: float, force: Callable[[FakeArm], float]) -> FakeArm:
    """An arm that stands at a height and feels a force."""
    arm = FakeArm(Time(), pose=(0.0, -400.0, height_mm, 0.0, np.pi, 0.0))
    arm.hook = lambda arm: setattr(arm, "force_n", force(arm))
    return arm


def retreated(arm: FakeArm) -> FakeArm:
    retreat(arm, LIMITS, 500, arm.time, arm.time.sleep)
    return arm


def test_a_force_that_falls_lets_the_tool_off_and_above_the_pad_it_is_lifted_off_what_it_presses() -> None:
    arm = retreated(pressed(DEEP_MM, lambda arm: 25 * max(0.0, 50 - arm.pose[2])))
    assert arm.pose[2] == pytest.approx(50 + HEIGHT_MM)
    assert arm.stops == 0
    assert arm.time() - 100 == pytest.approx((4 + HEIGHT_MM) / SPEED_MM_S, abs=0.1)
    assert retreated(pressed(75.0, lambda arm: 0.0)).moves == []
    arm = retreated(pressed(75.0, lambda arm: 80.0 if arm.pose[2] < 76 else 0.0))
    assert arm.pose[2] == pytest.approx(75 + HEIGHT_MM)
    assert retreated(pressed(115.0, lambda arm: 80.0 if arm.pose[2] < 116 else 0.0)).pose[2] == LIMITS.box_mm[2][1]


@pytest.mark.parametrize(
    ("force", "most_mm"),
    [
        (lambda arm: 80.0, FALL_S * SPEED_MM_S / 2),
        (lambda arm: 80.0 + 20 * (arm.pose[2] - DEEP_MM), 1.0),
        (lambda arm: 80.0 if arm.pose[2] < 47 else 0.0 if arm.pose[2] < 48 else -70.0, 3.0),
        (lambda arm: 80.0 if arm.pose[2] < 47 else float("nan"), 2.0),
    ],
    ids=["stays", "rises", "comes back", "is lost"],
)
def test_a_force_that_does_not_fall_stops_the_arm_again(force: Callable[[FakeArm], float], most_mm: float) -> None:
    arm = pressed(DEEP_MM, force)
    with pytest.raises(RigFault) as caught:
        retreated(arm)
    assert caught.value.cause == "force"
    assert arm.stops == 1
    assert arm.pose[2] < DEEP_MM + most_mm


@pytest.mark.parametrize("what", ["protective_stop", "emergency_stop", "lost", "pose"])
def test_an_arm_that_was_stopped_is_gone_or_stands_elsewhere_is_not_moved(what: str) -> None:
    arm = pressed(DEEP_MM, lambda arm: 80.0)
    setattr(arm, what, (102.0, *arm.pose[1:]) if what == "pose" else True)
    with pytest.raises(RigFault, match="x 102 mm" if what == "pose" else ".") as caught:
        retreated(arm)
    assert what in (caught.value.cause, "pose")
    assert arm.moves == []


@pytest.mark.parametrize(
    ("x", "y", "z"),
    [(0.0, -400.0, 42.0), *((x, y, DEEP_MM) for x, y in ((100.4, -400), (-100.4, -400), (0, -299.6), (0, -500.4)))],
)
def test_a_tool_too_deep_or_at_the_edge_of_the_box_comes_up(x: float, y: float, z: float) -> None:
    """No arm stands quite where it was sent: half of those at the edge stand beyond it."""
    arm = pressed(z, lambda arm: 0.0)
    arm.pose = (x, y, *arm.pose[2:])
    assert retreated(arm).pose[:3] == (x, y, pytest.approx(50 + HEIGHT_MM))


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("rtde_control") is None, reason="ur-rtde is not here")
@pytest.mark.parametrize("slow_s", [0.0, 1.0])
def test_too_much_force_is_seen_at_once_and_taken_off_however_slow_the_disk(
    robots: Any, host: str, tmp_path, monkeypatch: pytest.MonkeyPatch, slow_s: float
) -> None:
    """20 N/mm at 10 mm/s: a tenth of a second without a look costs 20 N, and the disk would take half a press."""
    robot = robots.get("e", pose=(0.0, -400.0, 60.0, 0.0, np.pi, 0.0), surface_mm=50, stiffness_n_mm=20.0)
    slowly = {"press_mm_s": 10.0, "clearance_mm": 2.0}
    rig = RIG.model_copy(update={"max_force_n": 20.0, "readings_per_press": 20, **slowly})
    converter = FakeConverter(FakeArm(real_time.monotonic))  # pyright: ignore[reportArgumentType]
    converter.model.volts(np.zeros((2, 2)), np.array([0.0, 5.0]))  # what takes long the first time
    arm, stopped, sync = UR5(host), threading.Event(), os.fsync
    halt = arm.stop

    def stop() -> None:
        halt()
        stopped.set()

    def slow(file: int) -> None:
        stopped.wait(slow_s)
        sync(file)

    with closing(arm):
        arm.connect()
        monkeypatch.setattr(arm, "stop", stop)
        with Recorder(tmp_path / "run", 4, {}, {}) as recorder:
            monkeypatch.setattr(os, "fsync", slow)
            session = Session(arm, converter, recorder, rig)  # pyright: ignore[reportArgumentType]
            with pytest.raises(RigFault, match=r"allowed 20 N; the tool was lifted off"):
                session.run(PressPlan(np.zeros((1, 2)), np.array([5.0])))
            monkeypatch.setattr(os, "fsync", sync)
    rows = robot.pose_log.rows()
    over = rows[rows[:, 7] > 20]
    assert over[:, 7].max() < 60
    assert over[-1, 0] - over[0, 0] < 2
    assert rows[-1, 7] == 0
    assert (rows[-3:, 1:4] == (0, -400, 60)).all()
    robots.free()
