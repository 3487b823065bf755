"""The real arm driver against one emulated controller at a time, and how its calls and its rest are judged."""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
import pytest

from sense.rig.arms.ur5.driver import UR5
from sense.rig.devices.protocols import ArmState, Pose, RigFault
from sense.rig.emulators.ur.controller import Series
from sense.rig.emulators.ur.emulator import HOME, UrEmulator
from sense.rig.safety import Limits, wait_until_still

LIMITS = Limits(box_mm=((-300, 0), (-600, -200), (0, 400)), contact_mm=100, max_depth_mm=80, deadline_s=10)
LOW: Pose = (*HOME[:2], 40.0, *HOME[3:])
REST_S = 0.5
LONGEST_CALL_S = 5.0
FORBIDDEN = ("play", "unlock", "power", "brake", "safety")
T = TypeVar("T")


class Robots:
    """One emulator at a time, kept while the next test wants the same, and the link to it while that is whole."""

    def __init__(self, host: str) -> None:
        self.host, self.series, self.robot = host, "", None
        self.arm: UR5 | None = None

    def get(self, series: Series, **settings: Any) -> UrEmulator:
        if self.robot is None or settings or self.series != series:
            self.free()
            self.series, self.robot = series, UrEmulator(series, host=self.host, **settings).__enter__()
        return self.robot

    def connected(self, host: str) -> UR5:
        """The arm by one of its names, at rest."""
        arm = self.arm = self.arm or UR5(host)
        try:
            if arm.state().moving:
                arm.stop()
        except RigFault:
            arm.connect()
        return arm

    def free(self) -> None:
        if self.arm is not None:
            self.arm.close()
            self.arm = None
        if self.robot is not None:
            asked, self.series = self.robot.asked(), ""
            self.robot.__exit__()
            self.robot = None
            assert not [line for line in asked if any(word in line for word in FORBIDDEN)]


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
    begun = time.monotonic()
    try:
        return call(*arguments)
    finally:
        assert time.monotonic() - begun < seconds


def fault_of(call: Callable[..., object], *arguments: object, seconds: float = LONGEST_CALL_S) -> str:
    """Cause of the fault a call ends with: soon, and with one line of text."""
    with pytest.raises(RigFault) as caught:
        within(seconds, call, *arguments)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    return caught.value.cause


def stop(arm: UR5) -> None:
    """Stop, which may find nobody to confirm it."""
    with suppress(RigFault):
        within(REST_S, arm.stop)
