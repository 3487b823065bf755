import numpy as np
import pytest

from padforge.benchmarks import calibration
from padforge.design import Morphology
from padforge.sense import RigSettings, simulate


@pytest.mark.slow
def test_errors_of_each_way_are_those_of_presses_never_trained_on(monkeypatch) -> None:
    for name, value in {"TEST": 40, "EPOCHS": (2,), "MAX_FAILURES": 1}.items():
        monkeypatch.setattr(calibration, name, value)
    monkeypatch.setattr(calibration, "WAYS", {"small": {"hidden": 16, "layers": 1}})
    recording = simulate(Morphology.straight(3), RigSettings(presses=140, seed=0))
    bayesian, small = calibration.trials("case", recording, 100)
    assert [bayesian["way"], small["way"], small["size"]] == ["Bayesian alone", "small", 2]
    centre_mm = np.hypot(*(recording.presses_mm - recording.presses_mm.mean(axis=0)).T).mean()
    for row in (bayesian, small):
        assert len(row["errors"]) == 2
        assert row["errors"][0] < row["errors"][1] < centre_mm
        assert row["error"] == pytest.approx(np.sqrt(np.prod(row["errors"])))
