"""Recordings by hand: their targets, their view, and sessions in virtual time with a finger that errs as people do."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import ArrayLike

from padforge.design import Contact, Morphology
from padforge.design.settings import PadSettings
from padforge.sense import Recording
from padforge.sense.recording.run_directory import read_journal
from padforge.sense.rig import by_hand
from padforge.sense.rig.by_hand import MIN_PRESSES, ROUND, SETTLE_S, UNTOUCHED, PressSequence, PressValidator
from padforge.sense.rig.config import RigConfig
from padforge.sense.settings import RigSettings
from padforge.sense.signals.press_detection import PressDetector, PressEvent
from tests.emulators.finger import SCATTER_MM, Finger
from tests.helpers.page_script import names_in_view
from tests.sense.rig.fakes import FingerBoard, Time, fault_of


def config_of(**settings: object) -> RigConfig:
    return RigConfig(Morphology.straight(4), Contact(), RigSettings(**settings), Path("out"), "test")  # type: ignore[arg-type]


def test_plan_targets_orders_uniform_ones_in_short_rounds(tmp_path: Path) -> None:
    positions = by_hand.plan_targets(config_of(presses=4 * ROUND, seed=3))
    assert np.array_equal(positions, np.rint(positions))
    ways = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    shuffled = np.random.default_rng(1).permutation(positions)
    assert ways.mean() < 0.5 * np.linalg.norm(np.diff(shuffled, axis=0), axis=1).mean()
    for first in range(0, len(positions), ROUND):
        assert (np.ptp(positions[first : first + ROUND], axis=0) > 0.6 * 45).all()
    # those of a file keep their order, and none is rounded into a keep-out
    (tmp_path / "places.csv").write_text("x_mm,y_mm\n3.25,-1\n0,2\n3.25,-1\n")
    places = by_hand.plan_targets(config_of(plan=str(tmp_path / "places.csv")))
    assert places.tolist() == [[3.25, -1], [0, 2], [3.25, -1]]
    hole = ((-4.1, -20.0), (4.1, -20.0), (4.1, 20.0), (-4.1, 20.0))
    positions = by_hand.plan_targets(replace(config_of(presses=400), pad_settings=PadSettings(keep_out_mm=(hole,))))
    assert len(positions) == 400
    assert not ((np.abs(positions) < [4.1, 20.0]).all(axis=1)).any()
    assert (positions == np.rint(positions)).mean() > 0.9


def test_pad_view_shows_where_to_press(golden) -> None:
    """A pad of 24 x 21 mm."""
    pad = Morphology.straight((2, 1), pitch_mm=(12.0, 7.0))
    view = by_hand.pad_view(pad, "hand", mirrored=True)
    golden("rig/hand_pad.json", view)
    np.testing.assert_allclose([path[0] for path in view["paths"]], pad.to_mm(pad.knots[:, 0]), atol=0.051)


HAND_PAD = Morphology.random(3, knots=3, seed=5)
HAND_RIG = RigSettings(presses=6, readings_per_press=16, board_rate_hz=40.0)
IDENTITY = {"name": "virtual", "channels": 2 * HAND_PAD.grid, "rate_hz": HAND_RIG.board_rate_hz}


class Hands:
    """Records by hand, again and again, with one finger on one pad; keeps the views, and the outcomes in order."""

    def __init__(self, folder: Path, mishaps: float = 0.0, **settings: Any) -> None:
        rig = HAND_RIG.model_copy(update=settings)
        self.out, self.clock = folder / "hand", Time(least_s=0.025)
        self.finger = Finger(HAND_PAD, Contact(), rig, rig.board_rate_hz, mishaps=mishaps)
        self.config = RigConfig(HAND_PAD, Contact(), rig, self.out, "test")
        self.targets = by_hand.plan_targets(self.config)
        self.messages: list[str] = []
        self.views: list[dict[str, Any]] = []

    def record(
        self,
        resume: bool = False,
        commands: Callable[[], list[str]] = list,
        watch: Callable[[dict[str, Any]], None] = lambda view: None,
    ) -> Recording:
        def show(view: dict[str, Any]) -> None:
            if view["message"] and (not self.views or self.views[-1]["message"] != view["message"]):
                self.messages.append(view["message"])
            self.views.append(view)
            assert self.clock() < 1000, "the recording comes to no end"
            self.finger.look(view)
            watch(view)

        with self.clock.of_all():
            board = FingerBoard(self.finger, self.clock, IDENTITY)
            return by_hand.record_by_hand(
                self.config, board, show, lambda: [*commands(), *self.finger.commands()], resume
            )

    def strokes_of(self, recording: Recording) -> list[Any]:
        """The stroke of each press of a recording that was made at once."""
        zero_s = 100.0 + 1 / HAND_RIG.rate_hz
        downs = np.array([stroke.down_s - zero_s for stroke in self.finger.strokes])
        times_s = recording.times_s[recording.down_command]
        return [self.finger.strokes[int(np.argmin(np.abs(downs - time_s)))] for time_s in times_s]


@pytest.fixture
def hands(tmp_path: Path) -> Callable[..., Hands]:
    return partial(Hands, tmp_path)


def accepted_mm(recording: Recording) -> np.ndarray:
    return recording.presses_mm[recording.has_position]


def distances_mm(recording: Recording, strokes: np.ndarray) -> list[float]:
    made = zip(strokes[recording.has_position], accepted_mm(recording), strict=True)
    return [float(np.linalg.norm(stroke.position_mm - place)) for stroke, place in made]


def test_session_accepts_every_target_once_and_rejects_mishaps(hands) -> None:
    """Three presses of ten go wrong."""
    hand = hands(mishaps=0.3, presses=40)
    recording = hand.record()
    np.testing.assert_array_equal(accepted_mm(recording), hand.targets)
    strokes = np.array(hand.strokes_of(recording))
    rejected, accepted = (
        Counter(stroke.kind for stroke in strokes[part]) for part in (~recording.has_position, recording.has_position)
    )
    assert min(rejected["short"], rejected["echo"]) >= 1
    assert rejected["press"] <= 1
    assert accepted["short"] + accepted["echo"] + accepted["light"] == 0
    error_mm = distances_mm(recording, strokes)
    assert max(error_mm) < 4 * SCATTER_MM
    assert np.sqrt(np.mean(np.square(error_mm))) == pytest.approx(SCATTER_MM * np.sqrt(2), rel=0.35)
    held_s = (recording.up_command - recording.down_command)[recording.has_position] / HAND_RIG.rate_hz
    assert held_s.min() > 0.45
    last = [{"x_mm": x, "y_mm": y} for x, y in hand.targets[-12:].tolist()]
    assert hand.views[-1]["presses"] == last
    assert names_in_view("hand.html") <= (by_hand.pad_view(HAND_PAD, "hand") | hand.views[-1]).keys()


class Inverted(PressDetector):
    """Takes a slide in the eighth press for a release, the release for a touch, and so on. Once."""

    once = True

    def __init__(self, fibres: int) -> None:
        super().__init__(fibres)
        self._reading, self._inverted, self._touched = 0, False, list[int]()

    def update(self, times_s: ArrayLike, readings: ArrayLike) -> list[PressEvent]:
        events = super().update(times_s, readings)
        self._reading += 1
        self._touched += [event.reading for event in events if event.down]
        if Inverted.once and len(self._touched) == 8 and self._reading == self._touched[-1] + 5:
            self._inverted, Inverted.once = True, False
            return [PressEvent(False, self._reading - 1)]
        return [PressEvent(event.down != self._inverted, event.reading) for event in events]


def test_session_restarts_a_confused_detector(hands, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(by_hand, "PressDetector", Inverted)
    hand = hands(presses=14)
    monkeypatch.setattr(hand.finger, "commands", list)  # nobody helps
    recording = hand.record()
    np.testing.assert_array_equal(accepted_mm(recording), hand.targets)
    assert not Inverted.once
    assert 1 <= (~recording.has_position).sum() <= 3
    assert max(distances_mm(recording, np.array(hand.strokes_of(recording)))) < 4 * SCATTER_MM


def test_session_tells_what_to_do_and_keeps_what_was_done(hands, golden, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the presses go wrong; the second that counts is taken back, and the fourth place is skipped."""
    undone, undo = Mock(), PressValidator.undo
    monkeypatch.setattr(PressValidator, "undo", lambda validator: undone(undo(validator)))
    hand = hands(presses=5, mishaps=0.5, seed=3, plan="grid")
    schedule = {2: ["back"], 3: ["skip"]}

    def commands() -> list[str]:
        view = hand.views[-1] if hand.views else {"phase": "settle", "done": 0}
        return schedule.pop(view["done"], []) if view["phase"] == "wait" else []

    recording = hand.record(commands=commands)
    undone.assert_called_once()  # others are not measured by the response of what was taken back
    shown, prompts = ["    ".join(by_hand.view_lines(view)[:3:2]) for view in hand.views], list[str]()
    prompts = [line for before, line in zip(["", *shown], shown, strict=False) if line != before]
    golden("rig/hand.txt", "\n".join([*by_hand.view_lines(hand.views[60]), "", *prompts]))
    first = {view["phase"]: view for view in reversed(hand.views)}
    shown = [first[phase] for phase in ("settle", "press", "hold", "lift", "wait", "done")]
    golden("rig/hand_views.json", [*shown, next(view for view in hand.views if view["rejected"])])
    golden("rig/hand_journal.ndjson", (hand.out / "journal.ndjson").read_text())
    source = json.loads((hand.out / "start.json").read_text())["source"]
    assert (source["kind"], source["devices"]["board"]) == ("hand", IDENTITY)
    assert source["plan"] == {"columns": ["x_mm", "y_mm"], "presses": hand.targets.tolist()}
    assert accepted_mm(recording).tolist() == np.delete(hand.targets, 3, axis=0).tolist()
    hand.record(resume=True)  # what was skipped is asked for again
    np.testing.assert_array_equal(np.sort(accepted_mm(Recording.open(hand.out)), axis=0), np.sort(hand.targets, axis=0))


def test_session_quits(hands) -> None:
    hand = hands()
    recording = hand.record(commands=lambda: ["quit"] if len(hand.messages) == 3 else [])
    assert len(accepted_mm(recording)) == 3


@pytest.mark.parametrize(("phase", "killed"), [("wait", False), ("hold", True)])
def test_session_resumes(hands, monkeypatch, phase: str, killed: bool) -> None:
    """A press that was under way is none; after a kill nothing tells the journal of it."""
    hand = hands(presses=5)

    def watch(view: dict) -> None:
        if (view["done"], view["phase"]) == (3, phase):
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        if killed:
            patched.setattr(by_hand.Recorder, "abort", lambda self, reason: None)
        with pytest.raises(KeyboardInterrupt):
            hand.record(watch=watch)
    hand.finger.look({"phase": "settle"})
    hand.clock.sleep(30)  # nothing touches the pad any more
    assert len(read_journal(hand.out / "journal.ndjson")) == 3
    before = Recording.open(hand.out)
    np.testing.assert_array_equal(before.presses_mm, hand.targets[:3])
    recording = hand.record(resume=True)
    np.testing.assert_array_equal(accepted_mm(recording), hand.targets)
    np.testing.assert_array_equal(recording.readings[: len(before.readings)], before.readings)
    assert (hand.views[-1]["done"], hand.views[-1]["total"]) == (5, 5)


def test_session_raises_a_full_disk(hands, monkeypatch: pytest.MonkeyPatch) -> None:
    def watch(view: dict) -> None:
        if view["done"] == 1:
            monkeypatch.setattr(by_hand.Recorder, "sync", Mock(side_effect=OSError(28, "No space left on device")))

    fault_of(partial(hands().record, watch=watch), "disk", "cannot be written")


BASELINE = np.array([2.0, 1.8, 1.9])
PRESS = np.array([0.1, -0.2, 0.2])


@pytest.fixture
def sequence() -> PressSequence:
    """Ready for the first press, at 100 s."""
    return PressSequence(np.array([[1.0, 2.0], [3.0, 4.0]]), 1.0, 100.0 - SETTLE_S)


def press(sequence: PressSequence, down_s: float, up_s: float) -> str:
    sequence.touch(down_s)
    return sequence.release(up_s)


@pytest.mark.parametrize(
    ("down_s", "up_s", "rejection"),
    [
        (99.9, 101.0, "it came before it was asked for"),
        (100.0, 100.7, "it was held for 0.7 s, hold it for 1.0 s"),
        (100.0, 104.1, "it was held for 4.1 s, lift after 1.0 s"),
        (100.0, 100.85, ""),
    ],
)
def test_sequence_rejects_by_time(sequence: PressSequence, down_s: float, up_s: float, rejection: str) -> None:
    assert press(sequence, down_s, up_s) == rejection
    assert sequence.target == (1.0, 2.0)
    assert sequence.phase(up_s + 0.9) == "wait"


def test_sequence_takes_back_or_skips_the_press_under_way(sequence: PressSequence) -> None:
    sequence.touch(110.0)
    assert [sequence.phase(time_s) for time_s in (110.9, 111.0)] == ["hold", "lift"]
    assert not sequence.undo(110.5)
    assert sequence.phase(110.6) == "lift"
    assert sequence.release(111.0) == "it was taken back"
    sequence.touch(120.0)
    sequence.skip(120.5)
    assert sequence.release(121.0) == "its place was skipped"
    assert sequence.target == (3.0, 4.0)
    sequence.skip(130.0)  # after the last one none is asked for
    assert press(sequence, 140.0, 141.0) == "it came before it was asked for"


def readings(early: np.ndarray, late: np.ndarray) -> np.ndarray:
    """Ten readings of the baseline, ten of the first part of a press, ten of its last, and the baseline again."""
    return np.repeat([BASELINE, BASELINE + early, BASELINE + late, BASELINE], [10, 10, 10, 1], axis=0)


def test_validator_rejects_weak_and_moved_presses_and_detects_that_nothing_touches() -> None:
    validator = PressValidator()
    for _ in range(MIN_PRESSES):
        validator.accept(np.array([PRESS, PRESS]), BASELINE)
    np.testing.assert_allclose(by_hand.press_responses(readings(PRESS, 2 * PRESS), 10, 30), [PRESS, 2 * PRESS])
    gaps = readings(PRESS, PRESS)
    gaps[12:18, 0] = np.nan
    gaps[:, 2] = np.nan
    np.testing.assert_allclose(by_hand.press_responses(gaps, 10, 30)[1], [0.1, -0.2, 0.0])
    assert np.isfinite(by_hand.press_responses(readings(PRESS, PRESS)[9:13], 1, 2)).all()  # the shortest there is
    assert validator.rejection(by_hand.press_responses(readings(PRESS, 1.3 * PRESS), 10, 30)) == ""
    assert "weaker" in validator.rejection(np.array([0.1 * PRESS, 0.1 * PRESS]))
    assert "changed" in validator.rejection(by_hand.press_responses(readings(PRESS, PRESS[::-1]), 10, 30))
    # whether nothing touches the pad
    pressed = BASELINE + PRESS
    assert not validator.is_untouched(pressed, BASELINE, held_s=5.0)
    assert validator.is_untouched(BASELINE + 0.1 * PRESS, BASELINE, held_s=2.0)
    assert not validator.is_untouched(BASELINE + 0.1 * PRESS, BASELINE, held_s=0.5)  # it may still be sinking in
    # Detected as a touch, but it began under a finger and ended at the baseline.
    assert validator.is_untouched(BASELINE + 0.2 * PRESS, pressed, held_s=0.5)
    assert not validator.is_untouched(pressed[::-1], pressed, held_s=0.5)
    # the baseline is followed as it drifts
    drift = 0.8 * UNTOUCHED * PRESS
    for step in range(1, 9):
        assert validator.is_touched(BASELINE + step * drift) is False
    assert validator.is_touched(BASELINE) is True
    validator.reset_baseline()
    assert validator.is_touched(BASELINE) is None


def test_presses_are_held_for_half_a_cycle_at_the_rate_of_the_board(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """A board of 1000 Hz gives 500 readings a second where 400 are asked for: every second sample."""
    session, board = Mock(side_effect=EOFError), Mock()  # the session is not run
    board.connect.return_value = {"name": "board", "channels": 8, "rate_hz": 1000.0}
    monkeypatch.setattr(by_hand, "HandSession", session)
    config = replace(config_of(presses=3, rate_hz=400.0, readings_per_press=40), out=tmp_path / "out")
    with pytest.raises(EOFError):
        by_hand.record_by_hand(config, board, lambda view: None, list)
    assert session.call_args.args[2] == 20 / 500
