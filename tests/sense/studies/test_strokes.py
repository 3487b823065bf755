"""What the study of strokes measures of a localizer that always predicts the same."""

from types import SimpleNamespace

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import Localization
from padforge.sense.studies.strokes import SPEEDS_MM_S, strokes_study


def test_errors_are_those_of_where_the_finger_is_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a finger at rest they stay; each is within r90, and beyond r50; at the end it is where it was lifted."""

    def localize(features: PressFeatures) -> Localization:
        count = len(features.windows)
        return Localization(np.zeros((count, 2)), np.ones((count, 2)), np.full(count, 1e-9), np.full(count, 1e3))

    model = SimpleNamespace(scaler=SimpleNamespace(transform=lambda features: features), predict_features=localize)
    monkeypatch.setattr("padforge.sense.studies.strokes.fit_recording", lambda *_: model)
    state = strokes_study({"pad": Morphology.straight(2)}, presses=40, strokes=3).tasks[0].compute()
    assert state["errors"].shape[::2] == state["lifted"].shape == (len(SPEEDS_MM_S), 3)
    assert state["within"].all()
    np.testing.assert_allclose(np.ptp(state["errors"][0], axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(state["errors"][:, -1], state["lifted"])
    assert (np.ptp(state["errors"][1:], axis=1) > 0.5).all()
