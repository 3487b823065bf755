"""Rectangular pads with keep-outs, from the simulated recording to the localization, in mm."""

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.design.settings import PadSettings
from padforge.sense import calibrate
from padforge.sense.settings import LocalizerSettings, RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.sense.conftest import few_moments

KEEP_OUT = ((2.0, -6.0), (9.0, -6.0), (9.0, 6.0), (2.0, 6.0))
SIZE = PadSettings(horizontals=3, verticals=2, pitch_mm=(8.0, 15.0), keep_out_mm=(KEEP_OUT,))
QUICK = LocalizerSettings(members=1, hidden=32, layers=2, epochs=10, batch=64, max_failures=1)


@few_moments()
def test_localization_of_a_rectangular_pad_is_in_mm() -> None:
    recording = simulate(
        Morphology.random(SIZE.layout, knots=3, seed=2), RigSettings(presses=250, seed=1), pad_settings=SIZE
    )
    localizer, evaluation = calibrate(recording, QUICK)
    localization = localizer.predict(recording)
    errors = np.linalg.norm(localization.positions_mm - recording.presses_mm, axis=1)
    assert errors.mean() < 3.0  # of a pad of 24 by 60 mm
    test = np.array(evaluation.test["pressed_mm"]) - evaluation.test["predicted_mm"]
    assert evaluation.errors[0]["mean_mm"] == pytest.approx(np.linalg.norm(test, axis=1).mean(), rel=1e-6)
    within = [np.mean(errors <= radius) for radius in (localization.r50_mm, localization.r90_mm)]
    assert within == pytest.approx([0.5, 0.9], abs=0.2)
