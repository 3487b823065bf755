"""Learning curves: the power law is recovered, the forecast follows, and an interrupt ends it at once."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense import Recording
from padforge.sense.localizer import response_model
from padforge.sense.settings import LocalizerSettings as Options
from padforge.sense.studies import learning_curve as study
from padforge.sense.studies.learning_curve import fit_power_law, learning_curve, power_law
from tests.helpers.constants import with_constants
from tests.helpers.door import called
from tests.helpers.golden import Golden, json_text

QUICK = Options(hidden=8, layers=1, epochs=1, batch=64, max_failures=0)


@settings(max_examples=20)
@given(floor=st.floats(0, 2), factor=st.floats(0.5, 100), exponent=st.sampled_from([0.2, 0.4, 0.5, 0.75, 1.0]))
def test_fit_power_law_recovers_power_laws(floor: float, factor: float, exponent: float) -> None:
    presses = np.array([50.0, 100, 200, 400, 800])
    target, true = np.array([1600.0]), (floor, factor, exponent)
    forecast = power_law(target, fit_power_law(presses, power_law(presses, true)))
    np.testing.assert_allclose(forecast, power_law(target, true), rtol=1e-3)


@settings(max_examples=20)
@given(errors=st.lists(st.floats(0.1, 10), min_size=5, max_size=5))
def test_fit_power_law_never_rises(errors: list[float]) -> None:
    presses = np.array([50.0, 100, 200, 400, 800])
    fit = fit_power_law(presses, np.array(errors))
    assert (np.diff(power_law(np.geomspace(50, 3200, 9), fit)) <= 1e-9).all()
    assert min(fit) >= 0


quick = with_constants((study, {"RESAMPLINGS": 20}), (response_model, {"RBF_SIDE": 7}))


class Trained:
    """Stands in for a localizer of n presses, which errs by 1 + 8 / sqrt(n) mm, by press more or less."""

    def __init__(self, recording: Recording, training: np.ndarray, *_: object) -> None:
        self.presses_mm, self.n = recording.presses_mm, len(training)

    def scaled_features(self, recording: Recording) -> np.ndarray:
        return np.arange(len(recording.presses_mm))

    def predict_features(self, rows: np.ndarray) -> Any:
        error_mm = (1 + 8 / np.sqrt(self.n)) * (1 + np.sin(rows * self.n) / 2)
        return SimpleNamespace(positions_mm=self.presses_mm[rows] + np.column_stack([error_mm, 0 * error_mm]))


def test_learning_curve_command_writes_document_and_figure(
    recording: Recording, golden: Golden, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors are those of the test presses alone, and the interval is that of 80 % of the resamplings."""
    monkeypatch.setattr(study, "fit_recording", Trained)
    recording.save(tmp_path / "rec", {})
    ended = called("sense", "learning-curve", "rec", "--out", "out", "--json", cwd=tmp_path)
    document = json.loads(ended.out)
    assert (ended.code, document) == (0, json.loads((tmp_path / "out/learning_curve.json").read_text()))
    assert (tmp_path / "out/learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    assert document.pop("provenance")["inputs"] == {"recording": recording.digest}
    golden("studies/learning_curve.json", json_text(document))
    for point in document["points"]:
        assert point["mean_mm"] == pytest.approx(1 + 8 / np.sqrt(point["presses"]), rel=0.15)


def test_interrupt_ends_a_learning_curve_at_once(recording: Recording) -> None:
    long, shares = QUICK.model_copy(update={"epochs": 1000}), []

    def interrupt(done: int, total: int, what: str) -> None:
        shares.append(done / total)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learning_curve(recording, long, on_progress=interrupt)
    assert max(shares) < 0.5
