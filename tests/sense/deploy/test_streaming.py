"""The twin of the C header: windows as the features have them, averages as they are defined, touches where they are."""

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense import arrays as limits
from padforge.sense.deploy import streaming as press_stream
from padforge.sense.deploy.streaming import POLES, Detector, commanded, held, owners, seen
from padforge.sense.localizer import features


@pytest.fixture
def nothing() -> Detector:
    return Detector(np.full(4, np.inf), np.inf, 0)


def test_presses_are_seen_as_commanded_with_the_windows_of_the_features(recording, nothing) -> None:
    found = seen(recording.readings, nothing, held(recording))
    assert np.array_equal(found.down_command, recording.down_command)
    assert np.array_equal(found.ended, recording.up_command)
    assert np.array_equal(found.told, recording.down_command + press_stream.SEEN - 1)
    assert found.inputs.fibre_mask.all()
    assert (press_stream.WINDOWS, press_stream.MOST_V) == (features.DOWN, limits.MAX_VOLTS)
    assert features.REST == (-press_stream.REST, 0)
    expected = features.window_means(
        recording.readings, recording.down_command, recording.up_command, features.FEATURES["causal"]
    )
    np.testing.assert_allclose(commanded(recording).windows, expected, atol=2e-6)


def test_history_is_what_averages_were_when_the_press_began(recording: Recording, nothing: Detector) -> None:
    found = seen(recording.readings, nothing, held(recording))
    levels = np.repeat(recording.readings[:1, :, None], len(POLES), axis=2)[0]
    press = 0
    for n, row in enumerate(recording.readings[: recording.down_command[20]]):
        if n == found.down_command[press]:
            rest = recording.readings[n - press_stream.REST : n].mean(axis=0)
            np.testing.assert_allclose(found.inputs.history[press], levels - rest[:, None], atol=1e-5)
            press += 1
        levels += (row[:, None] - levels) / np.array(POLES)
    assert press == 20


def test_short_presses_and_such_without_a_pause_are_seen(recording: Recording, nothing: Detector) -> None:
    pressed = np.zeros(200, bool)
    for first, end in ((0, 3), (5, 6), (7, 8), (40, 90), (91, 92)):
        pressed[first:end] = True
    found = seen(recording.readings[:200], nothing, pressed)
    assert found.down_command.tolist() == [1, 5, 7, 40, 91]
    assert found.ended.tolist() == [3, 6, 8, 90, 92]
    assert found.told.tolist() == [3, 6, 8, 59, 92]
    assert np.isfinite(found.inputs.windows).all()
    pressed[150:] = True
    assert seen(recording.readings[:200], nothing, pressed).ended[-1] == 200


def test_the_detector_finds_what_it_never_training_recording_sha256(recording: Recording) -> None:
    found = seen(recording.readings, Detector.fit(recording, np.arange(0, 200)))
    press = owners(recording, found.down_command)
    assert np.isin(np.arange(200, 300), press).all()
    assert (press >= 0).all()
    assert np.abs(found.down_command - recording.down_command[press]).max() <= 2
    assert np.abs(found.ended[:-1] - recording.up_command[press[:-1]]).max() <= 5  # the simulated pad takes its time


def test_a_fibre_that_tells_nothing_is_no_noise(recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[:, 1], readings[:, 2] = 1.5, np.nan
    dead = Recording(readings, recording.times_s, recording.presses_mm, recording.down_command, recording.up_command)
    detector = Detector.fit(dead, np.arange(300))
    assert np.isinf(detector.noise_v[[1, 2]]).all()
    assert len(seen(readings, detector).down_command) >= 280


def test_what_lasts_too_long_is_the_new_rest(recording: Recording) -> None:
    """A fibre breaks while the pad is free: what follows is found again after that."""
    readings = np.array(recording.readings)
    readings[2012:, 0] = 0.0
    found = seen(readings, Detector.fit(recording, np.arange(300)))
    long = np.flatnonzero(found.ended - found.down_command > press_stream.LONGEST)
    assert len(long) == 1
    assert found.ended[long[0]] < recording.down_command[100]
    assert np.isin(np.arange(150, 300), owners(recording, found.down_command)).mean() > 0.9


def test_the_first_of_several_in_a_press_is_it(recording: Recording) -> None:
    first = recording.down_command[0]
    down_command = [
        first - 5,
        first - 1,
        first + 3,
        recording.up_command[0] + 2,
        recording.down_command[1],
        recording.up_command[2],
    ]
    assert owners(recording, np.array(down_command)).tolist() == [-1, 0, -1, -1, 1, -3]
