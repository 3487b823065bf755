"""Presses as the pad feels them are those that were commanded, but for the way of the probe."""

import numpy as np

from sense import Recording
from sense.recordings.processing.press_alignment import as_detected


def test_found_presses_are_near_the_commanded_ones(recording: Recording) -> None:
    begun, lifted = as_detected(recording.readings, recording.times_s, recording.begun, recording.lifted)
    for found, commanded in ((begun, recording.begun), (lifted, recording.lifted)):
        off = found - commanded
        assert np.abs(off).max() <= 6
        assert 0 < np.abs(off).mean() < 3  # the simulated probe takes up to 0.35 s to be gone
    assert (lifted > begun).all()
    assert (begun[1:] >= lifted[:-1]).all()


def test_presses_that_are_not_felt_are_as_commanded(recording: Recording) -> None:
    silent = recording.readings.copy()
    first, last = int(recording.begun[10]) - 3, int(recording.begun[12]) - 10
    silent[first:last] = silent[first - 1]
    begun, lifted = as_detected(silent, recording.times_s, recording.begun, recording.lifted)
    np.testing.assert_array_equal(begun[10:12], recording.begun[10:12])
    np.testing.assert_array_equal(lifted[10:11], recording.lifted[10:11])
    flat = np.ones_like(silent)
    for found, commanded in zip(
        as_detected(flat, recording.times_s, recording.begun, recording.lifted),
        (recording.begun, recording.lifted),
        strict=True,
    ):
        np.testing.assert_array_equal(found, commanded)
