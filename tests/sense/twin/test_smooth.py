"""What of values is a smooth function of place, and what is noise."""

import numpy as np
import pytest

from sense.twin.responses import Responses
from sense.twin.smooth import smooth_function

PLACES = np.random.default_rng(0).uniform(-20, 20, (500, 2))
NOISE = np.random.default_rng(1).standard_normal((500, 2))
FUNCTION = 3 * np.sin(PLACES[:, 0] / 9) + np.cos(PLACES[:, 1] / 7)


def test_noise_is_told_from_a_function_of_place():
    found = smooth_function(
        Responses(PLACES, np.column_stack([FUNCTION + 0.2 * NOISE[:, 0], NOISE[:, 1]]), np.ones((500, 2), bool)), 10
    )
    assert found.noise == pytest.approx([0.2, 1.0], rel=0.12)
    assert found.certainty[0] > 100
    assert found.certainty[1] < 5


def test_what_is_missing_does_not_count():
    there = np.ones((500, 2), bool)
    there[::2, 0] = False
    there[:, 1] = np.arange(500) < 9
    volts = np.where(there, (FUNCTION + 0.2 * NOISE[:, 0])[:, None], 1e6)
    found = smooth_function(Responses(PLACES, volts, there), 10)
    assert found.noise[0] == pytest.approx(0.2, rel=0.15)
    assert np.isnan(found.noise[1])
    assert found.certainty[1] == 0
