"""An arm and a board in virtual time, on a pad of a formula: minutes of pressing take moments."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from padforge.design import Morphology
from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig import clock
from padforge.sense.rig.config import RobotFrame
from padforge.sense.rig.devices import ArmState, BoardSamples, Pose, RigFault
from padforge.sense.settings import RigSettings
from tests.emulators.finger import Finger

PAD = Morphology.straight(2)
FIBRES = 4
RIG = RigSettings.model_validate(
    {"presses": 6, "rate_hz": 100, "board_rate_hz": 1000, "readings_per_press": 40}
    | {"pad_mm": (0.0, -400.0), "contact_mm": 50.0, "box_mm": (-100, 100, -500, -300, 40, 120)}
    | {"travel_mm_s": 400, "press_mm_s": 100, "acceleration_mm_s2": 2000}
)


TERMINALS = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here"),
    pytest.mark.usefixtures("steady"),
]
"""Marks of tests through pseudo-terminals, by the clock that stands still while a thread gets no processor."""


@dataclass
class Time:
    """A clock that goes on only in `sleep`, and then by at least `least_s`: the longer, the fewer polls."""

    now: float = 100.0
    least_s: float = 0.008

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, self.least_s)

    def of_all(self) -> AbstractContextManager[None]:
        """In its body all of a rig goes by this clock."""
        return mock.patch.multiple(clock, now=self, sleep=self.sleep)


@dataclass
class FakeArm:
    """Moves straight and at once at full speed; `hook` is called with every poll and may break things."""

    time: Time
    pose: Pose = (0.0, -400.0, 100.0, 0.0, 3.141592653589793, 0.0)
    protective_stop: bool = False
    emergency_stop: bool = False
    lost: bool = False
    force_n: float | None = 0.0
    stops: int = 0
    moves: list[Pose] = field(default_factory=list)
    hook: Callable[["FakeArm"], None] = lambda arm: None
    _from: tuple[Pose, Pose, float, float] | None = None

    def connect(self) -> dict[str, str]:
        return {"model": "fake"}

    def state(self) -> ArmState:
        self.hook(self)
        if self.lost:
            raise RigFault("lost", "the arm is gone")
        self._advance()
        stopped = self.protective_stop or self.emergency_stop
        moving = self._from is not None and not stopped
        return ArmState(self.time(), self.pose, 0.0, self.force_n, self.protective_stop, self.emergency_stop, moving)

    def drain(self) -> NDArray[np.float64]:
        if self.lost:
            raise RigFault("lost", "the arm is gone")
        self._advance()
        force_n = np.nan if self.force_n is None else self.force_n
        row = [self.time(), *self.pose, 0.0, force_n, float(not self.protective_stop)]
        return np.array([row]).reshape(1, len(STATE_COLUMNS))

    def move(self, pose: Pose, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        self.moves.append(pose)
        if self.protective_stop or self.emergency_stop:
            return
        way = float(np.linalg.norm(np.subtract(pose[:3], self.pose[:3])))
        self._from = (self.pose, pose, self.time(), self.time() + way / speed_mm_s)

    def stop(self) -> None:
        self.stops += 1
        self._advance()
        self._from = None

    def close(self) -> None:
        self.stop()

    def pose_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 6) poses; the past is not kept, so that of now."""
        self._advance()
        return np.tile(self.pose, (len(times_s), 1))

    def _advance(self) -> None:
        if self._from is None or self.protective_stop or self.emergency_stop:
            return
        start, end, start_s, end_s = self._from
        share = 1.0 if end_s <= start_s else min((self.time() - start_s) / (end_s - start_s), 1.0)
        x, y, z = (np.array(start[:3]) + share * np.subtract(end[:3], start[:3])).tolist()
        self.pose = (x, y, z, *end[3:])
        if share == 1.0:
            self._from = None


def fake_pad() -> Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]:
    """Four fibres at rest from 1.8 to 2.1 V, which read up to 50 mV less for each mm of depth, the nearer the more.

    Returns the (n, 4) readings, V, with a noise of 2 mV, at (n, 2) positions and (n,) depths.
    """
    rng = np.random.default_rng(1)

    def volts(positions_mm: NDArray[np.float64], depths_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        away_mm = positions_mm[:, [1, 1, 0, 0]] - np.array([-5.6, 5.6, -5.6, 5.6])
        rest_v = np.array([1.8, 1.9, 2.0, 2.1]) + 0.002 * rng.standard_normal((len(depths_mm), FIBRES))
        return rest_v - 0.05 * np.maximum(depths_mm, 0.0)[:, None] * np.exp(-np.abs(away_mm) / 10)

    return volts


class FakeBoard:
    """Samples the pad under a fake arm; samples may be lost, and the board may stall or vanish."""

    def __init__(self, arm: FakeArm, rig: RigSettings = RIG) -> None:
        self.arm, self.rig, self.frame = arm, rig, RobotFrame.from_settings(rig)
        self.volts = fake_pad()
        self.rate_hz, self.taken_s = rig.board_rate_hz, arm.time()
        self.lose = self._unreported = 0
        self.lost = self.stalled = False

    def connect(self) -> dict[str, Any]:
        return {"rate_hz": self.rate_hz, "inputs": list(range(FIBRES)), "supply_v": 3.3}

    def read(self) -> BoardSamples:
        if self.lost:
            raise RigFault("lost", "the board is gone")
        if self.stalled and self.arm.time() - self.taken_s > 1:
            raise RigFault("stale", "the board has been silent for 1 s")
        count = 0 if self.stalled else int((self.arm.time() - self.taken_s) * self.rate_hz)
        skipped = min(self.lose, count)
        self.lose -= skipped
        self._unreported += skipped  # until the next sample arrives
        times = self.taken_s + np.arange(1 + skipped, count + 1) / self.rate_hz
        self.taken_s += count / self.rate_hz
        missing = np.zeros(len(times), np.int64)
        if len(times):
            missing[0], self._unreported = self._unreported, 0
        positions, depths = self.frame.tip(self.arm.pose_at(times))
        return BoardSamples(times, self.volts(positions, depths), missing)

    def close(self) -> None:
        pass


class FingerBoard:
    """Reads what a finger does to the pad; its identity says at what rate."""

    def __init__(self, finger: Finger, time: Time, identity: dict[str, Any]) -> None:
        self._finger, self._time, self._identity = finger, time, identity

    def connect(self) -> dict[str, Any]:
        self._began_s, self._count = self._time(), 0
        return self._identity

    def read(self) -> BoardSamples:
        rate_hz = self._identity["rate_hz"]
        count = int((self._time() - self._began_s) * rate_hz)
        times_s = self._began_s + np.arange(self._count + 1, count + 1) / rate_hz
        self._count = count
        return BoardSamples(times_s, self._finger.volts(times_s), np.zeros(len(times_s), np.int64))

    def close(self) -> None:
        """Nothing is open."""


def fault_of(action: Callable[[], object], cause: str, match: str = ".") -> float:
    """Call `action` until it raises the fault; returns how long that took by the wall's clock."""

    def repeat() -> None:
        while clock.now() < start_s + 10:
            action()
            clock.sleep(0.005)

    start_s = clock.now()
    with pytest.raises(RigFault, match=match) as caught:
        repeat()
    assert caught.value.cause == cause
    return clock.now() - start_s
