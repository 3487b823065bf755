"""How much presses tell of their place, against what is known of a simulated pad."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Morphology, Twin
from padforge.design.twin import TwinReadings
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.twin.as_built import information, of_one_depth, responses

QUIET = TwinReadings(noise_mv=1.0, drift_mv=0.0, hysteresis=0.0, hysteresis_s=2.5)


def known_information(twin: Twin, positions_mm: np.ndarray) -> np.ndarray:
    """(C',) 1/mm^2 of the live channels: squares of how answers change with the place, over their noise."""
    live = [channel for channel in twin.channels if channel.fibre is not None]
    steps = [
        twin.as_built_stretch(positions_mm + step) - twin.as_built_stretch(positions_mm - step)
        for step in 0.5 * np.eye(2)
    ]
    slopes = np.sum(np.square(steps), axis=0).mean(axis=0)
    return np.array([slopes[c.fibre] * (c.gain_v / c.noise_v) ** 2 for c in live])


@pytest.fixture(scope="module")
def noisy(printed: Twin) -> Twin:
    """As noisy as pads are that were built, which is more than what the response model smooths away.

    Where channels of less noise smooth the slopes, information comes out too low, where they have more too high.
    """
    channels = tuple(replace(channel, noise_v=3 * channel.noise_v) for channel in printed.channels)
    return replace(printed, channels=channels, readings=QUIET)


@pytest.fixture(scope="module")
def recording(noisy: Twin) -> Recording:
    return simulate(noisy, RigSettings(presses=800, creep=0, seed=1))


def test_presses_tell_what_their_answers_tell_of_channels_that_are_there(noisy: Twin, recording: Recording) -> None:
    live = np.flatnonzero([channel.fibre is not None for channel in noisy.channels])
    found = information(recording, live)
    known = known_information(noisy, recording.presses_mm[:200])
    assert found.sum() == pytest.approx(known.sum(), rel=0.2)
    assert found == pytest.approx(known, rel=0.6)
    channel = next(c.channel for c in noisy.channels if c.fibre is not None)
    readings = np.array(recording.readings)
    readings[: recording.down_command[300], channel] = np.nan
    presses = {name: getattr(recording, name) for name in ("presses_mm", "down_command", "up_command")}
    spoilt = Recording(readings, recording.times_s, **presses)
    only = np.array([channel])
    assert information(spoilt, only) == pytest.approx(information(recording, only), rel=0.35)


def test_an_answer_is_what_is_held_less_the_rest_and_short_presses_tell_of_their_places_too() -> None:
    """Readings of 2 V, of 5 V while the tip comes to rest, and of 3 V then."""
    recording = simulate(Morphology.straight(2), RigSettings(presses=80, seed=0))
    readings = np.full_like(recording.readings, 2.0)
    for down, up in zip(recording.down_command, recording.up_command, strict=True):
        readings[down : down + 4], readings[down + 4 : up] = 5.0, 3.0
    found = responses(replace(recording, readings=readings), np.arange(80) < 60)
    np.testing.assert_allclose(found.volts, 1.0, atol=0.02)  # of which memory takes a little
    recording = simulate(Morphology.random(2, 3, seed=0), RigSettings(presses=120, readings_per_press=8, seed=0))
    found = information(recording, np.arange(recording.fibres))
    assert np.isfinite(found).all()
    assert (found > 0).any()


def test_presses_as_deep_as_most_are_kept_the_deeper_of_two_kinds_and_all_of_unknown_depth() -> None:
    recording = simulate(Morphology.straight(2), RigSettings(presses=9, depths_mm=(0.5, 3.0, 5.0)))
    kept = of_one_depth(recording)
    assert kept.presses_mm[kept.has_position].tolist() == recording.presses_mm[2::3].tolist()
    unknown = replace(recording, depths_mm=np.full(9, np.nan))
    assert of_one_depth(unknown) is unknown
    assert of_one_depth(replace(recording, depths_mm=np.linspace(4.7, 5.3, 9))).has_position.all()
