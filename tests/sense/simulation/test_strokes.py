"""Simulated strokes."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import RigSettings, simulate
from padforge.sense.settings import IDEAL_RIG
from padforge.sense.simulation.strokes import simulate_strokes

QUIET = IDEAL_RIG.model_copy(update={"presses": 8, "noise_mv": 0.0, "drift_mv": 0.0, "scatter": 0.0, "hysteresis": 0.0})


@pytest.fixture(scope="module")
def pad() -> Morphology:
    return Morphology.random(3, knots=5, seed=0)


def test_a_stroke_reads_as_a_press_where_the_finger_is(pad: Morphology) -> None:
    """On the pad of a simulated recording, whose fibres rest alike."""
    strokes = simulate_strokes(pad, QUIET, Contact(), 20.0, 3, np.random.default_rng(0))
    recording = strokes.recording
    np.testing.assert_array_equal(recording.readings[:19], simulate(pad, QUIET).readings[:19])
    held = recording.up_command[0] - recording.down_command[0]
    for stroke in range(3):
        for reading in (held // 2, held - 1):
            x, y = strokes.positions_mm[stroke, reading]
            volts = recording.readings[recording.down_command[stroke] + reading]
            resting = simulate_strokes(pad, QUIET, Contact(), 0.0, 1, _FixedStart((x, y)))  # type: ignore[arg-type]
            expected = resting.recording.readings[resting.recording.down_command[0] + reading]
            assert np.allclose(volts, expected, atol=1.7e-3)  # two steps of the converter


class _FixedStart:
    """A generator that starts the only stroke at a position."""

    def __init__(self, position: tuple[float, float]) -> None:
        self._position = position

    def uniform(self, low: object, high: object, size: object) -> np.ndarray:
        return np.array([self._position]) if isinstance(size, tuple) else np.zeros(8)


@pytest.mark.parametrize("speed", [0.0, 10.0, 50.0])
def test_strokes_go_straight_at_their_speed_and_stay_on_the_pad(pad: Morphology, speed: float) -> None:
    rig = RigSettings(presses=8)
    strokes = simulate_strokes(pad, rig, Contact(), speed, 20, np.random.default_rng(1))
    steps = np.diff(strokes.positions_mm, axis=1)
    assert np.allclose(steps, steps[:, :1])
    speeds = np.hypot(*steps[:, 0].T) * rig.rate_hz
    assert (speeds <= speed * (1 + 1e-9)).all()
    assert np.median(speeds) == pytest.approx(speed) or speed > 20
    assert np.abs(strokes.positions_mm).max() <= 1.5 * pad.unit_mm  # from the middle of what is sensed
    np.testing.assert_array_equal(strokes.recording.presses_mm, strokes.positions_mm[:, -1])  # where they end
