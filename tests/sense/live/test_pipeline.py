"""The live pipeline gives what the same readings give as a whole recording."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.common.validation import InputError
from padforge.sense import Recording, calibrate
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.pipeline import Estimate, Live
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.rig.streams import HISTORY, SLACK
from padforge.sense.signals.press_detection import PressEvent
from tests.sense.conftest import QUICK
from tests.sense.live.conftest import first_presses


@pytest.fixture(autouse=True, scope="module")
def no_delays() -> Iterator[None]:
    """Scripted presses begin as they are commanded."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("padforge.sense.live.pipeline.TOUCH_DELAY_S", 0.0)
        monkeypatch.setattr("padforge.sense.live.pipeline.RELEASE_DELAY_S", 0.0)
        yield


class ScriptedDetector:
    """A press detector that gives the presses of a recording, some readings after they begin and end."""

    def __init__(self, recording: Recording, delays: tuple[int, int] = (2, 1)) -> None:
        events = (True, delays[0], recording.down_command), (False, delays[1], recording.up_command)
        self._events = sorted((index + late, down, index) for down, late, at in events for index in at.tolist())
        self._n_readings = 0

    def __call__(self, fibres: int) -> "ScriptedDetector":
        return self

    def update(self, times_s: np.ndarray, readings: np.ndarray) -> Iterator[PressEvent]:
        self._n_readings += len(times_s)
        while self._events and self._events[0][0] < self._n_readings:
            _, down, index = self._events.pop(0)
            yield PressEvent(down, index)


class ScriptedMonitor:
    """A fault monitor that stores its input, and detects that fibre 1 does not respond at press 5."""

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
    """Hardly trained localizers by their features, whose positions depend on every reading that they look at."""

    @cache
    def train(features: str) -> LocalizerModel:
        options = {"features": features, "members": 1, "hidden": 16, "epochs": 1}
        return calibrate(brief, QUICK.model_copy(update=options))[0]

    return train


def replay(
    recording: Recording, models: Sequence[LocalizerModel], delays: tuple[int, int] = (2, 1), cuts: Sequence[int] = ()
) -> tuple[Live, list[Any]]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("padforge.sense.live.pipeline.PressDetector", ScriptedDetector(recording, delays))
        live = Live(models, None, recording.fibres, recording.rate_hz)
    events = []
    for times_s, readings in zip(np.split(recording.times_s, cuts), np.split(recording.readings, cuts), strict=True):
        events += live.feed(times_s, readings)
    return live, events


def positions(estimates: Sequence[Estimate]) -> np.ndarray:
    return np.array([[each.x_mm, each.y_mm] for each in estimates])


@pytest.mark.parametrize("features", ["press_and_release", "causal", "onset", "published"])
@pytest.mark.parametrize("delays", [(0, 0), (2, 1), (6, 3)])
def test_live_estimates_are_those_of_the_whole_recording(recording, trained, features: str, delays) -> None:
    part, localizer = first_presses(recording, 60), trained(features)
    _, events = replay(part, [localizer], delays)
    expected = localizer.predict(part)
    assert [each.press for each in events] == list(range(len(events)))
    assert len(events) >= 59  # the last press is complete only with readings that show so
    np.testing.assert_allclose(positions(events), expected.positions_mm[: len(events)], atol=1e-3)
    np.testing.assert_allclose([each.r90_mm for each in events], expected.r90_mm[: len(events)], rtol=1e-3)
    np.testing.assert_allclose([each.time_s for each in events], part.times_s[part.down_command[: len(events)]])


@settings(max_examples=15)
@given(st.lists(st.integers(0, 8 * 40), max_size=6))
def test_live_events_do_not_depend_on_blocks(recording, trained, cuts: list[int]) -> None:
    part, models = first_presses(recording, 8), [trained(name) for name in ("press_and_release", "onset")]
    assert replay(part, models, cuts=sorted(cuts))[1] == replay(part, models)[1]


@settings(max_examples=30)
@given(st.lists(st.integers(1, 45), min_size=14, max_size=14))
def test_live_handles_presses_of_any_length_and_distance(recording, trained, lengths: list[int]) -> None:
    """Down to presses of one reading, and such that follow at once."""
    part = first_presses(recording, 12)
    edges = 12 + np.cumsum(lengths)
    edges = edges[edges < len(part.readings) - 30]
    edges = edges[: len(edges) // 2 * 2]
    down_command, up_command = edges[::2], edges[1::2]
    odd = Recording(part.readings, part.times_s, part.presses_mm[: len(down_command)], down_command, up_command)
    _, events = replay(odd, [trained("press_and_release")], delays=(0, 0))
    np.testing.assert_allclose(positions(events), trained("press_and_release").predict(odd).positions_mm, atol=1e-3)


def test_live_estimates_early_and_refines(recording, trained) -> None:
    names = ("press_and_release", "onset", "causal")
    live, events = replay(first_presses(recording, 6), [trained(name) for name in names])
    order = [(0, "onset"), (0, "causal"), (0, names[0]), (1, "onset"), (1, "causal"), (1, names[0])]
    assert [(each.press, each.features) for each in events[:6]] == order
    assert all(each.final == (each.features == names[0]) for each in events)
    assert [each.press for each in live.presses] == [0, 1, 2, 3, 4, 5]


def test_live_handles_a_press_that_is_held_for_hours(recording, trained) -> None:
    part, held = first_presses(recording, 110), 105
    # So long that old readings are dropped for the second time within the press.
    n_extra = 3 * (HISTORY + SLACK) - int(part.down_command[107]) - 5
    at = int(part.up_command[held]) - 2
    readings = np.insert(part.readings, at, np.repeat(part.readings[at : at + 1], n_extra, axis=0), axis=0)
    later = np.arange(110) > held
    commands = part.down_command + n_extra * later, part.up_command + n_extra * (later | (np.arange(110) == held))
    long = Recording(readings, np.arange(len(readings)) / part.rate_hz, part.presses_mm, *commands)
    localizer = trained("press_and_release")
    _, events = replay(long, [localizer])
    np.testing.assert_allclose(positions(events)[held:109], localizer.predict(long).positions_mm[held:109], atol=1e-3)


def test_live_masks_a_faulty_fibre_from_the_next_press_on(recording, trained, monkeypatch) -> None:
    part, localizer, monitor = first_presses(recording, 12), trained("press_and_release"), ScriptedMonitor()
    down_command, up_command = part.down_command.copy(), part.up_command.copy()
    down_command[8], up_command[8] = up_command[7] + 4, up_command[7] + 20  # soon after the one before
    part = replace(part, down_command=down_command, up_command=up_command)
    monkeypatch.setattr("padforge.sense.live.pipeline.FaultMonitor", lambda model: monitor)
    monkeypatch.setattr("padforge.sense.live.pipeline.PressDetector", ScriptedDetector(part))
    live = Live([localizer], localizer, part.fibres, part.rate_hz)  # a stand-in for health, of the same pad
    events = live.feed(part.times_s, part.readings)
    fault = next(index for index, event in enumerate(events) if isinstance(event, FibreFault))
    estimates = [event for event in events if isinstance(event, Estimate)]
    assert [event.press for event in events[:fault]] == [0, 1, 2, 3, 4, 5]
    assert [each.failed for each in estimates] == [()] * 6 + [(1,)] * (len(estimates) - 6)
    expected = localizer.predict(part, (1,)).positions_mm
    np.testing.assert_allclose(positions(estimates)[6:], expected[6 : len(estimates)], atol=1e-3)
    view = live.view()
    assert [fibre["state"] for fibre in view["fibres"]] == ["sound", "no_response", "sound", "sound"]
    assert view["faults"] == [live.faults[0].text]
    for press, (readings, down, up) in enumerate(monitor.updates):  # of each press alone
        first = part.down_command[press] - (4 if press == 8 else 10)
        end = part.up_command[press] + (4 if press == 7 else 20)
        assert (first + down, first + up) == (part.down_command[press], part.up_command[press])
        np.testing.assert_array_equal(readings, part.readings[first:end])


def test_live_without_readings_says_anywhere(recording, trained) -> None:
    part, scaler = first_presses(recording, 3), trained("press_and_release").scaler
    readings = part.readings.copy()
    readings[int(part.down_command[1]) - 12 :] = np.nan
    live, events = replay(replace(part, readings=readings), [trained("press_and_release")])
    assert events[1].failed == (0, 1, 2, 3)
    assert (events[1].x_mm, events[1].y_mm) == pytest.approx(tuple(scaler.origin_mm))
    assert events[1].r90_mm > scaler.scale_mm
    assert live.view()["fibres"] == [{"swing": None, "state": "missing"}] * 4


def test_view_follows_the_pad(recording, trained, monkeypatch) -> None:
    part = first_presses(recording, 3)
    monkeypatch.setattr("padforge.sense.live.pipeline.PressDetector", ScriptedDetector(part))
    live = Live([trained("press_and_release")], None, part.fibres, part.rate_hz)
    missing = [{"swing": None, "state": "missing"}] * 4
    assert live.view() == {"pressed": False, "fibres": missing, "presses": [], "faults": []}
    down, up = int(part.down_command[0]) + 15, int(part.up_command[0]) + 18
    swings = []
    for first, end in ((0, 15), (15, down), (down, up)):
        live.feed(part.times_s[first:end], part.readings[first:end])
        swings.append(max(abs(fibre["swing"]) for fibre in live.view()["fibres"]))
        assert live.pressed == (end == down)
    assert swings[0] < 0.1 < 0.3 < swings[1]
    assert swings[2] < 0.75 * swings[1]  # what remains of a press is half of it


def test_live_refuses_what_does_not_fit(recording, trained) -> None:
    localizer = trained("press_and_release")
    with pytest.raises(InputError, match="within 25%"):
        Live([localizer], None, 4, 20.0)
    live = Live([localizer], None, 4, localizer.rate_hz)
    live.feed(recording.times_s[:9], recording.readings[:9])
    with pytest.raises(InputError, match=r"times begin at .* later than"):
        live.feed(recording.times_s[8:12], recording.readings[8:12])
