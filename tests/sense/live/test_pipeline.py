"""The live pipeline gives at every reading what the readings up to it give as a whole recording."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense import Recording, calibrate
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live import pipeline
from padforge.sense.live.pipeline import MAX_TRACK, RELEASE, Estimate, Live
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.signals.press_detection import PressEvent
from tests.helpers.constants import with_constants
from tests.helpers.golden import Golden, json_text
from tests.helpers.presses import changed
from tests.sense.conftest import QUICK, few_moments, first_presses
from tests.sense.live.test_messages import EVENTS

no_delays = with_constants((pipeline, {"TOUCH_DELAY_S": 0.0, "RELEASE_DELAY_S": 0.0}))
"""Scripted presses begin as they are commanded."""


class ScriptedDetector:
    """A press detector that gives the presses of a recording, some readings after they begin and end."""

    further: tuple[int, ...] = ()

    def __init__(self, recording: Recording, delays: tuple[int, int] = (2, 1)) -> None:
        events = (True, delays[0], recording.down_command), (False, delays[1], recording.up_command)
        self._events = sorted((index + late, index, down) for down, late, at in events for index in at.tolist())
        self._n_readings = 0

    def __call__(self, fibres: int) -> "ScriptedDetector":
        return self

    def update(self, times_s: np.ndarray, readings: np.ndarray) -> Iterator[PressEvent]:
        self._n_readings += len(times_s)
        while self._events and self._events[0][0] < self._n_readings:
            _, index, down = self._events.pop(0)
            yield PressEvent(down, index)


class ScriptedMonitor:
    """A fault monitor that stores its input, and detects that fibre 1 does not respond at press 5."""

    model = SimpleNamespace(dead=())

    def __init__(self) -> None:
        self.updates: list[tuple[np.ndarray, int, int]] = []
        self.failed: tuple[int, ...] = ()

    def update(self, readings: np.ndarray, down_command: int, up_command: int) -> list[FibreFault]:
        self.updates.append((readings.copy(), down_command, up_command))
        if len(self.updates) != 6:
            return []
        self.failed = (1,)
        return [FibreFault(5, 2, (1,), "no_response", 9.0)]


@pytest.fixture(scope="module")
def trained(brief: Recording) -> Callable[[str], LocalizerModel]:
    """Hardly trained localizers by their method, whose positions depend on every reading that they look at."""

    @cache
    @few_moments()
    def train(method: str) -> LocalizerModel:
        options = {"method": method, "members": 1, "hidden": 16, "epochs": 1}
        return calibrate(brief, QUICK.model_copy(update=options))[0]

    return train


@pytest.fixture(scope="module")
def hasty(trained: Callable[[str], LocalizerModel]) -> LocalizerModel:
    return trained("ensemble")


def scripted(recording: Recording, model: LocalizerModel, delays: Any = (2, 1), monitor: Any = None) -> Live:
    """A live pad on which the presses of a recording are detected, and the monitor of whose fibres is given."""
    health: Any = monitor and model  # a stand-in, of the same pad
    detector = ScriptedDetector(recording, delays)
    with patch.multiple(pipeline, PressDetector=detector, FaultMonitor=lambda health: monitor):
        return Live(model, rate_hz=recording.rate_hz, health=health)


def replay(recording: Recording, model: LocalizerModel, delays: Any = (2, 1), cuts: Any = ()) -> tuple[Live, list[Any]]:
    live, events = scripted(recording, model, delays), []
    for times_s, readings in zip(np.split(recording.times_s, cuts), np.split(recording.readings, cuts), strict=True):
        events += live.update(times_s, readings)
    return live, events


def positions(estimates: Sequence[Estimate]) -> np.ndarray:
    return np.array([[each.x_mm, each.y_mm] for each in estimates])


def moments(recording: Recording, estimates: Sequence[Estimate]) -> np.ndarray:
    """The first readings that estimates do not look at."""
    return np.searchsorted(recording.times_s, [each.now_s for each in estimates]) + 1


def assert_as_a_whole(recording: Recording, model: LocalizerModel, estimates: Sequence[Estimate], **predict) -> None:
    """Estimates are what the whole recording gives at their moments, with lifts that were not yet known left out."""
    until, press = moments(recording, estimates), np.array([each.press for each in estimates])
    is_held, ranks = np.array([each.since == "touch" for each in estimates]), np.empty(len(estimates), int)
    for number in set(press.tolist()):
        ranks[press == number] = np.arange((press == number).sum())
    for rank, parity in product(range(ranks.max() + 1), (0, 1)):  # a press whose lift is moved does not move the next
        rows = np.flatnonzero((ranks == rank) & (press % 2 == parity))
        untils, up_command = recording.down_command + 1, recording.up_command.copy()
        untils[press[rows]] = until[rows]
        held = rows[is_held[rows]]
        up_command[press[held]] = np.maximum(up_command[press[held]], until[held])
        expected = model.predict(replace(recording, up_command=up_command), until=untils, **predict)
        alike = [estimates[row] for row in rows.tolist()]
        np.testing.assert_allclose(positions(alike).reshape(-1, 2), expected.positions_mm[press[rows]], atol=1e-3)
        np.testing.assert_allclose([each.r90_mm for each in alike], expected.r90_mm[press[rows]], rtol=1e-3)


@pytest.mark.parametrize("delays", [(0, 0), (6, 3)])
def test_live_estimates_are_those_of_the_whole_recording(recording, hasty, delays: tuple[int, int]) -> None:
    part = first_presses(recording, 4)
    _, events = replay(part, hasty, delays)
    until = moments(part, events)
    for press in range(3):
        estimates = [each for each in events if each.press == press]
        down, up = int(part.down_command[press]), int(part.up_command[press])
        end = min(up + RELEASE, int(part.down_command[press + 1]))
        assert [each.final for each in estimates] == [False] * (len(estimates) - 1) + [True]
        of_press = until[[each.press == press for each in events]]
        np.testing.assert_array_equal(of_press, np.arange(down + delays[0] + 1, end + 1))
        np.testing.assert_allclose([each.time_s for each in estimates], part.times_s[down])
        for each, index in zip(estimates, range(down + delays[0], end), strict=True):
            first = down if index < up + delays[1] else up
            assert each.since == ("touch" if first == down else "lift")
            assert each.readings == index - first + 1
            assert each.since_s == pytest.approx(part.times_s[index] - part.times_s[first])
    assert_as_a_whole(part, hasty, events)


def test_published_localizer_answers_once_a_press_is_over(recording, trained) -> None:
    part, localizer = first_presses(recording, 20), trained("published")
    _, events = replay(part, localizer)
    assert [each.press for each in events] == list(range(len(events)))
    assert len(events) >= 19  # the last press is complete only with readings that show so
    assert all(each.final and each.since == "lift" for each in events)
    assert_as_a_whole(part, localizer, events)


@pytest.fixture(scope="module")
def at_once(recording: Recording, hasty: LocalizerModel) -> tuple[Recording, list[Any]]:
    """Three presses, and the events of all their readings in one block."""
    part = first_presses(recording, 3)
    return part, replay(part, hasty)[1]


@settings(max_examples=2)
@given(st.lists(st.integers(0, 3 * 40), max_size=6))
def test_live_events_do_not_depend_on_blocks(at_once, hasty, cuts: list[int]) -> None:
    part, events = at_once
    assert replay(part, hasty, cuts=sorted(cuts))[1] == events


@settings(max_examples=2)
@given(st.lists(st.integers(1, 35), min_size=6, max_size=6))
def test_live_handles_presses_of_any_length_and_distance(recording, hasty, lengths: list[int]) -> None:
    """Down to presses of one reading, and such that follow at once."""
    part = first_presses(recording, 5)
    edges = 12 + np.cumsum(lengths)
    edges = edges[edges < len(part.readings) - 30]
    edges = edges[: len(edges) // 2 * 2]
    down_command, up_command = edges[::2], edges[1::2]
    odd = Recording(part.readings, part.times_s, part.presses_mm[: len(down_command)], down_command, up_command)
    _, events = replay(odd, hasty, delays=(0, 0))
    final = [each for each in events if each.final]
    np.testing.assert_allclose(positions(final), hasty.predict(odd).positions_mm, atol=1e-3)
    assert_as_a_whole(odd, hasty, events[::2])


def test_a_press_that_the_next_one_cuts_off_ends_where_that_began(recording, hasty) -> None:
    """Though it is known only some readings later."""
    part = first_presses(recording, 4)
    part = changed(part, "down_command", 2, part.up_command[1] + 5)
    live, events = replay(part, hasty, (3, 1))
    *_, before, last = (each for each in events if each.press == 1)
    assert (before.final, before.readings, last.final, last.since, last.readings) == (False, 8, True, "lift", 5)
    assert events[events.index(last) + 1].press == 2
    assert_as_a_whole(part, hasty, [last])
    assert [each.press for each in live.presses] == [0, 1, 2, 3]
    part = first_presses(recording, 1)  # a tap that its release shows is estimated from then on
    part = replace(part, up_command=part.down_command + 5)
    _, events = replay(part, hasty, (8, 3))
    assert [(each.since, each.readings) for each in events] == [("lift", n) for n in range(4, RELEASE + 1)]
    assert_as_a_whole(part, hasty, events)


def test_live_handles_a_press_that_is_held_for_hours(recording, hasty, monkeypatch) -> None:
    """So long that old readings are dropped for the second time within the press."""
    history, slack, held = 120, 40, 2
    for module in ("rig.streams", "live.pipeline"):
        monkeypatch.setattr(f"padforge.sense.{module}.HISTORY", history)
        monkeypatch.setattr(f"padforge.sense.{module}.SLACK", slack)
    part = first_presses(recording, 3)
    assert part.down_command[held] < history
    n_extra, at = 2 * history + slack, int(part.up_command[held]) - 2
    wander = np.random.default_rng(1).normal(0, 3e-3, (n_extra, part.fibres)).cumsum(axis=0) / 10
    readings = np.insert(part.readings, at, part.readings[at] + wander, axis=0)
    up_command = part.up_command + n_extra * (np.arange(3) == held)
    times_s = np.arange(len(readings)) / part.rate_hz
    long = Recording(readings, times_s, part.presses_mm, part.down_command, up_command)
    _, events = replay(long, hasty)
    estimates = [each for each in events if each.press == held]
    assert len(estimates) == up_command[held] - part.down_command[held] - 2 + RELEASE
    assert_as_a_whole(long, hasty, [*estimates[:20], *estimates[20:-20:40], *estimates[-20:]])
    assert len({each.x_mm for each in estimates}) > n_extra / 2  # where the finger is now may change


def test_live_masks_a_faulty_fibre_from_the_next_press_on(recording, hasty) -> None:
    part, monitor = first_presses(recording, 12), ScriptedMonitor()
    for name, later in (("down_command", 4), ("up_command", 20)):  # press 8 comes soon after the one before
        part = changed(part, name, 8, part.up_command[7] + later)
    live = scripted(part, hasty, monitor=monitor)
    events = live.update(part.times_s, part.readings)
    fault = next(index for index, event in enumerate(events) if isinstance(event, FibreFault))
    estimates = [event for event in events if isinstance(event, Estimate)]
    before, after = events[fault - 1], events[fault + 1]
    assert isinstance(before, Estimate)
    assert (before.press, before.final, after.press) == (5, True, 6)
    assert all(each.failed == (() if each.press < 6 else (1,)) for each in estimates)
    later = [each for each in estimates if each.press >= 6]
    next_down = np.append(part.down_command[1:], len(part.readings))[[each.press for each in later]]
    is_apart = moments(part, later) <= next_down  # that press 8 has begun is known two readings later
    known = [each for each, apart in zip(later, is_apart, strict=True) if apart]
    assert len(known) == len(later) - 2
    assert_as_a_whole(part, hasty, known, failed=(1,))
    assert [fibre["state"] for fibre in live.view()["fibres"]] == ["sound", "no_response", "sound", "sound"]
    for press, (readings, down, up) in enumerate(monitor.updates):  # of each press alone
        first = part.down_command[press] - (4 if press == 8 else 10)
        end = part.up_command[press] + (4 if press == 7 else 20)
        assert (first + down, first + up) == (part.down_command[press], part.up_command[press])
        np.testing.assert_array_equal(readings, part.readings[first:end])


def test_live_without_readings_says_anywhere(recording, hasty) -> None:
    part, scaler = first_presses(recording, 3), hasty.scaler
    live, events = replay(changed(part, "readings", np.s_[int(part.down_command[1]) - 12 :], np.nan), hasty)
    for estimate in (each for each in events if each.press == 1):
        assert estimate.failed == (0, 1, 2, 3)
        assert (estimate.x_mm, estimate.y_mm) == pytest.approx(tuple(scaler.origin_mm))
        assert estimate.r90_mm > scaler.scale_mm
    assert live.view()["fibres"] == [{"swing": None, "state": "missing"}] * 4


def test_faults_wait_while_the_pad_is_taken_for_another(recording, hasty, monkeypatch) -> None:
    """They are reported once with the next press of this pad, from which their fibre is masked."""
    part, monitor, verdicts = first_presses(recording, 9), ScriptedMonitor(), iter([0, 0, 0, 0, 1, 1, 1, 0, 0])
    monkeypatch.setattr(pipeline, "is_other_pad", lambda *asked: bool(next(verdicts)))
    live = scripted(part, hasty, monitor=monitor)
    events = live.update(part.times_s, part.readings)
    (fault,) = (index for index, event in enumerate(events) if isinstance(event, FibreFault))
    before = events[fault - 1]
    assert isinstance(before, Estimate)
    assert (before.press, before.final, len(live.faults)) == (7, True, 1)


def test_view_has_presses_with_their_words_and_faults(recording, hasty, golden: Golden) -> None:
    """Of a pad whose second fibre has failed, in the press, and once it turns out to be another pad."""
    part, down = first_presses(recording, 2), int(recording.down_command[0]) + 15
    live = scripted(part, hasty)
    live.update(part.times_s[:down], part.readings[:down])
    live.presses.clear()
    live.presses.extend(event for event in EVENTS if isinstance(event, Estimate))
    live.track.clear()
    live.track.extend(live.presses)
    live.faults.extend(event for event in EVENTS if isinstance(event, FibreFault))
    view = live.view()
    live.is_other_pad = True
    golden("live/view.json", json_text([view, live.view()["faults"]]))


def test_track_has_the_places_that_a_finger_has_moved_to(recording, hasty, monkeypatch) -> None:
    """It moves by 1 mm a reading, known to 8 mm at first and then to 2 mm."""
    part = first_presses(recording, 2)
    part = changed(part, "up_command", 0, part.down_command[1] - 2)
    path = iter(range(1000))

    def localize(model, presses) -> Localization:
        x = next(path)
        r90 = np.array([8.0 if x == 0 else 2.0])
        return Localization(np.array([[float(x), 0.0]]), np.ones((1, 2)), r90 / 2, r90)

    monkeypatch.setattr(LocalizerModel, "localize", localize)
    live, next_down = scripted(part, hasty), int(part.down_command[1])
    live.update(part.times_s[:next_down], part.readings[:next_down])
    track = live.view()["track"]
    assert 1 < len(track) <= MAX_TRACK
    assert track == [[1.0 + 3 * k, 0.0] for k in range(len(track))]
    live.update(part.times_s[next_down:][:3], part.readings[next_down:][:3])
    assert len(live.view()["track"]) == 1  # of the next press
