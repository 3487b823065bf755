from dataclasses import replace
from typing import Any

import pytest

from design.benchmarking import harness
from design.pad.morphology import Morphology
from fabricate.mould import benchmark as bench
from fabricate.mould.cad.model import FITS_MM, mould_model
from fabricate.mould.cad.outlines.pieces import FINE_MM
from fabricate.mould.plan import Plan
from fabricate.settings import DEFAULTS, MouldSettings


@pytest.mark.slow
def test_every_way_stays_within_the_tolerance(monkeypatch):
    monkeypatch.setattr(bench, "GRID", 1)
    monkeypatch.setattr(bench, "KNOTS", (1, 2))
    monkeypatch.setattr(bench, "TOLERANCES_MM", (0.05,))
    monkeypatch.setattr(bench, "FUSED_UP_TO", 1)
    monkeypatch.setattr(harness, "QUICK_S", 0)
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    rows: list[dict[str, Any]] = [
        {"case": case, "way": way, "size": size, **row} for (case, way, size, _), row in measured.found.items()
    ]
    assert len(rows) == (3 + 1) + (2 + 1)
    assert {row["way"] for row in rows if row["case"] == "N=1"} == {
        "manifold3d",
        "direct CAD",
        "fused CAD",
        "curved CAD",
    }
    for row in rows:
        curved = row["way"] == "curved CAD"
        drawn = 1000 * FINE_MM if curved else 0  # it follows outlines that are drawn so finely
        assert 0 < row["error"] <= (row["size"] + drawn) / 1000  # mm and micrometres
        assert row["faces"] > (40 if curved else 100)
        assert row["file_bytes"] > 10_000


def test_walls_that_stray_are_seen(monkeypatch):
    monkeypatch.setattr(bench, "GRID", 1)
    monkeypatch.setattr(bench, "KNOTS", (1,))
    curved = {trial.way: trial for trial in bench.trials()}["curved CAD"]
    mould = MouldSettings(number_mm=0)
    wider = mould.model_copy(update={"ridge_width_mm": mould.ridge_width_mm + 0.01})
    pad = Morphology.random(1, 1, bench.SEED)
    strayed = mould_model(Plan(pad, replace(DEFAULTS, mould=wider)), "mould").shape
    assert curved.judge(strayed)["error"] == pytest.approx(0.005, abs=FITS_MM[0] + FINE_MM)
