"""Of a simulated recording is found how strongly it drifts, and what its silicone keeps; of too little, nothing."""

from typing import Any

import numpy as np
import pytest

from design import Morphology
from sense import Recording, RigSettings, simulate
from sense.recordings.simulation.strengths import strengths

PAD = Morphology.straight(2)


@pytest.mark.parametrize(
    ("noise_mv", "drift_mv", "hysteresis", "hysteresis_s"), [(1.8, 12.0, 0.4, 15.0), (3.0, 25.0, 0.3, 6.0)]
)
def test_what_a_simulation_was_told_is_found(
    noise_mv: float, drift_mv: float, hysteresis: float, hysteresis_s: float
) -> None:
    told: dict[str, Any] = {
        "noise_mv": noise_mv,
        "drift_mv": drift_mv,
        "hysteresis": hysteresis,
        "hysteresis_s": hysteresis_s,
    }
    found = strengths(simulate(PAD, RigSettings(presses=1500, **told)))
    assert found["noise_mv"] == pytest.approx(noise_mv, rel=0.05)
    assert found["drift_mv"] == pytest.approx(drift_mv, rel=0.3)
    assert found["hysteresis"] == pytest.approx(hysteresis, rel=0.2)
    assert found["hysteresis_s"] == pytest.approx(hysteresis_s, rel=0.35)


def test_channels_that_miss_readings_or_never_change_do_not_count() -> None:
    recording = simulate(PAD, RigSettings(presses=200))
    spoilt = np.column_stack([recording.readings, np.full(len(recording.readings), 1.5), recording.readings[:, 0]])
    spoilt[1000, 5] = np.nan
    presses = {name: getattr(recording, name) for name in ("presses_mm", "begun", "lifted")}
    assert strengths(Recording(spoilt, recording.times_s, **presses)) == strengths(recording)
    assert strengths(Recording(spoilt[:, 4:], recording.times_s, **presses)) == {}


def test_few_presses_tell_nothing() -> None:
    assert strengths(simulate(PAD, RigSettings(presses=90))) == {}
