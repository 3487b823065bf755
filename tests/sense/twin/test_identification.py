"""Identification of pads whose truth is known, and of recordings that tell nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design import InputError, Morphology
from design.pad.twin import Twin
from design.settings import PadSettings
from sense.recordings.recording import Recording
from sense.recordings.simulation.published_protocol import simulate
from sense.report.identification_results import identification_lines
from sense.settings import RigSettings
from sense.twin import identification, wiring
from sense.twin.benchmark import printed_pad
from sense.twin.identification import identify
from sense.twin.identified_pad import Identification

from .conftest import PLAN


@pytest.fixture(scope="module")
def recording(printed: Twin) -> Recording:
    return simulate(printed, RigSettings(presses=500, seed=3))


@pytest.fixture(scope="module")
def found(recording: Recording) -> Identification:
    return identify(recording, PLAN, seed=1)


def test_wiring_frame_and_reach_are_found(printed: Twin, found: Identification) -> None:
    twin = found.twin({"command": "test"})
    assert [channel.fibre for channel in twin.channels] == [channel.fibre for channel in printed.channels]
    assert twin.frame.mirrored
    assert twin.frame.turn_deg == pytest.approx(printed.frame.turn_deg, abs=4)
    assert twin.frame.shift_mm == pytest.approx(printed.frame.shift_mm, abs=1.0)
    told, true = twin.contact().reach, printed.contact().reach
    at = np.linspace(0, 13.5, 7)
    assert np.interp(at, *np.array(told).T) == pytest.approx(np.interp(at, *np.array(true).T), abs=0.15)
    assert found.explained.mean() > 0.95
    assert found.explained.mean() > found.on_plan
    assert not found.doubts


def test_gains_and_noise_are_those_of_the_pad(printed: Twin, found: Identification) -> None:
    for channel, true in zip(found.twin().channels, printed.channels, strict=True):
        if true.fibre is not None:
            assert channel.gain_v == pytest.approx(true.gain_v, rel=0.25)
            # 425 presses know it within 7 %, and the pad that is fitted takes up some 5 % of it; what the rest drifts
            # within a press comes on top
            assert 0.85 * true.noise_v < channel.noise_v < 3 * true.noise_v


def test_the_twin_answers_as_was_measured(found: Identification) -> None:
    twin, presses = found.twin(), found.held_out
    signals = twin.laid_stretch(presses.places_mm)
    columns = [(twin.channels[channel].gain_v, twin.channels[channel].fibre) for channel in found.live]
    told = np.column_stack([gain * signals[:, fibre] for gain, fibre in columns])
    fitted = found.fit.pad.predict(presses.places_mm) - found.fit.pad.own[:, 1]
    assert told == pytest.approx(fitted, abs=0.05 * np.abs(fitted).max())


def test_what_a_symmetric_pad_cannot_tell_is_a_doubt_and_always_the_same() -> None:
    pad = Morphology.straight(2)
    printed = printed_pad(pad, np.random.default_rng(0), laid_mm=0.2, dead=0)
    recording = simulate(printed, RigSettings(presses=200, seed=1))  # of seed 0 it is just not as good
    found, again = (identify(recording, pad, seed=1) for _ in range(2))
    assert np.array_equal(again.fit.pad.values, found.fit.pad.values)
    assert found.doubts
    assert found.straight is None
    assert abs(found.fit.pad.frame.turn_deg) < 20  # of all that are as good, the least turned


def _channels(recording: Recording, spoil) -> Recording:
    readings = recording.readings.copy()
    spoil(readings)
    return replace(recording, readings=readings)


def test_channels_that_are_missing_or_dead_are_said_to_read_nothing(recording: Recording, printed: Twin) -> None:
    live = next(channel.channel for channel in printed.channels if channel.fibre is not None)
    found = identify(_channels(recording, lambda readings: readings.__setitem__((slice(None), live), np.nan)), PLAN)
    assert found.twin().channels[live].fibre is None
    others = [c.fibre for c in found.twin().channels if c.channel != live]
    assert others == [c.fibre for c in printed.channels if c.channel != live]


def test_too_few_presses_are_refused(recording: Recording) -> None:
    few = {name: getattr(recording, name)[:10] for name in ("presses_mm", "begun", "lifted", "depths_mm")}
    with pytest.raises(InputError, match="10 presses of known place"):
        identify(replace(recording, **few), PLAN)


def test_presses_in_one_corner_are_refused(recording: Recording) -> None:
    corner = recording.presses_mm / 4 + 5
    with pytest.raises(InputError, match="the presses lie within"):
        identify(replace(recording, presses_mm=corner), PLAN)


def test_places_that_are_unknown_are_refused(recording: Recording) -> None:
    with pytest.raises(InputError, match="0 presses of known place"):
        identify(replace(recording, presses_mm=np.full_like(recording.presses_mm, np.nan)), PLAN)


def test_a_recording_that_answers_to_nothing_is_refused(recording: Recording) -> None:
    noise = np.random.default_rng(0).normal(2.0, 0.002, recording.readings.shape)
    with pytest.raises(InputError, match="no channel of the recording answers"):
        identify(replace(recording, readings=noise), PLAN)


def test_a_pad_with_fewer_fibres_than_channels_answer_is_refused(recording: Recording) -> None:
    with pytest.raises(InputError, match="3 channels of the recording answer to presses, the pad has 2 fibres"):
        identify(recording, Morphology.straight(1, pitch_mm=20.0))


TOLD = {
    "presses": 10,
    "channels": [],
    "explained": 0.9,
    "explained_on_plan": 0.8,
    "noise": 0.01,
    "doubts": 0,
    "explained_by_straight": None,
}


@pytest.mark.parametrize(
    ("found", "told", "side"),
    [
        (False, None, "as planned"),
        (True, None, "turned over"),
        (True, False, "turned over"),
        (False, True, "turned over, as [rig] mirrored says"),
        (True, True, "as planned, which [rig] mirrored denies"),
    ],
)
def test_how_the_pad_lay_counts_what_rig_had_said_of_it(found: bool, told: bool | None, side: str) -> None:
    """A mirrored rig has taken places to the plan already: its twin is mirrored only where that was wrong."""
    frame = {"mirrored": found, "turn_deg": 0.0, "shift_mm": [0.0, 0.0], "scale": 1.0}
    document = TOLD | {"frame": frame} | ({} if told is None else {"rig_mirrored": told})
    assert f"laid {side}, turned 0.0 degrees, shifted 0.0, 0.0 mm, scale 1.000" in identification_lines(
        document, Path()
    )


def test_a_rectangle_is_identified_whichever_way_it_lay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turned by a quarter, presses span its height where its width was planned."""
    monkeypatch.setattr(identification, "TRIED", 2)
    monkeypatch.setattr(wiring, "REFINED", 6)
    plan = Morphology.random((1, 2), 3, 3, (8.0, 12.0))
    printed = printed_pad(plan, np.random.default_rng(1), laid_mm=0.2, dead=0)
    lying = replace(printed, frame=replace(printed.frame, turn_deg=93.0))
    found = identify(simulate(lying, RigSettings(presses=150, seed=3)), plan, seed=1).twin()
    assert [channel.fibre for channel in found.channels] == [channel.fibre for channel in lying.channels]
    assert found.frame.mirrored
    assert found.frame.turn_deg == pytest.approx(93.0, abs=5)
    assert found.frame.shift_mm == pytest.approx(lying.frame.shift_mm, abs=1.5)


def test_presses_must_span_half_of_a_rectangle_each_way() -> None:
    plan = Morphology.straight((1, 3), (8.0, 12.0))
    narrow = PadSettings(**plan.layout.settings, sensed_mm=(10.0, 11.0))
    with pytest.raises(InputError, match="allowed is what spans 12 x 6 mm"):
        identify(simulate(plan, RigSettings(presses=80), size=narrow), plan)
