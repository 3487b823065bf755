"""The pipeline from readings as they come to places: it has to give what the same readings give all at once."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import padforge.sense.live.pipeline
from padforge.design.common.validation import InputError
from padforge.sense import Recording, calibrate
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.pipeline import Estimate, Live
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.rig.streams import HISTORY, SLACK, BufferedPress
from padforge.sense.signals.press_detection import PressEvent
from tests.sense.conftest import QUICK
from tests.sense.live.conftest import first_presses


@pytest.fixture(autouse=True, scope="module")
def prompt() -> Iterator[None]:
    """Presses as scripted begin as they are sent."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(padforge.sense.live.pipeline, "SENT_DOWN_S", 0.0)
        monkeypatch.setattr(padforge.sense.live.pipeline, "SENT_UP_S", 0.0)
        yield


class Scripted:
    """In place of the finder of presses: tells those of a recording, some readings after they begin and end."""

    def __init__(self, recording: Recording, lags: tuple[int, int] = (2, 1)) -> None:
        begins = [(down_command + lags[0], True, down_command) for down_command in recording.down_command.tolist()]
        ends = [(up_command + lags[1], False, up_command) for up_command in recording.up_command.tolist()]
        self._edges = sorted(begins + ends)
        self._read = 0

    def __call__(self, fibres: int) -> "Scripted":
        return self

    def feed(self, times_s: np.ndarray, readings: np.ndarray) -> Iterator[PressEvent]:
        self._read += len(times_s)
        while self._edges and self._edges[0][0] < self._read:
            _, down, at = self._edges.pop(0)
            yield PressEvent(down, at)


class Watching:
    """In place of the monitor: keeps what it is told, and finds fibre 1 silent at press 5."""

    def __init__(self, model: object) -> None:
        self.told: list[tuple[np.ndarray, int, int]] = []
        self.lost: tuple[int, ...] = ()

    def update(self, readings: np.ndarray, down_command: int, up_command: int) -> list[FibreFault]:
        self.told.append((readings.copy(), down_command, up_command))
        if len(self.told) != 6:
            return []
        self.lost = (1,)
        return [FibreFault(5, 2, (1,), "silent", 9.0)]


@pytest.fixture(scope="module")
def learnt(brief: Recording) -> Callable[[str], LocalizerModel]:
    """Localizers that have learnt next to nothing, so that their places depend on every reading they look at."""

    @cache
    def learn(features: str) -> LocalizerModel:
        options = {"features": features, "members": 1, "hidden": 16, "epochs": 1}
        return calibrate(brief, QUICK.model_copy(update=options))[0]

    return learn


def follow(
    recording: Recording, localizers: Sequence[LocalizerModel], lags: tuple[int, int] = (2, 1), cuts: Sequence[int] = ()
) -> tuple[Live, list[Any]]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(padforge.sense.live.pipeline, "PressDetector", Scripted(recording, lags))
        live = Live(localizers, None, recording.fibres, recording.rate_hz)
    events = []
    for times_s, readings in zip(np.split(recording.times_s, cuts), np.split(recording.readings, cuts), strict=True):
        events += live.feed(times_s, readings)
    return live, events


def places(estimates: Sequence[Estimate]) -> np.ndarray:
    return np.array([[each.x_mm, each.y_mm] for each in estimates])


@pytest.mark.parametrize("features", ["press_and_release", "causal", "onset", "published"])
@pytest.mark.parametrize("lags", [(0, 0), (2, 1), (6, 3)])
def test_live_places_are_those_of_the_whole_recording(recording, learnt, features: str, lags: tuple[int, int]) -> None:
    part, localizer = first_presses(recording, 60), learnt(features)
    _, events = follow(part, [localizer], lags)
    expected = localizer.predict(part)
    assert [each.press for each in events] == list(range(len(events)))
    # The last press is not over while no reading is there that says so.
    assert len(events) >= 59
    np.testing.assert_allclose(places(events), expected.positions_mm[: len(events)], atol=1e-3)
    np.testing.assert_allclose([each.r90_mm for each in events], expected.r90_mm[: len(events)], rtol=1e-3)
    np.testing.assert_allclose([each.time_s for each in events], part.times_s[part.down_command[: len(events)]])


@settings(max_examples=15)
@given(st.lists(st.integers(0, 8 * 40), max_size=6))
def test_how_readings_are_cut_into_blocks_is_all_the_same(recording, learnt, cuts: list[int]) -> None:
    part, localizers = first_presses(recording, 8), [learnt(name) for name in ("press_and_release", "onset")]
    assert follow(part, localizers, cuts=sorted(cuts))[1] == follow(part, localizers)[1]


@settings(max_examples=30)
@given(st.lists(st.integers(1, 45), min_size=14, max_size=14))
def test_presses_of_any_length_and_distance(recording, learnt, lengths: list[int]) -> None:
    """Single ones, such as are held for one reading, and such as follow at once."""
    part = first_presses(recording, 12)
    edges = 12 + np.cumsum(lengths)
    edges = edges[edges < len(part.readings) - 30]
    edges = edges[: len(edges) // 2 * 2]
    down_command, up_command = edges[::2], edges[1::2]
    odd = Recording(part.readings, part.times_s, part.presses_mm[: len(down_command)], down_command, up_command)
    _, events = follow(odd, [learnt("press_and_release")], lags=(0, 0))
    np.testing.assert_allclose(places(events), learnt("press_and_release").predict(odd).positions_mm, atol=1e-3)


def test_the_earliest_answers_first_and_others_refine_it(recording, learnt) -> None:
    live, events = follow(
        first_presses(recording, 6), [learnt(name) for name in ("press_and_release", "onset", "causal")]
    )
    told = [(each.press, each.features, each.final) for each in events]
    assert told[:6] == [
        (press, name, name == "press_and_release")
        for press in (0, 1)
        for name in ("onset", "causal", "press_and_release")
    ]
    assert [each.press for each in live.presses] == [0, 1, 2, 3, 4, 5]
    assert all(each.final for each in list(live.presses)[:-1])


def test_a_press_may_be_held_for_hours(recording, learnt) -> None:
    part = first_presses(recording, 110)
    held = 105
    extra = (
        3 * (HISTORY + SLACK) - int(part.down_command[107]) - 5
    )  # old readings are given up for the second time in a press
    at = int(part.up_command[held]) - 2
    readings = np.insert(part.readings, at, np.repeat(part.readings[at : at + 1], extra, axis=0), axis=0)
    later = np.arange(110) > held
    edges = part.down_command + extra * later, part.up_command + extra * (later | (np.arange(110) == held))
    long = Recording(readings, np.arange(len(readings)) / part.rate_hz, part.presses_mm, *edges)
    _, events = follow(long, [learnt("press_and_release")])
    np.testing.assert_allclose(
        places(events)[held:109], learnt("press_and_release").predict(long).positions_mm[held:109], atol=1e-3
    )


def test_a_fibre_found_bad_is_left_out_from_the_next_press_on(recording, learnt, monkeypatch) -> None:
    part, localizer, watching = first_presses(recording, 12), learnt("press_and_release"), Watching(None)
    down_command, up_command = part.down_command.copy(), part.up_command.copy()
    down_command[8], up_command[8] = up_command[7] + 4, up_command[7] + 20  # soon after the one before
    part = replace(part, down_command=down_command, up_command=up_command)
    monkeypatch.setattr(padforge.sense.live.pipeline, "FaultDetector", lambda model: watching)
    monkeypatch.setattr(padforge.sense.live.pipeline, "PressDetector", Scripted(part))
    live = Live([localizer], localizer, part.fibres, part.rate_hz)  # as alike as it looks at
    events = live.feed(part.times_s, part.readings)
    found = next(index for index, event in enumerate(events) if isinstance(event, FibreFault))
    estimates = [event for event in events if isinstance(event, Estimate)]
    assert [event.press for event in events[:found]] == [0, 1, 2, 3, 4, 5]
    assert [each.lost for each in estimates] == [()] * 6 + [(1,)] * (len(estimates) - 6)
    expected = localizer.predict(part, (1,)).positions_mm
    np.testing.assert_allclose(places(estimates)[6:], expected[6 : len(estimates)], atol=1e-3)
    view = live.view()
    assert [fibre["state"] for fibre in view["fibres"]] == ["sound", "silent", "sound", "sound"]
    assert view["findings"] == [live.findings[0].text]
    for press, (readings, down_command, up_command) in enumerate(watching.told):  # of each press alone
        first, last = (
            part.down_command[press] - (4 if press == 8 else 10),
            part.up_command[press] + (4 if press == 7 else 20),
        )
        assert (first + down_command, first + up_command) == (part.down_command[press], part.up_command[press])
        np.testing.assert_array_equal(readings, part.readings[first:last])


def test_a_press_that_is_let_go_before_it_began_lasts_a_reading() -> None:
    press = BufferedPress(0, 0.0, 12, 10, 0, np.zeros(1))
    press.let_go(4)
    assert press.up_command == 11


def test_without_any_fibre_a_press_may_be_anywhere(recording, learnt) -> None:
    part, scaling = first_presses(recording, 3), learnt("press_and_release").scaler
    readings = part.readings.copy()
    readings[int(part.down_command[1]) - 12 :] = np.nan
    live, events = follow(
        Recording(readings, part.times_s, part.presses_mm, part.down_command, part.up_command),
        [learnt("press_and_release")],
    )
    assert events[1].lost == (0, 1, 2, 3)
    assert (events[1].x_mm, events[1].y_mm) == pytest.approx(tuple(scaling.origin_mm))
    assert events[1].r90_mm > scaling.scale_mm
    assert live.view()["fibres"] == [{"swing": None, "state": "missing"}] * 4


def test_the_view_follows_the_pad(recording, learnt, monkeypatch) -> None:
    part = first_presses(recording, 3)
    monkeypatch.setattr(padforge.sense.live.pipeline, "PressDetector", Scripted(part))
    live = Live([learnt("press_and_release")], None, part.fibres, part.rate_hz)
    missing = [{"swing": None, "state": "missing"}] * 4
    assert live.view() == {"pressed": False, "fibres": missing, "presses": [], "findings": []}
    down, up = int(part.down_command[0]) + 15, int(part.up_command[0]) + 18
    swings = []
    for first, last in ((0, 15), (15, down), (down, up)):
        live.feed(part.times_s[first:last], part.readings[first:last])
        swings.append(max(abs(fibre["swing"]) for fibre in live.view()["fibres"]))
        assert live.pressed == (last == down)
    assert swings[0] < 0.1 < 0.3 < swings[1]
    assert swings[2] < swings[1] / 2


def test_what_does_not_fit_together_is_refused(recording, learnt) -> None:
    localizer = learnt("press_and_release")
    for localizers, fibres, rate_hz, said in (
        ([localizer], 6, localizer.rate_hz, "readings are of 6 fibres, the localizer was learnt from 4"),
        ([localizer], 4, 20.0, r"there are 20 readings a second, allowed is 13\.\d, .* within 25%"),
        ([], 4, localizer.rate_hz, "expected at least one"),
    ):
        with pytest.raises(InputError, match=said):
            Live(localizers, None, fibres, rate_hz)
    live = Live([localizer], None, 4, localizer.rate_hz)
    live.feed(recording.times_s[:9], recording.readings[:9])
    for rows, said in ((slice(8, 12), "times begin at .* later than"), (slice(12, 8, -1), "times")):
        with pytest.raises(InputError, match=said):
            live.feed(recording.times_s[rows], recording.readings[rows])
    with pytest.raises(InputError, match="readings"):
        live.feed(recording.times_s[9:12], recording.readings[9:12, :3])
