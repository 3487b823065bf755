"""The study of force, in small: what it finds is better than guessing, and the same when resumed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from design import InputError, Morphology
from design.pad.indentation import Indenter
from sense.studies.indentation.force import COUNTS, Learning, force_study, readings
from sense.studies.study import Study, run, study_lines

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 2, 0)}


@pytest.fixture(scope="module")
def force(tmp_path_factory: pytest.TempPathFactory) -> dict:
    learning = Learning(presses=300, test=120, hidden=12, epochs=25)
    return run(force_study(PADS, noise_counts=(1.0, 30.0), learning=learning), tmp_path_factory.mktemp("force"))


def test_depth_and_force_are_found_better_than_guessed(force: dict) -> None:
    for row in force["rows"]:
        assert 0 < row["depth_mm"] < 0.7 * row["depth_guessed_mm"]
        assert 0 < row["force_percent"] < 0.7 * row["force_guessed_percent"]
        assert row["depth_mm"] == pytest.approx(11.25 * row["depth_grid"])
        assert row["place_mm"] < 11.25 * 0.38  # the middle of the pad is that far off on average
        assert row["place_one_depth_mm"] < row["place_mm"]


def test_noise_costs_accuracy(force: dict) -> None:
    for quiet, loud in zip(force["rows"][::2], force["rows"][1::2], strict=True):
        assert quiet["pad"] == loud["pad"]
        assert quiet["depth_mm"] < loud["depth_mm"]
        assert quiet["place_one_depth_mm"] < loud["place_one_depth_mm"]


def test_rows_are_alike_and_the_force_is_that_of_the_depth(force: dict) -> None:
    assert len({tuple(row) for row in force["rows"]}) == 1
    assert [(row["pad"], row["noise_counts"]) for row in force["rows"]] == [
        (label, noise) for label in PADS for noise in (1.0, 30.0)
    ]
    curve, row, press = force["curves"][0], force["rows"][0], Indenter()
    made, found = (press.force_n(np.array(curve[key]) / 11.25, 11.25) for key in ("pressed_mm", "found_mm"))
    assert np.abs(found - made).mean() == pytest.approx(row["force_n"], rel=1e-3)
    assert len(curve["place_mm"]) == len(curve["middles_mm"])


def test_depths_an_indenter_does_not_allow_are_refused() -> None:
    with pytest.raises(InputError, match=r"depth is 0\.9, allowed is 0 to the sphere's radius"):
        force_study(PADS, depths=(0.1, 0.9))


def test_readings_are_whole_counts_within_the_full_scale() -> None:
    signals = np.array([[0.0, 0.5, 0.0], [0.25, 1.0, 0.0], [0.5, 2.0, 0.0]])
    read = readings(signals, np.array([0.5, 1.0, 0.0]), 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(read, [[0, 2048, 0], [2048, COUNTS, 0], [COUNTS, COUNTS, 0]])
    noisy = readings(np.full((4000, 1), 0.5), np.ones(1), 4.0, np.random.default_rng(0))
    assert noisy.std() == pytest.approx(4, rel=0.1)


def test_a_resumed_study_gives_the_same(tmp_path: Path) -> None:
    def least() -> Study:
        study = force_study(PADS, noise_counts=(1.0,), learning=Learning(presses=60, test=40, hidden=4, epochs=3))
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


def test_the_study_is_told_in_a_table_sentences_and_json(force: dict) -> None:
    json.dumps(force, allow_nan=False)
    text = "\n".join(study_lines(force))
    for row in force["rows"]:
        assert row["pad"] in text
