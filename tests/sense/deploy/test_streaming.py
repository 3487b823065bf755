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
    N_WINDOWS,
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
from padforge.sense.localizer.features import N_TIMED, NOW, compute_features
from padforge.sense.localizer.moments import complete_at

UNUSED = ThresholdDetector(np.full(4, np.inf), np.inf, 0)


def test_stream_presses_as_commanded_gives_the_features_of_every_moment(recording: Recording) -> None:
    commands = recording.down_command, recording.up_command
    presses = stream_presses(recording.readings, UNUSED, commanded_presses(recording))
    assert np.array_equal(presses.down_command, commands[0])
    assert np.array_equal(presses.ended, commands[1])
    readings = [np.arange(down + 1, min(up + 1, len(recording.readings))) for down, up in zip(*commands, strict=True)]
    assert np.array_equal(presses.reading, np.concatenate(readings))
    assert np.array_equal(presses.press, np.repeat(np.arange(300), [len(each) for each in readings]))
    assert np.array_equal(presses.n_readings[presses.last][:-1], (commands[1] - commands[0])[:-1])
    assert presses.features.fibre_mask.all()
    own, numbers = slice(N_WINDOWS), np.arange(300)
    for n_readings in (2, 3, 7, 9, 16, 19, 20, None):  # of every press so far, to its end if None
        if n_readings is None:
            rows, until = presses.last, commands[1]
        else:
            rows = np.searchsorted(presses.press, numbers) + n_readings - 2
            until = presses.reading[rows] + 1
            assert (presses.n_readings[rows] == n_readings).all()
            assert np.array_equal(presses.press[rows], numbers)
        expected, features = compute_features(recording.readings, *commands, until), presses.features[rows]
        assert np.array_equal(features.seen, expected.seen[:, own])
        seen = features.seen[:, None]
        np.testing.assert_allclose(features.windows[:, :, own], seen * expected.windows[:, :, own], atol=2e-6)
        now = slice(N_TIMED, N_TIMED + len(NOW))
        np.testing.assert_allclose(features.windows[:, :, N_WINDOWS:], expected.windows[:, :, now], atol=2e-6)


def test_commanded_features_are_those_when_windows_are_complete(recording: Recording) -> None:
    commands = recording.down_command, recording.up_command
    for n_complete in (1, 4, 9):
        until = complete_at(n_complete, *commands)
        features = commanded_features(recording, n_complete)
        expected = compute_features(recording.readings, *commands, until)
        assert np.array_equal(features.seen, expected.seen[:, :N_WINDOWS])
        now = expected.windows[:, :, N_TIMED : N_TIMED + len(NOW)]
        np.testing.assert_allclose(features.windows[:, :, N_WINDOWS:], now, atol=2e-6)


def test_stream_presses_keeps_the_windows_of_a_long_press(recording: Recording) -> None:
    pressed = np.zeros(1000, bool)
    pressed[100:900] = True
    presses = stream_presses(recording.readings[:1000], UNUSED, pressed)
    assert np.array_equal(presses.reading, np.arange(101, 901))
    used = [*range(N_WINDOWS), *range(N_TIMED, N_TIMED + len(NOW))]
    for n_readings in (20, 21, 30, 33, 500, 800):
        features = presses.features[np.array([n_readings - 2])]
        commands = np.array([100]), np.array([900]), np.array([100 + n_readings])
        expected = compute_features(recording.readings[:1000], *commands)
        np.testing.assert_allclose(features.windows, expected.windows[:, :, used], atol=2e-6)


def test_history_is_the_averages_at_the_begin_of_the_press(recording: Recording) -> None:
    presses = stream_presses(recording.readings, UNUSED, commanded_presses(recording))
    history = presses.features.history[presses.last]
    levels = np.repeat(recording.readings[:1, :, None], len(TIME_CONSTANTS), axis=2)[0]
    press = 0
    for n, row in enumerate(recording.readings[: recording.down_command[20]]):
        if n == presses.down_command[press]:
            rest = recording.readings[n - N_REST : n].mean(axis=0)
            np.testing.assert_allclose(history[press], levels - rest[:, None], atol=1e-5)
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
    assert presses.reading[presses.last].tolist() == [3, 6, 8, 90, 92]
    assert np.bincount(presses.press).tolist() == [2, 1, 1, 50, 1]
    assert presses.features.seen[presses.last].all()
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
