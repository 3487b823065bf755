"""A pad simulated by its twin answers as the twin says: wiring, frame, sizes, noise and how strong they are."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.design import InputError, Morphology, Twin
from padforge.design.contact import relative_stretch
from padforge.design.twin import PlanTransform, TwinChannel, TwinReadings
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.simulation.simulated_recording import measured, strengths

PAD = Morphology.straight(2)
GAINS = (-0.06, -0.04, -0.05)
STILL: dict[str, Any] = {"noise_mv": 0.0, "drift_mv": 0.0}
DISTANCE_MM, WEIGHT = 11.25 * np.linspace(0, 1.2, 9), np.append(np.exp(-0.5 * (np.linspace(0, 1.05, 8) / 0.5) ** 2), 0)


def twin_of(frame: PlanTransform | None = None, noise_v: float = 0.0, readings: TwinReadings | None = None) -> Twin:
    """Channel 1 is dead; 0, 2 and 3 read the fibres 3, 0 and 1 of a straight pad."""
    wired = [(3, GAINS[0]), (None, 0.0), (0, GAINS[1]), (1, GAINS[2])]
    channels = [TwinChannel(c, fibre, gain, noise_v, 0.9) for c, (fibre, gain) in enumerate(wired)]
    laid = *(PAD.to_mm(line) for line in PAD.knots[[0, 1]]), None, PAD.to_mm(PAD.knots[3])
    told = tuple(channels), frame or PlanTransform(), DISTANCE_MM, WEIGHT, laid
    return Twin(PAD, *told, 0.02, (22.5, 22.5), 900, readings=readings)


def responses(recording: Recording) -> np.ndarray:
    """(Q, C) V, means while held minus the rest before."""
    cycles = recording.readings.reshape(len(recording.presses_mm), 40, -1)
    return cycles[:, 25:40].mean(axis=1) - cycles[:, 8:20].mean(axis=1)


def test_channels_respond_as_the_twin_names_them_a_dead_one_by_noise_alone_and_a_seed_tells_it_all() -> None:
    twin = twin_of(PlanTransform(turn_deg=5, shift_mm=(2, -1), scale=0.9))
    recording = simulate(twin, RigSettings(presses=200, hysteresis=0, **STILL))
    expected = np.zeros((200, 4))
    expected[:, [0, 2, 3]] = GAINS * twin.as_built_stretch(recording.presses_mm)[:, [3, 0, 1]]
    found = responses(recording)
    assert found == pytest.approx(expected, abs=4e-3)  # creep of the press before, and steps of the converter
    assert np.corrcoef(found[:, 0], expected[:, 0])[0, 1] > 0.999
    assert found[:, [0, 2, 3]].min(axis=0) == pytest.approx(expected[:, [0, 2, 3]].min(axis=0), rel=0.05)
    twin, rig = twin_of(noise_v=0.02), RigSettings(presses=200, drift_mv=0, noise_mv=2)
    recording = simulate(twin, rig)
    assert recording == simulate(twin, rig) != simulate(twin, rig.model_copy(update={"seed": 4}))
    dead, live = recording.readings[:, 1], recording.readings[:, 0]
    assert dead.std() == pytest.approx(2e-3, rel=0.05)
    assert live.std() > 5 * dead.std()


def test_a_mirrored_pad_answers_as_at_the_mirrored_place_and_is_pressed_where_it_was_printed() -> None:
    places = np.array([[4.0, 3.0], [-7.0, 1.0], [2.0, -9.0]])
    plain, mirrored = (measured(twin_of(PlanTransform(mirrored=mirrored))) for mirrored in (False, True))
    assert mirrored.answers(places * [-1, 1]) == pytest.approx(plain.answers(places))
    assert np.abs(mirrored.answers(places) - plain.answers(places)).max() > 0.01
    twin = replace(twin_of(), sensed_mm=(20.0, 10.0))
    for turn_deg, sides in ((0, (20, 10)), (90, (10, 20)), (180, (20, 10))):
        recording = simulate(replace(twin, frame=PlanTransform(turn_deg=turn_deg)), RigSettings(presses=400))
        assert np.ptp(recording.presses_mm, axis=0) == pytest.approx(sides, rel=0.02)
    askew = replace(twin, frame=PlanTransform(turn_deg=10, scale=0.8))
    half = np.array(measured(askew).pressed_mm[1])
    spans = np.ptp(askew.frame.to_plan(half * [[-1, -1], [-1, 1], [1, 1], [1, -1]]), axis=0)
    assert spans == pytest.approx((20, 10))


@pytest.mark.parametrize(
    ("information_gain", "rig"), [(1.0, {}), (4.0, {}), (1.0, {"drift_mv": 100.0, "noise_mv": 5.0})]
)
def test_responses_scatter_as_the_twin_says(information_gain: float, rig: dict) -> None:
    """With an information gain of 4 by half of it; what was measured takes precedence."""
    measures = {"noise_mv": 1.6, "drift_mv": 10.0, "hysteresis": 0.0, "hysteresis_s": 12.0} | rig
    twin = twin_of(noise_v=0.012, readings=TwinReadings(**measures, information_gain=information_gain))
    recording = simulate(twin, RigSettings(presses=1500, creep=0))
    assert recording.source["rig"].items() >= (measures | {"creep": 0}).items()
    scatter = responses(recording) - measured(twin).answers(recording.presses_mm)
    assert scatter[:, [0, 2, 3]].std(axis=0) == pytest.approx(0.012 / information_gain**0.5, rel=0.08)


def test_another_pad_answers_as_planned_with_the_reach_and_median_gain_of_the_twin_or_is_refused() -> None:
    twin, other = (
        twin_of(PlanTransform(mirrored=True, shift_mm=(3, 3))),
        Morphology.random(3, knots=2, seed=1, pitch_mm=9),
    )
    recording = simulate(other, RigSettings(presses=100, hysteresis=0, creep=0, **STILL), like=twin)
    expected = -0.05 * relative_stretch(other, other.to_grid(recording.presses_mm), twin.contact())
    assert responses(recording) == pytest.approx(expected, abs=1e-3)
    assert recording.source["contact"] == twin.contact().model_dump(mode="json")
    assert recording.source["twin"]["presses"] == 900
    assert np.abs(recording.presses_mm).max() == pytest.approx(13.5, rel=0.02)
    dead = replace(twin_of(), channels=tuple(TwinChannel(c, None, 0.0, 0.0, 0.0) for c in range(2)))
    for pad, like in ((dead, None), (PAD, dead)):
        with pytest.raises(InputError, match="twin: none of its channels reads a fibre"):
            simulate(pad, RigSettings(presses=3), like=like)
    with pytest.raises(InputError, match="fibres of the pad is 600, allowed is a whole number from 1 to 512"):
        simulate(Morphology.straight(300), RigSettings(presses=3), like=twin_of())


@pytest.mark.parametrize("told", [(1.8, 12.0, 0.4, 15.0), (3.0, 25.0, 0.3, 6.0)])
def test_what_a_simulation_was_told_is_found(told: tuple[float, ...]) -> None:
    names = ("noise_mv", "drift_mv", "hysteresis", "hysteresis_s")
    rig: dict[str, Any] = dict(zip(names, told, strict=True))
    found = strengths(simulate(PAD, RigSettings(presses=1500, **rig)))
    for name, value, rel in zip(names, told, (0.05, 0.3, 0.2, 0.35), strict=True):
        assert found[name] == pytest.approx(value, rel=rel), name


def test_few_presses_and_channels_that_miss_readings_or_never_change_tell_nothing() -> None:
    assert strengths(simulate(PAD, RigSettings(presses=90))) == {}
    recording = simulate(PAD, RigSettings(presses=200))
    spoilt = np.column_stack([recording.readings, np.full(len(recording.readings), 1.5), recording.readings[:, 0]])
    spoilt[1000, 5] = np.nan
    presses = {name: getattr(recording, name) for name in ("presses_mm", "down_command", "up_command")}
    assert strengths(Recording(spoilt, recording.times_s, **presses)) == strengths(recording)
    assert strengths(Recording(spoilt[:, 4:], recording.times_s, **presses)) == {}
