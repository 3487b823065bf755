"""The estimator; recordings, the localizer and its features in scikit-learn."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import KFold, cross_val_predict, cross_val_score
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline

from padforge.sense import Localizer, PressWindows, Recording
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.moments import PRESS_WINDOWS
from padforge.sense.settings import LocalizerSettings
from tests.sense.conftest import few_moments, first_presses

TINY: dict[str, Any] = {"hidden": 16, "layers": 1, "epochs": 3, "batch": 64}


def test_localizer_of_arrays_scores_in_cross_validation(recording: Recording, tmp_path: Path) -> None:
    features = compute_features(recording.readings, recording.down_command, recording.up_command)
    x, y = features.windows[:, :, : len(PRESS_WINDOWS)], recording.presses_mm
    localizer = Localizer(max_failures=1, random_state=3, **TINY)
    [score] = cross_val_score(localizer, x, y, cv=[(np.arange(200), np.arange(200, 300))])
    assert -np.hypot(*(y - np.median(y, axis=0)).T).mean() < score < 0
    fitted = localizer.fit(x[:200], y[:200])
    errors = np.hypot(*(fitted.predict(x[200:]).positions_mm - y[200:]).T)
    assert score == fitted.score(x[200:], y[200:]) == pytest.approx(-errors.mean())
    assert np.median(fitted.predict(x[200:], failed=[1]).r90_mm) > np.median(fitted.predict(x[200:]).r90_mm)
    missing = x[200:].copy()
    missing[:, 1] = np.nan
    assert np.array_equal(fitted.predict(missing).positions_mm, fitted.predict(x[200:], [1]).positions_mm)
    fitted.save(tmp_path)
    assert np.array_equal(Localizer.load(tmp_path).predict(x).positions_mm, fitted.predict(x).positions_mm)
    assert cast("Localizer", clone(fitted)).get_params() == fitted.get_params()


@few_moments()
def test_localizer_fits_evaluates_and_keeps_a_recording(brief: Recording, tmp_path: Path) -> None:
    localizer = Localizer(2, split="chronological", **TINY).fit(brief)
    assert set(localizer.test_presses_) == set(localizer.model_.test)
    evaluation = localizer.evaluate(brief)
    assert evaluation.errors == localizer.calibration_.errors
    assert localizer.evaluate(brief, max_failures=0).errors == evaluation.errors[:1]
    table = evaluation.to_frame()
    assert table["n_failed"].tolist() == [0, 1, 2]
    assert table["mean_mm"].tolist() == [row["mean_mm"] for row in evaluation.errors]
    assert localizer.score(brief) < 0
    localizer.save(tmp_path)
    again = Localizer.load(tmp_path)
    assert np.array_equal(again.predict(brief, [0]).r90_mm, localizer.predict(brief, [0]).r90_mm)
    assert repr(again) == "Localizer(max_failures=2, split='chronological')"
    some = brief[10:40][[3, 5]]  # which are predicted as among all
    whole = localizer.predict(brief).positions_mm[[13, 15]]
    np.testing.assert_allclose(localizer.predict(some).positions_mm, whole, atol=1e-5)


@few_moments()
def test_localizer_and_any_regressor_are_cross_validated_on_a_recording(recording: Recording) -> None:
    localizer = Localizer(members=2, max_failures=1, **TINY | {"hidden": 8, "epochs": 1})
    assert (cross_val_score(localizer, first_presses(recording, 120), cv=KFold(2)) > -4).all()
    pipeline = make_pipeline(PressWindows(), KNeighborsRegressor())
    predicted = cross_val_predict(pipeline, recording, recording.presses_mm, cv=KFold(2))
    guess = np.abs(recording.presses_mm - recording.presses_mm.mean(axis=0)).mean()
    assert distances(np.asarray(predicted), recording.presses_mm).mean() < 0.5 * guess


def test_estimators_have_settings_as_params_print_what_differs_and_are_cloned() -> None:
    settings = LocalizerSettings(members=3, seed=7, method="published")
    localizer = Localizer.from_settings(settings)
    assert localizer.get_params() == {**settings.model_dump(exclude={"seed"}), "random_state": 7}
    assert localizer.set_params(hidden=9).get_params()["hidden"] == 9
    assert repr(Localizer()) == "Localizer()"
    assert repr(clone(Localizer(hidden=16, max_failures=1))) == "Localizer(max_failures=1, hidden=16)"
    assert repr(clone(PressWindows())) == "PressWindows()"
