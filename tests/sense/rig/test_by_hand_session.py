"""Recordings by hand, of a finger that errs as people do, in virtual time: minutes of pressing take a moment."""

import json
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

import padforge.sense.rig.streams
from padforge.design import Contact, Morphology
from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.localizer.calibration import calibrate
from padforge.sense.recording.run_directory import read_journal
from padforge.sense.rig import by_hand as session
from padforge.sense.rig.by_hand import record_by_hand, targets_of
from padforge.sense.rig.config import RigConfig
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.settings import RigSettings
from padforge.sense.signals.press_detection import PressDetector, PressEvent
from padforge.sense.virtual.virtual_hand import SCATTER_MM, Finger
from tests.sense.conftest import QUICK
from tests.sense.rig.fakes import Time

PAD = Morphology.random(3, knots=3, seed=5)
RIG = RigSettings(presses=6, readings_per_press=16, board_rate_hz=40.0)


class Board:
    """A converter that reads what the finger does to the pad."""

    def __init__(self, finger: Finger, clock: Time) -> None:
        self._finger, self._clock = finger, clock

    def connect(self) -> dict[str, Any]:
        self._began_s, self._count = self._clock(), 0
        return {"name": "virtual", "channels": 2 * PAD.grid, "rate_hz": RIG.board_rate_hz}

    def read(self) -> BoardSamples:
        count = int((self._clock() - self._began_s) * RIG.board_rate_hz)
        times_s = self._began_s + np.arange(self._count + 1, count + 1) / RIG.board_rate_hz
        self._count = count
        return BoardSamples(times_s, self._finger.volts(times_s), np.zeros(len(times_s), np.int64))

    def close(self) -> None:
        """Nothing is open."""


class Hands:
    """Records by hand, again and again, with one finger on one pad.

    Attributes:
        told: what became of presses, in order. views: all that was shown.
    """

    def __init__(self, folder: Path, finger: type[Finger] = Finger, mishaps: float = 0.0, **settings: Any) -> None:
        rig = RIG.model_copy(update=settings)
        self.out, self.clock = folder / "hand", Time(least_s=0.025)
        self.finger = finger(PAD, Contact(), rig, rig.board_rate_hz, mishaps=mishaps)
        self.setup = RigConfig(PAD, Contact(), rig, self.out, "test")
        self.targets = targets_of(self.setup)
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
            assert self.clock() < 1000, "the recording comes to no end"
            self.finger.look(view)
            watch(view)

        with pytest.MonkeyPatch.context() as patch:  # nobody else sleeps meanwhile
            patch.setattr(padforge.sense.rig.streams.time, "sleep", self.clock.sleep)
            board = Board(self.finger, self.clock)
            return record_by_hand(self.setup, board, show, lambda: [*said(), *self.finger.said()], resume)

    def strokes_of(self, recording: Recording) -> list[Any]:
        """The stroke of each press of a recording that was made at once."""
        zero_s = 100.0 + 1 / RIG.rate_hz
        downs = np.array([stroke.down_s - zero_s for stroke in self.finger.strokes])
        times_s = recording.times_s[recording.down_command]
        return [self.finger.strokes[int(np.argmin(np.abs(downs - time_s)))] for time_s in times_s]

    def broken_off(self, done: int, phase: str) -> None:
        """Record until Ctrl-C after so many presses in that phase; half a minute later nothing touches the pad."""

        def watch(view: dict) -> None:
            if (view["done"], view["phase"]) == (done, phase):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            self.record(watch=watch)
        self.finger.look({"phase": "settle"})
        self.clock.sleep(30)


@pytest.fixture
def hands(tmp_path: Path) -> Callable[..., Hands]:
    return partial(Hands, tmp_path)


def known(recording: Recording) -> np.ndarray:
    return recording.presses_mm[recording.known]


def off_from(recording: Recording, strokes: np.ndarray) -> list[float]:
    """How far off their places, mm, the strokes of those presses went that count."""
    made = zip(strokes[recording.known], known(recording), strict=True)
    return [float(np.linalg.norm(stroke.place_mm - place)) for stroke, place in made]


@pytest.fixture(scope="module")
def clumsy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Hands, Recording]:
    """A recording in which one press of five goes wrong."""
    hand = Hands(tmp_path_factory.mktemp("hand"), mishaps=0.2, presses=60)
    return hand, hand.record()


def test_every_target_is_pressed_once_and_nothing_else_counts(clumsy: tuple[Hands, Recording]) -> None:
    hand, recording = clumsy
    np.testing.assert_array_equal(known(recording), hand.targets)
    strokes = np.array(hand.strokes_of(recording))
    refused, counted = (
        Counter(stroke.kind for stroke in strokes[part]) for part in (~recording.known, recording.known)
    )
    assert refused["short"] >= 2
    assert refused["echo"] >= 2
    assert refused["press"] <= 1
    assert counted["short"] + counted["echo"] + counted["light"] == 0
    off_mm = off_from(recording, strokes)
    assert max(off_mm) < 4 * SCATTER_MM
    assert np.sqrt(np.mean(np.square(off_mm))) == pytest.approx(SCATTER_MM * np.sqrt(2), rel=0.25)
    held_s = (recording.up_command - recording.down_command)[recording.known] / RIG.rate_hz
    assert held_s.min() > 0.45
    assert all(line.startswith(("counted: x ", "not counted: it ", "not counted: nothing")) for line in hand.told)
    assert hand.views[-1]["done"] == hand.views[-1]["of"] == 60


@pytest.mark.slow
def test_presses_by_hand_are_training_recording_sha256(clumsy: tuple[Hands, Recording]) -> None:
    hand, recording = clumsy
    _, document = calibrate(recording, QUICK.model_copy(update={"members": 1, "epochs": 10}))
    spread_mm = np.linalg.norm(hand.targets - hand.targets.mean(axis=0), axis=1).mean()
    assert document["errors"][0]["mean_mm"] < 0.55 * spread_mm


class Turned(PressDetector):
    """Takes a slide of the finger in the eighth press for its end, the end for a touch, and so on. Once."""

    once = True

    def __init__(self, fibres: int) -> None:
        super().__init__(fibres)
        self._reading, self._turned, self._touched = 0, False, list[int]()

    def update(self, times_s: ArrayLike, readings: ArrayLike) -> list[PressEvent]:
        """Of one reading."""
        events = super().update(times_s, readings)
        self._reading += 1
        self._touched += [event.reading for event in events if event.down]
        if Turned.once and len(self._touched) == 8 and self._reading == self._touched[-1] + 5:
            self._turned, Turned.once = True, False
            return [PressEvent(False, self._reading - 1)]
        return [PressEvent(event.down != self._turned, event.reading) for event in events]


def test_a_finder_that_lost_its_way_is_not_believed(hands, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "PressDetector", Turned)
    hand = hands(presses=14)
    monkeypatch.setattr(hand.finger, "said", list)  # nobody helps
    recording = hand.record()
    np.testing.assert_array_equal(known(recording), hand.targets)
    assert not Turned.once
    assert 1 <= (~recording.known).sum() <= 3
    assert max(off_from(recording, np.array(hand.strokes_of(recording)))) < 4 * SCATTER_MM


def test_what_is_said_is_done(hands) -> None:
    hand = hands(presses=5)
    say = {2: ["back"], 4: ["skip"]}

    def said() -> list[str]:
        return say.pop(len(hand.told), []) if hand.views and hand.views[-1]["phase"] == "wait" else []

    recording = hand.record(said=said)
    first, second, third, *rest = hand.targets.tolist()
    assert known(recording).tolist() == [first, second, *rest]  # the second again, and the third left out
    assert len(recording.presses_mm) == 5
    journal = [json.loads(line) for line in (hand.out / "journal.ndjson").read_text().splitlines()]
    assert [event["refused"] for event in journal if "refused" in event] == ["it was taken back"]
    assert third not in known(recording).tolist()
    hand.record(resume=True)  # what was skipped is asked for again
    np.testing.assert_array_equal(np.sort(known(Recording.open(hand.out)), axis=0), np.sort(hand.targets, axis=0))


def test_an_end_that_is_asked_for_keeps_what_counts_and_nothing_is_written_over(hands) -> None:
    hand = hands()
    recording = hand.record(said=lambda: ["quit"] if len(hand.told) == 3 else [])
    assert len(known(recording)) == 3
    with pytest.raises(InputError, match="never written over"):
        hand.record()


@pytest.mark.parametrize(("phase", "killed"), [("hold", False), ("wait", False), ("hold", True)])
def test_a_recording_that_broke_off_is_gone_on_with(hands, monkeypatch, phase: str, killed: bool) -> None:
    """A press that was under way is none; after a kill nothing tells the journal of it."""
    hand = hands(presses=6)
    with monkeypatch.context() as patched:
        if killed:
            patched.setattr(session.Recorder, "abort", lambda self, reason: None)
        hand.broken_off(3, phase)
    assert len(read_journal(hand.out / "journal.ndjson")) == 3
    before = Recording.open(hand.out)
    np.testing.assert_array_equal(before.presses_mm, hand.targets[:3])
    recording = hand.record(resume=True)
    np.testing.assert_array_equal(known(recording), hand.targets)
    np.testing.assert_array_equal(recording.readings[: len(before.readings)], before.readings)
    assert hand.views[-1]["done"] == 6


def test_a_full_disk_is_told(hands, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object) -> None:
        raise OSError(28, "No space left on device")

    def watch(view: dict) -> None:
        if view["done"] == 1:
            monkeypatch.setattr(session.Recorder, "sync", full)

    with pytest.raises(RigFault, match="cannot be written") as fault:
        hands().record(watch=watch)
    assert fault.value.cause == "disk"


class Resting(Finger):
    """Leaves the hand on the pad at its third press, for long."""

    def _touch(self, at_s: float) -> tuple[np.ndarray, float]:
        place, depth = super()._touch(at_s)
        if len(self.strokes) == 3 and self.strokes[2].up_s < np.inf:
            self.strokes[2].up_s = self.strokes[2].down_s + 10.0
        return place, depth


def test_a_hand_that_rests_on_the_pad_is_told_to_lift(hands) -> None:
    hand = hands(finger=Resting, presses=4)
    recording = hand.record()
    np.testing.assert_array_equal(known(recording), hand.targets)
    assert [why for why in hand.told if "held for" in why and "lift after 0.6 s" in why]
    assert any(view["said"].startswith("lift; if nothing") for view in hand.views)
