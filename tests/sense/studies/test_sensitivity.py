from pathlib import Path

import pytest

from design import Morphology
from sense.studies import sensitivity
from sense.studies.sensitivity import sensitivity_study
from sense.studies.study import run


def test_a_larger_object_is_located_better_and_a_strange_one_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("SIDE", 16), ("TEST", 300), ("MEMBERS", 2), ("HIDDEN", 15)):
        monkeypatch.setattr(sensitivity, name, value)
    document = run(sensitivity_study({"square": Morphology.straight(3)}, radii=(0.6, 1.0), sides=(4, 30)), tmp_path)
    assert len(document["rows"]) == 16

    def mean(trained: tuple, met: tuple) -> float:
        wanted = dict(zip(("trained_radius", "trained_sides", "radius", "sides"), (*trained, *met), strict=True))
        return next(row["mean"] for row in document["rows"] if wanted.items() <= row.items())

    assert mean((1.0, 30), (1.0, 30)) < 0.5 * mean((0.6, 30), (0.6, 30))
    assert mean((1.0, 30), (0.6, 30)) > 1.5 * mean((0.6, 30), (0.6, 30))
