"""The pipeline from readings as they come to places: it has to give what the same readings give all at once."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sense.live.pipeline
from design.common.errors import InputError
from sense import Localizer, Recording, locate
from sense.health.monitor import FibreFault
from sense.live.pipeline import Estimate, Live
from sense.live.press_buffer import HISTORY, SLACK
from sense.localizer.features import press_inputs
from sense.localizer.network import OUTPUTS
from sense.localizer.normalization import Normalization
from sense.recordings.processing.press_detection import Event
from tests.sense.live.conftest import first_presses


@pytest.fixture(autouse=True, scope="module")
def prompt() -> Iterator[None]:
    """Presses as scripted begin as they are sent."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(sense.live.pipeline, "SENT_DOWN_S", 0.0)
        monkeypatch.setattr(sense.live.pipeline, "SENT_UP_S", 0.0)
        yield


class Scripted:
    """In place of the finder of presses: tells those of a recording, some readings after they begin and end."""

    def __init__(self, recording: Recording, lags: tuple[int, int] = (2, 1)) -> None:
        begins = [(begun + lags[0], True, begun) for begun in recording.begun.tolist()]
        ends = [(lifted + lags[1], False, lifted) for lifted in recording.lifted.tolist()]
        self._edges = sorted(begins + ends)
        self._read = 0

    def __call__(self, fibres: int) -> "Scripted":
        return self

    def feed(self, times_s: np.ndarray, readings: np.ndarray) -> Iterator[Event]:
        self._read += len(times_s)
        while self._edges and self._edges[0][0] < self._read:
            _, down, at = self._edges.pop(0)
            yield Event(down, at)


class Watching:
    """In place of the monitor: keeps what it is told, and finds fibre 1 silent at press 5."""

    def __init__(self, model: object) -> None:
        self.told: list[tuple[np.ndarray, int, int]] = []
        self.lost: tuple[int, ...] = ()

    def update(self, readings: np.ndarray, begun: int, lifted: int) -> list[FibreFault]:
        self.told.append((readings.copy(), begun, lifted))
        if len(self.told) != 6:
            return []
        self.lost = (1,)
        return [FibreFault(5, 2, (1,), "silent", 9.0)]


@pytest.fixture(scope="module")
def untrained(recording: Recording, localizer: Localizer) -> Callable[..., Localizer]:
    """Makes localizers whose places mean nothing but depend on everything."""

    @cache
    def scaled(features: str) -> tuple[Normalization, np.ndarray]:
        raw = press_inputs(recording.readings, recording.begun, recording.lifted, features)
        return Normalization.fit(raw, recording.presses_mm)

    def make(part: Recording, features: str = "full") -> Localizer:
        scaling, table = scaled(features)
        method = "published" if features == "published" else "masked"
        hidden, outputs = 16, 2 if method == "published" else OUTPUTS
        shapes = {"first.w": (1, scaling.entries(method), hidden), "first.b": (1, 1, hidden)}
        shapes |= {"last.w": (1, hidden, outputs), "last.b": (1, 1, outputs)}
        if method == "masked":
            shapes |= {"hidden.w": (1, 1, hidden, hidden), "hidden.b": (1, 1, 1, hidden)}
        rng = np.random.default_rng(3)
        weights = {name: 0.3 * rng.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}
        made = {"weights": weights, "normalization": scaling, "table": table, "method": method, "features": features}
        made |= {"observer": None, "corrector": {}}
        return replace(localizer, **made, factors=np.ones((1, 3)), rate_hz=part.rate_hz)

    return make


def follow(
    monkeypatch: pytest.MonkeyPatch,
    recording: Recording,
    localizers: Sequence[Localizer],
    *,
    lags: tuple[int, int] = (2, 1),
    cuts: Sequence[int] = (),
) -> tuple[Live, list[Any]]:
    monkeypatch.setattr(sense.live.pipeline, "Finder", Scripted(recording, lags))
    live = Live(localizers, None, recording.fibres, recording.rate_hz)
    events = []
    for times_s, readings in zip(np.split(recording.times_s, cuts), np.split(recording.readings, cuts), strict=True):
        events += live.feed(times_s, readings)
    return live, events


def places(estimates: Sequence[Estimate]) -> np.ndarray:
    return np.array([[each.x_mm, each.y_mm] for each in estimates])


@pytest.mark.parametrize("features", ["full", "causal", "early", "published"])
@pytest.mark.parametrize("lags", [(0, 0), (2, 1), (6, 3)])
def test_live_places_are_those_of_the_whole_recording(
    monkeypatch: pytest.MonkeyPatch, recording: Recording, untrained, features: str, lags: tuple[int, int]
) -> None:
    part = first_presses(recording, 60)
    localizer = untrained(part, features)
    _, events = follow(monkeypatch, part, [localizer], lags=lags)
    expected = locate(localizer, part)
    assert [each.press for each in events] == list(range(len(events)))
    # The last press is not over while no reading is there that says so.
    assert len(events) >= 59
    np.testing.assert_allclose(places(events), expected.places_mm[: len(events)], atol=1e-3)
    np.testing.assert_allclose([each.r90_mm for each in events], expected.r90_mm[: len(events)], rtol=1e-3)
    np.testing.assert_allclose([each.time_s for each in events], part.times_s[part.begun[: len(events)]])


@pytest.fixture(scope="module")
def blocks(recording: Recording, untrained) -> Callable[..., list[Any]]:
    """What comes of the first presses when their readings are cut there."""
    part = first_presses(recording, 8)
    localizers = [untrained(part, features) for features in ("full", "early", "causal")]

    @cache
    def events(*cuts: int) -> list[Any]:
        with pytest.MonkeyPatch.context() as monkeypatch:
            return follow(monkeypatch, part, localizers, cuts=cuts)[1]

    return events


@settings(max_examples=30)
@given(st.lists(st.integers(0, 8 * 40), max_size=6))
def test_how_readings_are_cut_into_blocks_is_all_the_same(blocks: Callable[..., list[Any]], cuts: list[int]) -> None:
    assert blocks(*sorted(cuts)) == blocks()


@settings(max_examples=30)
@given(st.data())
def test_presses_of_any_length_and_distance(recording: Recording, untrained, data: st.DataObject) -> None:
    """Single ones, such as are held for one reading, and such as follow at once."""
    part = first_presses(recording, 12)
    lengths = data.draw(st.lists(st.integers(1, 45), min_size=14, max_size=14))
    edges = 12 + np.cumsum(lengths)
    edges = edges[edges < len(part.readings) - 30][: len(lengths) // 2 * 2]
    edges = edges[: len(edges) // 2 * 2]
    if len(edges) == 0:
        return
    begun, lifted = edges[::2], edges[1::2]
    odd = Recording(part.readings, part.times_s, part.presses_mm[: len(begun)], begun, lifted)
    localizer = untrained(part, "full")
    with pytest.MonkeyPatch.context() as monkeypatch:
        _, events = follow(monkeypatch, odd, [localizer], lags=(0, 0))
    np.testing.assert_allclose(places(events), locate(localizer, odd).places_mm, atol=1e-3)


def test_the_earliest_answers_first_and_others_refine_it(
    monkeypatch: pytest.MonkeyPatch, recording: Recording, untrained
) -> None:
    part = first_presses(recording, 6)
    live, events = follow(monkeypatch, part, [untrained(part, name) for name in ("full", "early", "causal")])
    told = [(each.press, each.features, each.final) for each in events]
    assert told[:6] == [(press, name, name == "full") for press in (0, 1) for name in ("early", "causal", "full")]
    assert [each.press for each in live.presses] == [0, 1, 2, 3, 4, 5]
    assert all(each.final for each in list(live.presses)[:-1])


def test_a_press_may_be_held_for_hours(monkeypatch: pytest.MonkeyPatch, recording: Recording, untrained) -> None:
    part = first_presses(recording, 110)
    held, extra = 105, 2 * (HISTORY + SLACK) + 1000
    at = int(part.lifted[held]) - 2
    readings = np.insert(part.readings, at, np.repeat(part.readings[at : at + 1], extra, axis=0), axis=0)
    later = np.arange(110) > held
    long = Recording(
        readings,
        np.arange(len(readings)) / part.rate_hz,
        part.presses_mm,
        part.begun + extra * later,
        part.lifted + extra * (later | (np.arange(110) == held)),
    )
    localizer = replace(untrained(part, "full"), rate_hz=long.rate_hz)
    _, events = follow(monkeypatch, long, [localizer])
    np.testing.assert_allclose(places(events)[held], locate(localizer, long).places_mm[held], atol=1e-3)


@pytest.fixture
def watched(
    monkeypatch: pytest.MonkeyPatch, recording: Recording, untrained
) -> tuple[Recording, Live, list[Any], Watching]:
    part = first_presses(recording, 12)
    watching = Watching(None)
    monkeypatch.setattr(sense.live.pipeline, "Monitor", lambda model: watching)
    monkeypatch.setattr(sense.live.pipeline, "Finder", Scripted(part))
    localizer = untrained(part, "full")
    live = Live([localizer], localizer, part.fibres, part.rate_hz)  # type: ignore[arg-type]  as alike as it looks at
    return part, live, live.feed(part.times_s, part.readings), watching


def test_a_fibre_found_bad_is_left_out_from_the_next_press_on(watched, untrained) -> None:
    part, live, events, _ = watched
    found = next(index for index, event in enumerate(events) if isinstance(event, FibreFault))
    estimates = [event for event in events if isinstance(event, Estimate)]
    assert [event.press for event in events[:found]] == [0, 1, 2, 3, 4, 5]
    assert [each.lost for each in estimates] == [()] * 6 + [(1,)] * (len(estimates) - 6)
    expected = locate(untrained(part, "full"), part, (1,)).places_mm
    np.testing.assert_allclose(places(estimates)[6:], expected[6 : len(estimates)], atol=1e-3)
    view = live.view()
    assert [fibre["state"] for fibre in view["fibres"]] == ["sound", "silent", "sound", "sound"]
    assert view["findings"] == [live.findings[0].text]


def test_health_is_told_the_readings_of_each_press_alone(watched) -> None:
    part, _, _, watching = watched
    for press, (readings, begun, lifted) in enumerate(watching.told):
        first, last = part.begun[press] - 10, part.lifted[press] + 20
        assert (begun, lifted) == (10, 10 + part.lifted[press] - part.begun[press])
        np.testing.assert_array_equal(readings, part.readings[first:last])


def test_without_any_fibre_a_press_may_be_anywhere(
    monkeypatch: pytest.MonkeyPatch, recording: Recording, untrained
) -> None:
    part = first_presses(recording, 3)
    readings = part.readings.copy()
    readings[int(part.begun[1]) - 12 :] = np.nan
    blind = Recording(readings, part.times_s, part.presses_mm, part.begun, part.lifted)
    localizer = untrained(part, "full")
    live, events = follow(monkeypatch, blind, [localizer])
    assert events[1].lost == (0, 1, 2, 3)
    assert (events[1].x_mm, events[1].y_mm) == pytest.approx(tuple(localizer.normalization.middle_mm))
    assert events[1].r90_mm > localizer.normalization.span_mm
    assert live.view()["fibres"] == [{"swing": None, "state": "missing"}] * 4


def test_the_view_follows_the_pad(monkeypatch: pytest.MonkeyPatch, recording: Recording, untrained) -> None:
    part = first_presses(recording, 3)
    monkeypatch.setattr(sense.live.pipeline, "Finder", Scripted(part))
    live = Live([untrained(part, "full")], None, part.fibres, part.rate_hz)
    assert live.view() == {
        "pressed": False,
        "fibres": [{"swing": None, "state": "missing"}] * 4,
        "presses": [],
        "findings": [],
    }
    down, up = int(part.begun[0]) + 15, int(part.lifted[0]) + 18
    swings = []
    for first, last in ((0, 15), (15, down), (down, up)):
        live.feed(part.times_s[first:last], part.readings[first:last])
        swings.append(max(abs(fibre["swing"]) for fibre in live.view()["fibres"]))
        assert live.pressed == (last == down)
    assert swings[0] < 0.1 < 0.3 < swings[1]
    assert swings[2] < swings[1] / 2


def test_what_does_not_fit_together_is_refused(recording: Recording, untrained) -> None:
    localizer = untrained(first_presses(recording, 20), "full")
    with pytest.raises(InputError, match="readings are of 6 fibres, the localizer was learnt from 4"):
        Live([localizer], None, 6, localizer.rate_hz)
    with pytest.raises(InputError, match=r"there are 20 readings a second, allowed is 13\.\d, .* within 25%"):
        Live([localizer], None, 4, 20.0)
