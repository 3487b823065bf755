"""The study of sensitivity to the object, in small."""

from pathlib import Path

import pytest

from padforge.design import Morphology
from padforge.sense.studies import sensitivity
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.study import run


@pytest.mark.slow
def test_study_finds_that_larger_objects_are_localized_better(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SIDE", 16), ("TEST", 300), ("MEMBERS", 2), ("HIDDEN", 15), ("RADII", (0.6, 1.0))):
        monkeypatch.setattr(sensitivity, name, value)
    document = run(sensitivity_study({"square": Morphology.straight(3)}), tmp_path)
    assert len(document["rows"]) == 16
    keys = "trained_radius", "trained_sides", "radius", "sides"
    means = {tuple(row[key] for key in keys): row["mean"] for row in document["rows"]}
    assert means[1.0, 30, 1.0, 30] < 0.5 * means[0.6, 30, 0.6, 30]
    assert means[1.0, 30, 0.6, 30] > 1.5 * means[0.6, 30, 0.6, 30]
