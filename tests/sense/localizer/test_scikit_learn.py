"""Recordings, the localizer and its features in scikit-learn."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import KFold, cross_val_predict, cross_val_score
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline

from padforge import InputError
from padforge.sense import Localizer, PressWindows, Recording
from padforge.sense.localizer.evaluation import distances
from tests.sense.conftest import first_presses

OPTIONS = {"members": 2, "hidden": 8, "layers": 1, "epochs": 1, "batch": 64, "max_failures": 1}


def test_localizer_is_cross_validated_on_a_recording(recording: Recording) -> None:
    scores = cross_val_score(Localizer(**OPTIONS), first_presses(recording, 120), cv=KFold(2))
    assert scores.shape == (2,)
    assert (scores > -4).all()


def test_any_regressor_follows_the_windows(recording: Recording) -> None:
    pipeline = make_pipeline(PressWindows(), KNeighborsRegressor())
    predicted = cross_val_predict(pipeline, recording, recording.presses_mm, cv=KFold(2))
    guess = np.abs(recording.presses_mm - recording.presses_mm.mean(axis=0)).mean()
    assert distances(np.asarray(predicted), recording.presses_mm).mean() < 0.5 * guess


def test_windows_need_positions_and_a_fit(recording: Recording) -> None:
    with pytest.raises(InputError, match="not fitted"):
        PressWindows().transform(recording)
    with pytest.raises(InputError, match=r"expected \(300, 2\)"):
        PressWindows().fit(recording, np.zeros((3, 2)))


def test_selected_presses_are_those_of_the_whole(brief: Recording) -> None:
    localizer = Localizer(**OPTIONS | {"members": 1}).fit(brief)
    some = brief[10:40][[3, 5]]
    np.testing.assert_array_equal(some.presses_mm, brief.presses_mm[[13, 15]])
    whole = localizer.predict(brief).positions_mm[[13, 15]]
    np.testing.assert_allclose(localizer.predict(some).positions_mm, whole, atol=1e-6)
    assert set(localizer.test_presses_) == set(localizer.model_.test)


def test_estimators_print_what_differs_and_are_cloned() -> None:
    assert repr(Localizer()) == "Localizer()"
    assert repr(clone(Localizer(hidden=16, max_failures=1))) == "Localizer(max_failures=1, hidden=16)"
    assert repr(clone(PressWindows())) == "PressWindows()"
