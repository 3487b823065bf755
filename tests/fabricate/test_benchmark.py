from dataclasses import replace
from typing import Any

import pytest

from padforge.benchmarks import mould as bench
from padforge.design.morphology import Morphology
from padforge.fabricate.cad.curves import FINE_MM
from padforge.fabricate.cad.model import FIT_TOLERANCES_MM, build_mould
from padforge.fabricate.settings import DEFAULTS, MouldSettings


@pytest.mark.slow
def test_deviation_is_within_tolerance_and_detects_shifted_walls(monkeypatch):
    for key, value in {"GRID": 1, "KNOTS": (1,), "TOLERANCES_MM": (0.05,)}.items():
        monkeypatch.setattr(bench, key, value)
    trials = {trial.way: trial for trial in bench.trials()}
    assert set(trials) == {"manifold3d", "fused CAD", "curved CAD"}
    for way, trial in trials.items():
        row: dict[str, Any] = {**trial.evaluate(trial.work())}
        curved = way == "curved CAD"
        drawn = 1000 * FINE_MM if curved else 0  # it follows outlines that are drawn so finely
        assert 0 < row["error"] <= (trial.size + drawn) / 1000  # mm and micrometres
        assert row["faces"] > (40 if curved else 60)
        assert row["file_bytes"] > 10_000
    wider = MouldSettings(number_mm=0, ridge_width_mm=DEFAULTS.mould.ridge_width_mm + 0.01)
    pad = Morphology.random(1, 1, bench.SEED)
    strayed = build_mould(pad, replace(DEFAULTS, mould=wider))
    assert trials["curved CAD"].evaluate(strayed)["error"] == pytest.approx(0.005, abs=FIT_TOLERANCES_MM[0] + FINE_MM)
