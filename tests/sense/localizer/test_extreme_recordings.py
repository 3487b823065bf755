"""Readings as pads give them at their worst: results are finite, or one line says why there is none."""

import json
from typing import Any

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording, calibrate, evaluate
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.settings import LocalizerSettings
from tests.sense.health.pads import faulty

TINY = LocalizerSettings(members=1, hidden=8, layers=1, epochs=1, batch=64, max_failures=1, test_share=0.3)


def worst(seed: int, recording: Recording) -> Recording:
    """Its readings with faults, and its presses oddly placed, timed or short."""
    rng = np.random.default_rng(seed)
    places, down_command = recording.presses_mm.copy(), recording.down_command.copy()
    up_command = recording.up_command.copy()
    times_s = recording.times_s
    match rng.integers(7):
        case 0:
            places[:] = places[0]
        case 1:  # on a line
            places[:, 1] = 0
        case 2:
            places[rng.random(len(places)) < rng.choice([0.1, 0.6])] = np.nan
        case 3:  # twice
            places[1::2] = places[::2]
        case 4:
            places *= rng.choice([1e-12, 1e-300, 2e3])
        case 5:
            places[-1] = 1e5
    if rng.random() < 0.3:  # a pause
        times_s = times_s + np.where(np.arange(len(times_s)) > len(times_s) // 2, rng.choice([10.0, 1e6]), 0.0)
    if rng.random() < 0.3:  # as short as they may be
        up_command = down_command + 1
    if rng.random() < 0.2:  # at the very ends
        down_command[0], up_command[-1] = 1, len(times_s)
    return Recording(faulty(rng, recording.readings), times_s, places, down_command, up_command)


def require_finite(localizer: LocalizerModel, recording: Recording, document: Any = ()) -> None:
    for readings in (0, 3, 20, 22, None):
        found = localizer.predict(recording, until=None if readings is None else recording.down_command + readings)
        assert np.isfinite(np.column_stack([found.positions_mm, found.std_mm, found.r50_mm, found.r90_mm])).all()
        assert (found.std_mm > 0).all()
        assert (found.r50_mm > 0).all()
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize("seed", range(6))
def test_predict_and_evaluate_stay_finite(localizer: LocalizerModel, brief: Recording, seed: int) -> None:
    one = worst(seed, brief)
    require_finite(localizer, one, evaluate(localizer, one, (0, 3)).to_dict() if one.has_position.any() else ())


@pytest.mark.parametrize(("seed", "method"), list(enumerate([*["ensemble"] * 3, "published"])))
def test_calibrate_learns_or_refuses(brief: Recording, seed: int, method: str) -> None:
    one = worst(seed, brief)
    try:
        localizer, evaluation = calibrate(one, TINY.model_copy(update={"method": method}))
    except InputError:
        return
    require_finite(localizer, one, evaluation.to_dict())
