"""The estimator: fitted to recordings and arrays, within scikit-learn's tools, and read back from files."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import cross_val_score

from padforge.design.common.validation import InputError
from padforge.sense import Localizer, Recording
from padforge.sense.localizer.features import compute_features
from padforge.sense.settings import LocalizerSettings

TINY: dict[str, Any] = {"hidden": 16, "layers": 1, "epochs": 5, "batch": 64}


@pytest.fixture(scope="module")
def arrays(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    features = compute_features(recording.readings, recording.down_command, recording.up_command, "causal")
    return features.windows, recording.presses_mm


def test_localizer_scores_in_cross_validation(arrays: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    x, y = arrays
    localizer = Localizer(max_failures=1, random_state=3, **TINY)
    scores = cross_val_score(localizer, x, y, cv=3)
    trivial = np.hypot(*(y - np.median(y, axis=0)).T).mean()
    assert ((-0.8 * trivial < scores) & (scores < 0)).all()
    fitted = localizer.fit(x[:200], y[:200])
    errors = np.hypot(*(fitted.predict(x[200:]).positions_mm - y[200:]).T)
    assert fitted.score(x[200:], y[200:]) == pytest.approx(-errors.mean())
    assert fitted.predict(x[200:], failed=[1]).r90_mm.mean() > fitted.predict(x[200:]).r90_mm.mean()
    missing = x[200:].copy()
    missing[:, 1] = np.nan
    assert np.array_equal(fitted.predict(missing).positions_mm, fitted.predict(x[200:], [1]).positions_mm)
    fitted.save(tmp_path)
    for again in (cast("Localizer", clone(fitted)).fit(x[:200], y[:200]), Localizer.load(tmp_path)):
        assert np.array_equal(again.predict(x).positions_mm, fitted.predict(x).positions_mm)


def test_localizer_fits_evaluates_and_keeps_a_recording(brief: Recording, tmp_path: Path) -> None:
    localizer = Localizer(2, features="causal", split="chronological", **TINY).fit(brief)
    rows = localizer.evaluate(brief)
    assert rows == localizer.calibration_["errors"]
    assert [row["n_failed"] for row in rows] == [0, 1, 2]
    assert localizer.evaluate(brief, max_failures=0) == rows[:1]
    assert localizer.score(brief) < 0
    localizer.save(tmp_path)
    again = Localizer.load(tmp_path)
    assert np.array_equal(again.predict(brief, [0]).r90_mm, localizer.predict(brief, [0]).r90_mm)
    params = again.get_params()
    assert [params[name] for name in ("max_failures", "features", "split")] == [2, "causal", "chronological"]


def test_localizer_params_are_settings() -> None:
    settings = LocalizerSettings(members=3, seed=7, method="published")
    localizer = Localizer.from_settings(settings)
    assert localizer.get_params() == {**settings.model_dump(exclude={"seed"}), "random_state": 7}
    assert localizer.set_params(hidden=9).get_params()["hidden"] == 9
    with pytest.raises(InputError, match="no option depth"):
        Localizer(depth=3)


def test_localizer_refuses_unfit_input(brief: Recording, arrays: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = arrays
    with pytest.raises(InputError, match="not fitted"):
        Localizer().predict(brief)
    for bad, target, message in (
        (x[:, :, 0], y, r"X has shape \(300, 4\)"),
        (x, None, "y has shape"),
        (x[:9], y, "X has 9 presses and y 300"),
        (brief, y, "y is given beside a recording"),
    ):
        with pytest.raises(InputError, match=message):
            Localizer(**TINY).fit(bad, target)
    fitted = Localizer(members=1, **TINY).fit(x[:40], y[:40])
    with pytest.raises(InputError, match="fitted to arrays"):
        fitted.predict(brief)
    with pytest.raises(InputError, match=r"expected a recording, or \(Q, C, F\)"):
        fitted.predict(x[:, :, :2])
