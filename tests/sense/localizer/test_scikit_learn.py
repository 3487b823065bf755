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
from tests.sense.conftest import QUICK

OPTIONS = QUICK.model_dump(include={"members", "hidden", "layers", "epochs", "batch"})


def test_localizer_is_cross_validated_on_a_recording(recording: Recording) -> None:
    scores = cross_val_score(Localizer(**OPTIONS), recording, cv=KFold(2))
    assert scores.shape == (2,)
    assert (scores > -4).all()


def test_presses_of_one_fold_do_not_help_those_of_another(recording: Recording) -> None:
    """A localizer of the presses on the left is wrong on the right."""
    left = recording.presses_mm[:, 0] < 0
    localizer = Localizer(**OPTIONS).fit(recording[left])
    assert localizer.score(recording[left]) > -4 > localizer.score(recording[~left])
    assert localizer.test_presses_.size == 0


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


def test_selected_presses_are_those_of_the_whole(recording: Recording) -> None:
    localizer = Localizer(**OPTIONS | {"epochs": 2}).fit(recording)
    some = recording[10:40][[3, 5]]
    np.testing.assert_array_equal(some.presses_mm, recording.presses_mm[[13, 15]])
    np.testing.assert_allclose(
        localizer.predict(some).positions_mm, localizer.predict(recording).positions_mm[[13, 15]], atol=1e-6
    )
    assert set(localizer.test_presses_) == set(localizer.model_.test)


def test_estimators_print_what_differs_and_are_cloned() -> None:
    assert repr(Localizer()) == "Localizer()"
    assert repr(clone(Localizer(hidden=16, max_failures=1))) == "Localizer(max_failures=1, hidden=16)"
    assert repr(clone(PressWindows())) == "PressWindows()"
