"""The Python twin of the C header: features as the localizer has them, averages as defined, touches as commanded."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.deploy.streaming import (
    CODE_BYTES,
    HIDDEN_STEP,
    MAX_PRESS,
    N_REST,
    PRESS,
    TIME_CONSTANTS,
    MemoryBudget,
    ThresholdDetector,
    commanded_features,
    commanded_presses,
    match_presses,
    max_hidden,
    state_bytes,
    stream_presses,
    table_bytes,
)
from padforge.sense.localizer.features import compute_features

UNUSED = ThresholdDetector(np.full(4, np.inf), np.inf, 0)


def test_stream_presses_as_commanded_gives_the_windows_of_causal_features(recording) -> None:
    presses = stream_presses(recording.readings, UNUSED, commanded_presses(recording))
    assert np.array_equal(presses.down_command, recording.down_command)
    assert np.array_equal(presses.ended, recording.up_command)
    assert np.array_equal(presses.estimated, recording.down_command + PRESS - 1)
    assert presses.features.fibre_mask.all()
    expected = compute_features(recording.readings, recording.down_command, recording.up_command, "causal")
    np.testing.assert_allclose(commanded_features(recording).windows, expected.windows, atol=2e-6)


def test_history_is_the_averages_at_the_begin_of_the_press(recording: Recording) -> None:
    presses = stream_presses(recording.readings, UNUSED, commanded_presses(recording))
    levels = np.repeat(recording.readings[:1, :, None], len(TIME_CONSTANTS), axis=2)[0]
    press = 0
    for n, row in enumerate(recording.readings[: recording.down_command[20]]):
        if n == presses.down_command[press]:
            rest = recording.readings[n - N_REST : n].mean(axis=0)
            np.testing.assert_allclose(presses.features.history[press], levels - rest[:, None], atol=1e-5)
            press += 1
        levels += (row[:, None] - levels) / np.array(TIME_CONSTANTS)
    assert press == 20


def test_stream_presses_handles_short_presses_without_pauses(recording: Recording) -> None:
    pressed = np.zeros(200, bool)
    for first, end in ((0, 3), (5, 6), (7, 8), (40, 90), (91, 92)):
        pressed[first:end] = True
    presses = stream_presses(recording.readings[:200], UNUSED, pressed)
    assert presses.down_command.tolist() == [1, 5, 7, 40, 91]
    assert presses.ended.tolist() == [3, 6, 8, 90, 92]
    assert presses.estimated.tolist() == [3, 6, 8, 59, 92]
    assert np.isfinite(presses.features.windows).all()
    pressed[150:] = True
    assert stream_presses(recording.readings[:200], UNUSED, pressed).ended[-1] == 200


def test_threshold_detector_detects_presses_not_fitted_to(recording: Recording) -> None:
    presses = stream_presses(recording.readings, ThresholdDetector.fit(recording, np.arange(0, 200)))
    press = match_presses(recording, presses.down_command)
    assert np.isin(np.arange(200, 300), press).all()
    assert (press >= 0).all()
    assert np.abs(presses.down_command - recording.down_command[press]).max() <= 2
    # The simulated pad takes its time.
    assert np.abs(presses.ended[:-1] - recording.up_command[press[:-1]]).max() <= 5


def test_threshold_detector_ignores_dead_fibres(recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[:, 1], readings[:, 2] = 1.5, np.nan
    detector = ThresholdDetector.fit(replace(recording, readings=readings), np.arange(300))
    assert np.isinf(detector.noise_v[[1, 2]]).all()
    assert len(stream_presses(readings, detector).down_command) >= 280


def test_threshold_detector_takes_a_long_press_for_a_new_rest(recording: Recording) -> None:
    """A fibre breaks while the pad is free; presses are detected again after that."""
    readings = np.array(recording.readings)
    readings[2012:, 0] = 0.0
    presses = stream_presses(readings, ThresholdDetector.fit(recording, np.arange(300)))
    long = np.flatnonzero(presses.ended - presses.down_command > MAX_PRESS)
    assert len(long) == 1
    assert presses.ended[long[0]] < recording.down_command[100]
    assert np.isin(np.arange(150, 300), match_presses(recording, presses.down_command)).mean() > 0.9


def test_match_presses_takes_the_first_detection(recording: Recording) -> None:
    down, up = recording.down_command, recording.up_command
    detected = [down[0] - 5, down[0] - 1, down[0] + 3, up[0] + 2, down[1], up[2]]
    assert match_presses(recording, np.array(detected)).tolist() == [-1, 0, -1, -1, 1, -3]


@pytest.mark.parametrize("quantized", [False, True])
@pytest.mark.parametrize(("flash", "ram"), [(20_000, 65_536), (262_144, 2_000), (150_000, 8_192)])
def test_max_hidden_is_the_largest_within_the_budget(flash: int, ram: int, quantized: bool) -> None:
    hidden = max_hidden(6, 0, 4, MemoryBudget(flash, ram, quantized))
    fits = [
        CODE_BYTES + table_bytes(6, 0, 4, size, quantized) <= flash and state_bytes(6, 0, size) <= ram
        for size in (hidden, hidden + HIDDEN_STEP)
    ]
    assert fits == [True, False]
