from typing import Any

from design.benchmarking import harness
from fabricate.mould import benchmark as bench


def test_every_way_stays_within_the_tolerance(monkeypatch):
    monkeypatch.setattr(bench, "GRID", 1)
    monkeypatch.setattr(bench, "KNOTS", (1, 4))
    monkeypatch.setattr(bench, "TOLERANCES_MM", (0.05, 0.01))
    monkeypatch.setattr(bench, "FUSED_UP_TO", 1)
    monkeypatch.setattr(harness, "QUICK_S", 0)
    measured = harness.BenchRounds()
    harness.measure_round(bench.BENCH, measured, lambda step: None, lambda key: False)
    rows: list[dict[str, Any]] = [
        {"case": case, "way": way, "size": size, **row} for (case, way, size, _), row in measured.found.items()
    ]
    assert len(rows) == 2 * 3 + 2 * 2
    assert {row["way"] for row in rows if row["case"] == "N=1"} == {"manifold3d", "direct CAD", "fused CAD"}
    for row in rows:
        assert 0 < row["error"] <= row["size"] / 1000  # mm and micrometres
        assert row["faces"] > 100
        assert row["file_bytes"] > 10_000
    finer = {row["way"]: row for row in rows if (row["case"], row["size"]) == ("N=4", 10)}
    coarser = {row["way"]: row for row in rows if (row["case"], row["size"]) == ("N=4", 50)}
    for way in finer:
        assert finer[way]["error"] < coarser[way]["error"]
        assert finer[way]["file_bytes"] > coarser[way]["file_bytes"]
