"""The study of strokes: what it makes of the errors of its tasks."""

from typing import Any

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense.settings import RigSettings
from padforge.sense.studies.strokes import SPEEDS_MM_S, strokes_study


def test_strokes_study_compares_errors_after_the_first_fifth_with_those_at_rest() -> None:
    """Ten readings: the first two, which tell little, do not count; a speed errs as much more as its number says."""
    speeds = len(SPEEDS_MM_S)
    errors = np.full((speeds, 10, 2), 2.0) + np.array([-0.5, 0.5])  # of two strokes
    errors *= np.arange(1, speeds + 1)[:, None, None]
    errors[:, :2] = 100.0
    within = np.zeros((speeds, 10, 2), bool)
    within[:, :2] = within[1, 2:6] = True
    lifted = np.arange(2.0 * speeds).reshape(speeds, 2)
    study = strokes_study({"a": Morphology.straight(2)})
    result = study.conclude([{"errors": errors, "within": within, "lifted": lifted}])
    assert [row["speed_mm_s"] for row in result.rows] == list(SPEEDS_MM_S)
    assert [row["mean_mm"] for row in result.rows] == pytest.approx(2.0 * np.arange(1, speeds + 1))
    assert [row["ratio"] for row in result.rows] == pytest.approx(np.arange(1, speeds + 1))
    assert [row["within_r90"] for row in result.rows] == [0, 0.5, 0, 0, 0]
    assert [row["lifted_mm"] for row in result.rows] == pytest.approx(0.5 + 2 * np.arange(speeds))
    document = {"title": study.title, "rows": result.rows, **result.extra}
    rested: Any = study.draw(document).axes[0].lines[0]
    rate_hz = RigSettings().rate_hz
    np.testing.assert_allclose(rested.get_xdata(), np.arange(1, 11) / rate_hz)  # a reading after the touch shows it
    np.testing.assert_allclose(rested.get_ydata()[2:], 2.0)
