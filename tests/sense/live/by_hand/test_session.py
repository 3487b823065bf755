"""Recordings by hand, of a finger that errs as people do."""

import json
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from design.common.errors import InputError
from sense import Recording
from sense.live.by_hand import session
from sense.live.by_hand.targets import targets_of
from sense.localizer.calibration.calibration import calibrate
from sense.recordings.press_journal import read_journal
from sense.recordings.processing.press_detection import Event, Finder
from sense.rig.devices.protocols import RigFault
from sense.rig.emulators.finger import SCATTER_MM, Finger
from tests.sense.conftest import QUICK
from tests.sense.live.by_hand.hands import RIG, Hands, made

Made = Callable[..., Hands]


def targets(hand: Hands) -> np.ndarray:
    return targets_of(hand._setup)


def known(recording: Recording) -> np.ndarray:
    return recording.presses_mm[recording.known]


@pytest.fixture(scope="module")
def clumsy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Hands, Recording]:
    """A recording in which one press of five goes wrong."""
    with pytest.MonkeyPatch.context() as patch:
        hand = made(tmp_path_factory.mktemp("hand"), patch, mishaps=0.2, presses=60)
        return hand, hand.record()


def test_every_target_is_pressed_once_and_nothing_else_counts(clumsy: tuple[Hands, Recording]) -> None:
    hand, recording = clumsy
    np.testing.assert_array_equal(known(recording), targets(hand))
    strokes = hand.strokes_of(recording)
    refused = Counter(stroke.kind for stroke, counts in zip(strokes, recording.known, strict=True) if not counts)
    counted = Counter(stroke.kind for stroke, counts in zip(strokes, recording.known, strict=True) if counts)
    assert refused["short"] >= 2
    assert refused["echo"] >= 2
    assert refused["press"] <= 1
    assert counted["short"] + counted["echo"] + counted["light"] == 0
    off_mm = [
        np.linalg.norm(stroke.place_mm - place)
        for stroke, place, counts in zip(strokes, recording.presses_mm, recording.known, strict=True)
        if counts
    ]
    assert max(off_mm) < 4 * SCATTER_MM
    assert np.sqrt(np.mean(np.square(off_mm))) == pytest.approx(SCATTER_MM * np.sqrt(2), rel=0.25)
    held_s = (recording.lifted - recording.begun)[recording.known] / RIG.rate_hz
    assert held_s.min() > 0.45
    assert all(line.startswith(("counted: x ", "not counted: it ", "not counted: nothing")) for line in hand.told)
    assert hand.views[-1]["done"] == hand.views[-1]["of"] == 60


def test_presses_by_hand_are_learnt_from(clumsy: tuple[Hands, Recording]) -> None:
    hand, recording = clumsy
    _, document = calibrate(recording, QUICK)
    spread_mm = np.linalg.norm(targets(hand) - targets(hand).mean(axis=0), axis=1).mean()
    assert document["errors"][0]["mean_mm"] < 0.55 * spread_mm


class Turned(Finder):
    """Takes a slide of the finger in the eighth press for its end, the end for a touch, and so on. Once."""

    once = True

    def __init__(self, fibres: int) -> None:
        super().__init__(fibres)
        self._reading, self._turned, self._touched = 0, False, list[int]()

    def feed(self, times_s: ArrayLike, readings: ArrayLike) -> list[Event]:
        """Of one reading."""
        events = super().feed(times_s, readings)
        self._reading += 1
        self._touched += [event.reading for event in events if event.down]
        if Turned.once and len(self._touched) == 8 and self._reading == self._touched[-1] + 5:
            self._turned, Turned.once = True, False
            return [Event(False, self._reading - 1)]
        return [Event(event.down != self._turned, event.reading) for event in events]


def test_a_finder_that_lost_its_way_is_not_believed(hands: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "Finder", Turned)
    hand = hands(presses=14)
    monkeypatch.setattr(hand.finger, "said", list)  # nobody helps
    recording = hand.record()
    np.testing.assert_array_equal(known(recording), targets(hand))
    assert not Turned.once
    assert 1 <= (~recording.known).sum() <= 3
    for stroke, place, counts in zip(hand.strokes_of(recording), recording.presses_mm, recording.known, strict=True):
        assert not counts or np.linalg.norm(stroke.place_mm - place) < 4 * SCATTER_MM


def test_what_is_said_is_done(hands: Made) -> None:
    hand = hands(presses=5)
    say = {2: ["back"], 4: ["skip"]}

    def said() -> list[str]:
        return say.pop(len(hand.told), []) if hand.views and hand.views[-1]["phase"] == "wait" else []

    recording = hand.record(said=said)
    first, second, third, *rest = targets(hand).tolist()
    assert known(recording).tolist() == [first, second, *rest]  # the second again, and the third left out
    assert len(recording.presses_mm) == 5
    journal = [json.loads(line) for line in (hand.out / "journal.ndjson").read_text().splitlines()]
    assert [event["refused"] for event in journal if "refused" in event] == ["it was taken back"]
    assert third not in known(recording).tolist()
    hand.record(resume=True)  # what was skipped is asked for again
    np.testing.assert_array_equal(np.sort(known(Recording.open(hand.out)), axis=0), np.sort(targets(hand), axis=0))


def test_an_end_that_is_asked_for_keeps_what_counts(hands: Made) -> None:
    hand = hands()
    recording = hand.record(said=lambda: ["quit"] if len(hand.told) == 3 else [])
    assert len(known(recording)) == 3


@pytest.mark.parametrize("phase", ["hold", "wait"])
def test_a_recording_that_broke_off_is_gone_on_with(hands: Made, phase: str) -> None:
    hand = hands(presses=6)

    def watch(view: dict) -> None:
        if view["done"] == 3 and view["phase"] == phase:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hand.record(watch=watch)
    before = Recording.open(hand.out)
    np.testing.assert_array_equal(before.presses_mm, targets(hand)[:3])
    hand.finger.look({"phase": "settle"})
    hand.clock.now_s += 30
    recording = hand.record(resume=True)
    np.testing.assert_array_equal(known(recording), targets(hand))
    np.testing.assert_array_equal(recording.readings[: len(before.readings)], before.readings)
    assert hand.views[-1]["done"] == 6


def test_a_press_that_was_under_way_at_a_kill_is_none(hands: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is told to the journal any more: as after a kill."""
    hand = hands(presses=4)

    def watch(view: dict) -> None:
        if view["done"] == 2 and view["phase"] == "hold":
            monkeypatch.setattr(session.Recorder, "abort", lambda self, reason: None)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hand.record(watch=watch)
    assert len(read_journal(hand.out / "journal.ndjson")) == 2
    hand.finger.look({"phase": "settle"})
    hand.clock.now_s += 30
    np.testing.assert_array_equal(known(hand.record(resume=True)), targets(hand))


def test_a_full_disk_is_told(hands: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object) -> None:
        raise OSError(28, "No space left on device")

    hand = hands()

    def watch(view: dict) -> None:
        if view["done"] == 1:
            monkeypatch.setattr(session.Recorder, "sync", full)

    with pytest.raises(RigFault, match="cannot be written") as fault:
        hand.record(watch=watch)
    assert fault.value.cause == "disk"


def test_nothing_is_written_over(hands: Made) -> None:
    hand = hands(presses=1)
    hand.record()
    with pytest.raises(InputError, match="never written over"):
        hand.record()


class Resting(Finger):
    """Leaves the hand on the pad at its third press, for long."""

    def _touch(self, at_s: float) -> tuple[np.ndarray, float]:
        place, depth = super()._touch(at_s)
        if len(self.strokes) == 3 and self.strokes[2].up_s < np.inf:
            self.strokes[2].up_s = self.strokes[2].down_s + 10.0
        return place, depth


def test_a_hand_that_rests_on_the_pad_is_told_to_lift(hands: Made) -> None:
    hand = hands(finger=Resting, presses=4)
    recording = hand.record()
    np.testing.assert_array_equal(known(recording), targets(hand))
    assert [why for why in hand.told if "held for" in why and "lift after 0.6 s" in why]
    assert any(view["said"].startswith("lift; if nothing") for view in hand.views)
