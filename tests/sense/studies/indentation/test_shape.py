"""The study of shape, in small: what it finds is better than chance, and the same when resumed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from design import Morphology
from sense.studies.indentation import shape
from sense.studies.indentation.shape import FOOTPRINTS, SETS, shape_study
from sense.studies.study import Study, run, study_lines

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 2, 0)}


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return run(shape_study(PADS, presses=500, test=200, hidden=12, epochs=25), tmp_path_factory.mktemp("shape"))


def test_shapes_are_named_better_than_by_chance(shapes: dict) -> None:
    assert [(row["pad"], row["shapes"]) for row in shapes["rows"]] == [(label, of) for label in PADS for of in SETS]
    assert len({tuple(row) for row in shapes["rows"]}) == 1
    for row, each in zip(shapes["rows"], shapes["confusions"], strict=True):
        counts = np.array(each["counts"])
        assert counts.sum() == 200
        assert row["accuracy_percent"] == pytest.approx(100 * np.trace(counts) / 200)
        assert row["accuracy_percent"] > row["guessed_percent"] + 5
        assert row["worst_percent"] == pytest.approx((100 * np.diag(counts) / counts.sum(axis=1)).min())
        assert row["worst"] in SETS[row["shapes"]]
        assert 0 < row["place_mm"] < 11.25 * 0.38
        assert 0 < row["place_shape_known_mm"] < 11.25 * 0.38


def test_footprints_of_a_size_have_one_area() -> None:
    for sides in FOOTPRINTS.values():
        radius = shape._circumradius(sides)
        area = np.pi * radius**2 if sides is None else sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
        assert area == pytest.approx(np.pi)


def test_a_resumed_study_gives_the_same(tmp_path: Path) -> None:
    def least() -> Study:
        study = shape_study(PADS, presses=100, test=60, hidden=4, epochs=3)
        return replace(study, draw=lambda document: Figure())

    def broken_off(done: int, total: int, name: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(least(), tmp_path / "broken", jobs=1, progress=broken_off)
    seen: list[int] = []
    again = run(least(), tmp_path / "broken", resume=True, progress=lambda done, total, name: seen.append(done))
    assert seen[0] >= 2
    assert again == run(least(), tmp_path / "whole")


def test_the_study_is_told_in_a_table_sentences_and_json(shapes: dict) -> None:
    json.dumps(shapes, allow_nan=False)
    text = "\n".join(study_lines(shapes))
    for row in shapes["rows"]:
        assert row["pad"] in text
