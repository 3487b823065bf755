"""A pad under an emulated finger, in virtual time: minutes of pressing take a second."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sense.live.sources
from design import Contact, Morphology
from sense import Recording
from sense.live.by_hand.session import record_by_hand
from sense.rig.devices.protocols import ConverterSamples
from sense.rig.emulators.finger import Finger
from sense.rig.planning.setup import Setup
from sense.settings import RigSettings

PAD = Morphology.random(3, knots=3, seed=5)
RIG = RigSettings(presses=6, readings_per_press=16, converter_rate_hz=40.0)


class Time:
    """A clock that only goes on when someone sleeps."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += max(seconds, 0.025)


class Board:
    """A converter that reads what the finger does to the pad."""

    def __init__(self, finger: Finger, clock: Time) -> None:
        self._finger, self._clock = finger, clock
        self._began_s, self._count = 0.0, 0

    def connect(self) -> dict[str, Any]:
        self._began_s, self._count = self._clock.now_s, 0
        return {"name": "virtual", "channels": 2 * PAD.grid, "rate_hz": RIG.converter_rate_hz}

    def read(self) -> ConverterSamples:
        count = int((self._clock.now_s - self._began_s) * RIG.converter_rate_hz)
        times_s = self._began_s + np.arange(self._count + 1, count + 1) / RIG.converter_rate_hz
        self._count = count
        return ConverterSamples(times_s, self._finger.volts(times_s), np.zeros(len(times_s), np.int64))

    def close(self) -> None:
        """Nothing is open."""


class Hands:
    """Records by hand into `out`, again and again, with one finger on one pad.

    Attributes:
        told: what became of presses, in order. views: all that was shown.
    """

    def __init__(self, out: Path, clock: Time, finger: Finger, rig: RigSettings) -> None:
        self.out, self.clock, self.finger = out, clock, finger
        self._setup = Setup(PAD, Contact(), rig, out, "test")
        self.told: list[str] = []
        self.views: list[dict[str, Any]] = []

    def record(
        self,
        resume: bool = False,
        said: Callable[[], list[str]] = list,
        watch: Callable[[dict[str, Any]], None] = lambda view: None,
    ) -> Recording:
        def show(view: dict[str, Any]) -> None:
            if view["told"] and (not self.views or self.views[-1]["told"] != view["told"]):
                self.told.append(view["told"])
            self.views.append(view)
            assert self.clock.now_s < 1000, "the recording comes to no end"
            self.finger.look(view)
            watch(view)

        board = Board(self.finger, self.clock)
        return record_by_hand(self._setup, board, show, lambda: [*said(), *self.finger.said()], resume)

    def strokes_of(self, recording: Recording) -> list[Any]:
        """The stroke of each press of a recording that was made at once."""
        zero_s = 100.0 + 1 / RIG.rate_hz
        downs = np.array([stroke.down_s - zero_s for stroke in self.finger.strokes])
        times_s = recording.times_s[recording.begun]
        return [self.finger.strokes[int(np.argmin(np.abs(downs - time_s)))] for time_s in times_s]


def made(
    folder: Path, patch: pytest.MonkeyPatch, mishaps: float = 0.0, finger: type[Finger] = Finger, **settings: Any
) -> Hands:
    """`Hands` of a finger with these mishaps and settings; nobody else sleeps meanwhile."""
    clock = Time()
    patch.setattr(sense.live.sources.time, "sleep", clock.sleep)
    rig = RIG.model_copy(update=settings)
    return Hands(folder / "hand", clock, finger(PAD, Contact(), rig, rig.converter_rate_hz, mishaps=mishaps), rig)


@pytest.fixture
def hands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Hands]:
    return partial(made, tmp_path, monkeypatch)
